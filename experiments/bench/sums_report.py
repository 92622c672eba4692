"""What rows of sums say: a table, a picture of time, memory and error over particles, and one of where a list pays off."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments._commands import RetryFailed, RowsFolder, take_folder
from experiments._config import load
from experiments._plots import COLORS, OTHER_COLORS, dress
from experiments.bench.sums import ERROR_UNIT, Config, SumRow, run
from experiments.bench.ways import WAYS

FUSED = "pair_sum warp"
PANELS = {
    "seconds": "time of list and sums [s], median",
    "B per particle": "peak memory [B per particle]",
    "error": "largest error [eps·sqrt(neighbors)]",
}
SHARED = (1, 2, 5, 10, 20, 50, 100, 200)  # sums per rebuild of a list
_COLORS = (*COLORS.values(), OTHER_COLORS[0])
_STYLES = {way: (color, marker) for way, color, marker in zip(WAYS, _COLORS, "*XosP^vD", strict=True)}
_Line = dict[str, Any]


def command(
    config: Annotated[Path, typer.Argument(help="Config of sums, TOML.")] = Path("experiments/configs/sums.toml"),
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> str:
    """Measure one sum over neighbors in many ways, or go on with it; then print a table, and draw pictures beside the rows."""
    given, folder = load(config, Config), take_folder(out or Path("out") / config.stem)
    return report(run(given, folder, retry_failed), folder)


def report(rows: list[SumRow], folder: Path) -> str:
    """Write table.csv, sums.png and payoff.png into the folder, and return the table as text."""
    lines = table(rows)
    frame = pd.DataFrame(lines)
    frame.to_csv(folder / "table.csv", index=False)
    draw(lines).savefig(folder / "sums.png", dpi=130)
    draw_payoff(lines).savefig(folder / "payoff.png", dpi=130)
    shown = frame.rename(columns={"error": f"error [{ERROR_UNIT}]"})
    return shown.to_string(index=False, na_rep="", float_format="%.3g")


def table(rows: list[SumRow]) -> list[_Line]:
    """Return a line per row, None where there is nothing to say.

    `ratio` is that of the seconds to those of FUSED, without compensation, on the same scene. `pays_from` says from how many sums
    per rebuild on the list is faster than the fastest sum without one; infinite: never.
    """
    lines = [_line(row) for row in rows]
    for scene in _group(lines, "layout", "points", "sums").values():
        direct = {x["way"]: x["seconds"] for x in _good(scene) if x["build_ms"] is None and not x["compensated"]}
        for line in _good(scene):
            if FUSED in direct:
                line["ratio"] = line["seconds"] / direct[FUSED]
            if direct and line["build_ms"] is not None:
                line["pays_from"] = pays_from(1e-3 * line["build_ms"], 1e-3 * line["sum_ms"], min(direct.values()))
    return lines


def pays_from(build: float, each: float, direct: float) -> float:
    """Return from how many sums per rebuild on a list is faster: the smallest k with build + k·each < k·direct."""
    return math.floor(build / (direct - each)) + 1 if each < direct else math.inf


def _line(row: SumRow) -> _Line:
    return {
        **{"layout": row.layout, "points": row.points, "sums": "density, gradient" if row.gradient else "density"},
        **{"way": row.way, "compensated": row.compensated, "seconds": row.median_s},
        "B per particle": None if row.peak_bytes is None else row.peak_bytes / max(row.points or 0, 1),
        "error": row.error,
        "build_ms": None if row.build_s is None else 1e3 * row.build_s,
        "sum_ms": None if row.sum_s is None else 1e3 * row.sum_s,
        **{"ratio": None, "pays_from": None},
        "status": row.outcome,
    }


def _good(lines: Iterable[_Line]) -> list[_Line]:
    """Return lines of sums, which searches alone are not, that were measured."""
    return [line for line in lines if line["status"] == "ok" and line["error"] is not None]


def _group(lines: Iterable[_Line], *names: str) -> dict[tuple, list[_Line]]:
    groups: dict[tuple, list[_Line]] = {}
    for line in lines:
        groups.setdefault(tuple(line[name] for name in names), []).append(line)
    return groups


def draw(lines: list[_Line]) -> Figure:
    """Draw time, memory and error over the number of particles, a row of panels for each layout and sum."""
    kinds = _group((line for line in lines if line["status"] == "ok"), "layout", "sums")
    figure, panels = _figure(max(len(kinds), 1), len(PANELS))
    for panel, ((layout, what), scenes) in zip(panels, kinds.items(), strict=False):
        for axes, (column, label) in zip(panel, PANELS.items(), strict=True):
            there = [line for line in scenes if line[column]]
            for (way, compensated), of_way in _group(there, "way", "compensated").items():
                _plot(axes, [x["points"] for x in of_way], [x[column] for x in of_way], way, compensated)
            dress(axes, "particles", label)
            if column == "error":
                axes.set(yscale="linear", ylim=(0, None))
        panel[0].set_title(f"{layout}: {what}", loc="left", fontsize=11, fontweight="bold")
    _name_ways(figure, panels[0])
    return figure


def draw_payoff(lines: list[_Line]) -> Figure:
    """Draw the time of one sum over the number of sums that share a list, of the largest scene of each layout and sum."""
    kinds = _group((line for line in _good(lines) if not line["compensated"]), "layout", "sums")
    figure, panels = _figure(1, max(len(kinds), 1))
    for axes, ((layout, what), scenes) in zip(panels[0], kinds.items(), strict=False):
        largest = max(line["points"] for line in scenes)
        for line in (line for line in scenes if line["points"] == largest):
            _plot(axes, SHARED, [(line["build_ms"] or 0) / k + line["sum_ms"] for k in SHARED], line["way"], False)
        dress(axes, "sums per rebuild of the list", "time of a sum and its share of the list [ms]")
        axes.set_title(f"{layout}, {largest} particles: {what}", loc="left", fontsize=11, fontweight="bold")
    _name_ways(figure, panels[0])
    return figure


def _figure(rows: int, columns: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(4.4 * columns, 0.9 + 3.9 * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _plot(axes: Axes, x: Iterable[float], y: Iterable[float], way: str, compensated: bool) -> None:
    (color, marker), label = _STYLES[way], f"{way}{', compensated' * compensated}"
    (line,) = axes.plot([*x], [*y], color=color, marker=marker, markersize=6, label=label)
    if compensated:
        line.set(linestyle="--", markerfacecolor="white")


def _name_ways(figure: Figure, panels: Iterable[Axes]) -> None:
    """Name every way once, below the panels."""
    named = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if named:
        figure.legend([*named.values()], [*named], loc="outside lower center", ncols=4, frameon=False, fontsize=9)
