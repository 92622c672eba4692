"""Inverse problems and the memory of reverse mode, as rows, tables and pictures: `python -m experiments sph gradients`."""

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import numpy as np
import pandas as pd
import typer
from jax import Array
from matplotlib.figure import Figure

from experiments._commands import check_names, take_folder
from experiments._look import OURS, PEER, WIDTH, clear, dress, factor, head, make_axes, plain, write_names
from experiments.sph.inverse import PROBLEMS, Found, Problem, solve
from jfrnn.cases import fluids
from jfrnn.sph import solver
from jfrnn.sph.model import Model, State, make_model, make_state

NAMES = (*PROBLEMS, "memory")


def command(
    names: Annotated[list[str] | None, typer.Argument(help="viscosity, jet, droplet, memory; all without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of tables and pictures.")] = Path("out") / "sph-gradients",
    evaluations: Annotated[int, typer.Option(min=1, max=100_000, help="Runs to solve a problem with, at most.")] = 25,
) -> str:
    """Solve inverse problems by gradients through whole runs of a fluid, and measure the memory that such gradients take."""
    jax.config.update("jax_enable_x64", True)
    check_names("problem", names, NAMES)
    folder = take_folder(out)
    texts = []
    for name in names or NAMES:
        if name == "memory":
            frame = memory()
            draw_memory(frame).savefig(folder / "memory.png", dpi=100)
        else:
            start, problem = perf_counter(), PROBLEMS[name]()
            found = solve(problem, evaluations)
            frame = table(problem, found, perf_counter() - start)
            draw(problem, found).savefig(folder / f"{name}.png", dpi=100)
        frame.to_csv(folder / f"{name}.csv", index=False)
        texts.append(f"{name}\n{frame.to_string(index=False)}")
    return "\n\n".join(texts)


def table(problem: Problem, found: Found, seconds: float) -> pd.DataFrame:
    """Return a line per parameter: first guess, what was found, what is known; loss before and after, runs, steps, seconds."""
    known = [None] * len(found.best) if problem.known is None else problem.known
    line: dict[str, Any] = {"first loss": found.losses[0], "loss": found.loss, "runs": len(found.losses), "steps": problem.steps}
    line |= {"particles": problem.particles, "seconds": round(seconds, 1)}
    each = zip(problem.start, found.best, known, strict=True)
    return pd.DataFrame([{"unknown": problem.unknown, "guess": a, "found": b, "known": c} | line for a, b, c in each])


def draw(problem: Problem, found: Found) -> Figure:
    """Draw losses over runs, and the parameters that were tried; dashes are what is known."""
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        clear(axes)
    left.semilogy(np.maximum(found.losses, 1e-16), "o-", color=OURS, markersize=3)
    left.set(xlabel="run", ylabel="loss")
    ends = []
    for k, values in enumerate(found.tried.T):
        right.plot(values, "o-", color=OURS, markersize=3, linewidth=1)
        ends.append((f"{values[-1]:.3g}", len(values) - 1, values[-1], OURS))
        if problem.known is not None:
            right.axhline(problem.known[k], color=PEER, linestyle="--", linewidth=1)
    right.set(xlabel="run", ylabel=problem.unknown)
    write_names(right, ends)
    many = f"{len(found.best)} numbers are" if len(found.best) > 1 else "one number is"
    dashes = "; dashes: known" if problem.known is not None else ""
    fall = f"a loss of {found.losses[0]:.2g} falls to {found.loss:.2g}"
    head(figure, f"{problem.name}: {many} found in {len(found.losses)} runs, {fall}{dashes}")
    return figure


def memory(steps: tuple[int, ...] = (100, 400, 1600, 6400), nx: int = 6) -> pd.DataFrame:
    """Return the scratch memory of gradients through runs of a dam break in 2D, as compiled, with √steps segments and with one.

    Numbers of steps are squares. Columns are steps, segments, scratch [B], state [B] (one state), states (scratch in states).
    """
    scene = fluids.fluid("dam-break-2d", nx=nx)
    model, s = make_model(scene), make_state(scene)
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(s))
    lines = []
    for count in steps:
        for segments in (round(count**0.5), 1):
            scratch = _scratch(model, s, count, segments)
            line = {"steps": count, "segments": segments, "scratch [B]": scratch, "state [B]": state}
            lines.append(line | {"states": round(scratch / state, 1)})
    return pd.DataFrame(lines)


def _scratch(model: Model, s: State, steps: int, segments: int) -> int:
    def loss(v: Array) -> Array:
        end, _ = solver.rollout(model, solver.begin(model, s._replace(v=v)), steps, segments=segments)
        return (end.x * end.x).sum()

    analysis = jax.jit(jax.grad(loss)).lower(s.v).compile().memory_analysis()
    assert analysis is not None, "XLA says on every platform what a program takes"
    return analysis.temp_size_in_bytes


def draw_memory(frame: pd.DataFrame) -> Figure:
    """Draw scratch over steps, with √steps segments and with one."""
    steps, segments, scratch = (np.asarray(frame[name], float) for name in ("steps", "segments", "scratch [B]"))
    last = scratch[steps == steps.max()]
    ratio = factor(float(last.max() / last.min()))
    figure, axes = make_axes(
        f"After {plain(float(steps.max()))} steps, √steps segments take {ratio} times less memory than one", 3.8
    )
    ends = []
    for name, color, which in (("√steps segments", OURS, segments > 1), ("one segment", PEER, segments == 1)):
        x, y = steps[which], scratch[which] / 1e6
        axes.plot(x, y, "o-", color=color, markersize=5)
        ends.append((name, float(x[-1]), float(y[-1]), color))
    dress(axes, "steps", "memory of reverse mode [MB]")
    write_names(axes, ends)
    return figure
