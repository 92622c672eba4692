"""Inverse problems and the memory of reverse mode, as rows, tables and pictures: `python -m experiments sph gradients`."""

from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import numpy as np
import pandas as pd
from jax import Array
from matplotlib.figure import Figure

from experiments._commands import check_names
from experiments.sph import solver
from experiments.sph.inverse import PROBLEMS, Found, Problem, solve
from experiments.sph.model import Model, State, make_model, make_state
from jfrnn.cases import fluids

NAMES = (*PROBLEMS, "memory")


def run(names: list[str], folder: Path, evaluations: int = 25) -> str:
    """Solve inverse problems, measure memory, write tables and pictures, and return the tables as text.

    Args:
        names: Of `NAMES`; all, where there are none.
        folder: Gets NAME.csv and NAME.png.
        evaluations: Of the loss of a problem, at most.

    Raises:
        UsageError: There is no such name.
    """
    check_names("problem", names, NAMES)
    folder.mkdir(parents=True, exist_ok=True)
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
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.semilogy(np.maximum(found.losses, 1e-16), "o-", markersize=3)
    left.set(xlabel="run", ylabel="loss", title=problem.name)
    for k in range(found.tried.shape[1]):
        right.plot(found.tried[:, k], "o-", color=f"C{k}", markersize=3)
        if problem.known is not None:
            right.axhline(problem.known[k], color=f"C{k}", linestyle="--", linewidth=1)
    right.set(xlabel="run", ylabel=problem.unknown)
    return figure


def memory(steps: tuple[int, ...] = (100, 400, 1600, 6400), nx: int = 6) -> pd.DataFrame:
    """Return the scratch memory of gradients through runs, as compiled, with √steps segments and with one.

    Args:
        steps: Square numbers.
        nx: Of the scene, a dam break in 2D.

    Returns:
        Columns steps, segments, scratch [B], state [B] (one state), states (scratch in states).
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
    figure = Figure(figsize=(4.6, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for label, part in (("√steps segments", frame[frame["segments"] > 1]), ("one segment", frame[frame["segments"] == 1])):
        axes.loglog(part["steps"], part["scratch [B]"] / 1e6, "o-", label=label, markersize=4)
    axes.set(xlabel="steps", ylabel="memory of reverse mode [MB]")
    axes.legend()
    return figure
