"""Run scenes with known answers: a row per case, on disk before the next one starts; a table and pictures are made of the rows."""

import math
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import numpy as np
import pandas as pd
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from experiments import _machine
from experiments._commands import check_names, take_folder
from experiments._look import MARKERS, OURS, PEER, make_axes, write_names
from experiments._loop import Task, fill, with_result
from experiments._rows import RowFile
from experiments.sph.validation import CASES, Case, Curves, Seen, look
from jfrnn.sph import health, solver
from jfrnn.sph.model import make_model, make_state
from jfrnn.sph.settings import SCENES

Row = dict[str, Any]


def command(
    cases: Annotated[list[str] | None, typer.Argument(help="Such as taylor-green, cavity; all, long ones last, without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the rows.")] = Path("out") / "sph-validate",
) -> str:
    """Run fluid scenes with known answers, or go on with them; then print a table, and draw pictures beside the rows."""
    jax.config.update("jax_enable_x64", True)
    check_names("case", cases, CASES)
    tasks = [Task((name,), name, partial(_rows, name)) for name in cases or CASES]
    rows = with_result(fill(RowFile(take_folder(out), dict), tasks, _in_words, about={"versions": _machine.versions()}))
    return report(rows, out)


def _rows(name: str, shown: Any) -> list[Row]:  # noqa: ANN401
    return [measure(name, CASES[name], shown.label)]


def measure(name: str, case: Case, say: Any = print) -> Row:  # noqa: ANN401
    """Run a case and judge it; a run that diverges makes a row that says so.

    The name is the row's key. `figures` are what was measured: quantity, measured, low, high (what it has to be), met; none of a
    run that diverged. `seconds` are those of the run, compilation included; `curves` what the picture shows, [x, y] by name.
    """
    make = SCENES[case.scene] if isinstance(case.scene, str) else case.scene
    scene = make(**case.settings)
    model, start, step, seen = make_model(scene, backend=case.backend, force=case.force), perf_counter(), 0, []
    s = jax.jit(solver.begin)(model, make_state(scene))
    reason = None
    for time in case.times:
        if scene.step is None:
            s, _, steps = solver.advance_until(model, s, None, time)
        else:
            steps = round(time / scene.step) - step
            s, _ = solver.advance(model, s, None, steps)
        step += int(steps)
        if (reason := health.complaint(scene, s)) is not None:
            reason = f"diverged until t = {float(s.time):.6g} s: {reason}"
            break
        seen.append(look(scene, model, s))
        say(f"{name} · t {float(s.time):.4g} s · {step / (perf_counter() - start):.0f} steps/s")
    figures, curves = _judge(case, scene, seen) if reason is None else ([], {})
    about = {"particles": scene.n, "steps": step, "seconds": round(perf_counter() - start, 1), "axes": case.axes}
    about["device"] = jax.devices()[0].device_kind
    return {"key": name, "status": "ok" if figures else "failed", "reason": reason, "figures": figures, "curves": curves} | about


def _judge(case: Case, scene: Any, seen: list[Seen]) -> tuple[list[dict[str, Any]], Curves]:  # noqa: ANN401
    figures, curves = case.judge(scene, seen)
    measured = ((figure, figure.measured if math.isfinite(figure.measured) else None) for figure in figures)  # JSON has no NaN
    return [figure._asdict() | {"measured": number, "met": figure.met} for figure, number in measured], curves


def report(rows: list[Row], folder: Path) -> str:
    """Write table.csv and a picture per case into the folder, and return the table as text."""
    frame = table(rows)
    frame.to_csv(folder / "table.csv", index=False)
    for row in rows:
        if row["curves"]:
            draw(row).savefig(folder / f"{row['key']}.png", dpi=100)
    return frame.to_string(index=False)


def table(rows: list[Row]) -> pd.DataFrame:
    """Return a line per figure, and one for each case that has none."""
    lines = []
    for row in rows:
        run_line = {name: row[name] for name in ("particles", "steps", "seconds")} | {"device": row.get("device") or "cpu"}
        if not row["figures"]:
            lines.append({"case": row["key"], "quantity": row["reason"], "measured": "", "target": "", "met": "no"} | run_line)
        for figure in row["figures"]:
            words = {"quantity": figure["quantity"], "measured": _number(figure), "target": _target(figure)}
            lines.append({"case": row["key"], **words, "met": "yes" if figure["met"] else "no"} | run_line)
    return pd.DataFrame(lines)


def draw(row: Row) -> Picture:
    """Draw what the particles do in color, as dots, and what is known in grey, as lines; of a dam break the other way round."""
    broken = row["key"].startswith("dam-break")
    said = "; ".join(f"{x['quantity']}: {_number(x)} ({_target(x)})" for x in row["figures"][: 1 if broken else 2])
    figure, axes = make_axes(f"{row['key']}. {said}" if said else row["key"], 4.2)
    shapes, ends = dict(zip(row["curves"], MARKERS, strict=False)), []
    for name, (x, y) in row["curves"].items():
        what, _, kind = name.rpartition(", ")
        color = OURS if kind == "measured" else PEER
        dots = (kind == "known") if broken else (kind == "measured")
        marker, line = (shapes[name] if broken else "o", "none") if dots else ("none", "-")
        size, above = 5 if broken else 3.5, 3 if dots else 2
        axes.plot(x, y, color=color, marker=marker, linestyle=line, markersize=size, zorder=above)
        if broken or not what:
            ends.append(("particles" if kind == "measured" else what or kind, x[-1], y[-1], color))
    write_names(axes, ends)
    _name_pairs(axes, row["curves"] if not ends else {})
    key = "" if broken else "; dots: particles, lines: known"
    axes.set(xlabel=f"{row['axes'][0]}{key}", ylabel=row["axes"][1])
    return figure


def _name_pairs(axes: Axes, curves: Curves) -> None:
    """Write what the lines of known answers are where they are furthest apart; those that are one there share a name."""
    low, high = axes.get_ylim()
    lines = {
        name.rpartition(", ")[0]: np.array(sorted(zip(*xy, strict=True))).T for name, xy in curves.items() if name.endswith("known")
    }
    if not lines:
        return
    places = np.quantile(next(iter(lines.values()))[0], np.linspace(0.05, 0.95, 19))
    values = {what: np.interp(places, *line) for what, line in lines.items()}
    best = int(np.argmax(np.ptp(np.stack([*values.values()]), axis=0)))
    placed: list[tuple[float, str]] = []
    for y, what in sorted((of[best], what) for what, of in values.items()):
        near = bool(placed) and y - placed[-1][0] < 0.06 * (high - low)
        placed[-1 if near else len(placed) :] = [(y, f"{placed[-1][1]}, {what.removeprefix('t = ')}" if near else what)]
    for y, what in placed:
        box = {"boxstyle": "square,pad=0.1", "color": "white", "alpha": 0.8}
        axes.annotate(what, (places[best], y), (0, 6), textcoords="offset points", ha="center", fontsize=9, bbox=box)


def _number(figure: dict[str, Any]) -> str:
    return "not finite" if figure["measured"] is None else f"{figure['measured']:.3g}"


def _target(figure: dict[str, Any]) -> str:
    return f"≤ {figure['high']:g}" if figure["low"] is None else f"{figure['low']:g} to {figure['high']:g}"


def _in_words(row: Row) -> str:
    if not row["figures"]:
        return f"{row['key']}: {row['reason']}"
    return f"{row['key']}: " + "; ".join(
        f"{x['quantity']} {_number(x)} ({_target(x)}: {'met' if x['met'] else 'missed'})" for x in row["figures"]
    )
