"""One sum in many ways over numbers of particles, a process per row: rows, a table, and pictures of them."""

import math
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pydantic import Field

from experiments import _sweep
from experiments._commands import RetryFailed, RowsFolder, take_folder
from experiments._config import Dtype, LayoutName, Positive, Repeats, Seed, digest, load, one_of
from experiments._look import MARKERS, OURS, PEERS_COLORS, WIDTH, dress, factor, head, plain, write_names
from experiments._loop import Shown, Task, fill, with_result
from experiments._rows import RowFile
from experiments.bench.ways import WAYS

ERROR_UNIT = "eps·√neighbors"
"""The unit of errors of sums: what rounding makes of a sum of so many terms, in machine epsilons."""
FUSED = "pair_sum warp"
PANELS = {"seconds": "list and sums [s]", "B per particle": "peak memory [B per particle]"}
SHARED = (1, 2, 5, 10, 20, 50, 100, 200)  # sums per rebuild of a list
_OTHERS = ("jax-md", "nvalchemi", "scipy")
_COLORS = dict(zip((way for way in WAYS if way.startswith(_OTHERS)), PEERS_COLORS, strict=False))
_STYLES = {way: (_COLORS.get(way, OURS), marker) for way, marker in zip(WAYS, MARKERS, strict=True)}
_Line = dict[str, Any]


class Config(Repeats):
    """Scenes × ways, and how each row is measured."""

    ways: tuple[Annotated[str, one_of("way", lambda: WAYS)], ...] = Field(min_length=1)  # of `ways.WAYS`
    layouts: tuple[LayoutName, ...] = Field(min_length=1)  # of full domains
    spacings: tuple[Positive, ...] = Field(min_length=1)  # distances of lattice neighbors [m], each a number of particles
    gradients: tuple[bool, ...] = (False, True)  # whether the gradient is asked for, too
    compensated: tuple[bool, ...] = (False, True)  # whether rounding errors are carried along, by ways that can do so
    most_points: dict[str, int] = Field(default_factory=dict)  # of ways that larger scenes are skipped for
    cutoff_ratio: Positive = 3.0  # cutoff in spacings
    dtype: Dtype = "float32"  # of the positions
    seed: Seed = 0  # of random layouts, and of what each particle contributes
    min_seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0

    def specs(self) -> Iterator[dict[str, Any]]:
        """Yield the rows, those of one scene and one sum side by side."""
        shared = self.model_dump(include={"cutoff_ratio", "dtype", "seed", "repeats", "min_seconds", "max_repeats", "timeout"})
        for layout, spacing, gradient, name in product(self.layouts, self.spacings, self.gradients, self.ways):
            way, most = WAYS[name], self.most_points.get(name)
            if gradient and not way.sums:
                continue
            for compensated in self.compensated if way.compensates else (False,):
                about = {"layout": layout, "spacing": spacing, "way": name, "gradient": gradient, "compensated": compensated}
                yield about | shared | {"most_points": most}


def command(
    config: Annotated[Path, typer.Argument(help="Config of sums, TOML.")] = Path("experiments/configs/sums.toml"),
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> str:
    """Measure one sum over neighbors in many ways, or go on with it; then print a table, and draw pictures beside the rows."""
    given, folder = load(config, Config), take_folder(out or Path("out") / config.stem)
    return report(run(given, folder, retry_failed), folder)


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[_Line]:
    """Measure every row of the config that the folder does not hold yet, and return all rows of the config.

    Times are of list and sums, `build_s` of the list and `sum_s` of the sums alone [s]; `peak_bytes` is the peak of the memory over
    the start of a run. `error` is the largest error against float64 over the sum of |terms|, in eps·sqrt(number of neighbors),
    rounding of the terms included.

    Raises:
        NoResultError: none of these rows has a result.
    """
    tasks = [Task((digest(x),), f"{x['layout']} {x['spacing']:g} m · {x['way']}", partial(_measure, x)) for x in config.specs()]
    return with_result(fill(RowFile(folder, dict), tasks, describe, retry_failed=retry_failed))


def _measure(spec: _Line, shown: Shown) -> list[_Line]:
    asked = ("layout", "spacing", "cutoff_ratio", "dtype", "seed", "way", "gradient", "compensated")
    answer = _sweep.ask({"do": "sum", "spec": spec}, spec["timeout"], cold=False)
    return [{"key": digest(spec)} | {name: spec[name] for name in asked} | answer]


def describe(row: _Line) -> str:
    """Return a row as a line for the reader."""
    what = f"{row['way']}{', compensated' * row['compensated']}{', gradient' * row['gradient']}"
    if row["status"] != "ok":
        return f"{what:<42} {_outcome(row)}"
    error = "" if row.get("error") is None else f", error {row['error']:.2g} {ERROR_UNIT}"
    each = row["peak_bytes"] / row["points"]
    return f"{what:<42} {row['points']:>9} points {row['median_s']:9.4f} s {each:8.0f} B per particle{error}"


def report(rows: list[_Line], folder: Path) -> str:
    """Write table.csv, sums.png and payoff.png into the folder, and return the table as text."""
    lines = table(rows)
    frame = pd.DataFrame(lines)
    frame.to_csv(folder / "table.csv", index=False)
    draw(lines).savefig(folder / "sums.png", dpi=160)
    draw_payoff(lines).savefig(folder / "payoff.png", dpi=160)
    shown = frame.rename(columns={"error": f"error [{ERROR_UNIT}]"})
    return shown.to_string(index=False, na_rep="", float_format="%.3g")


def table(rows: list[_Line]) -> list[_Line]:
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


def _line(row: _Line) -> _Line:
    points, size, build, each = (row.get(name) for name in ("points", "peak_bytes", "build_s", "sum_s"))
    return {
        **{"layout": row["layout"], "points": points, "sums": "density, gradient" if row["gradient"] else "density"},
        **{"way": row["way"], "compensated": row["compensated"], "seconds": row.get("median_s")},
        **{"B per particle": None if size is None else size / max(points or 0, 1), "error": row.get("error")},
        **{"build_ms": None if build is None else 1e3 * build, "sum_ms": None if each is None else 1e3 * each},
        **{"ratio": None, "pays_from": None, "status": _outcome(row)[:100]},
    }


def _outcome(row: _Line) -> str:
    return row["status"] + (f": {row['reason']}" if row.get("reason") else "")


def _good(lines: Iterable[_Line]) -> list[_Line]:
    """Return lines of sums, which searches alone are not, that were measured."""
    return [line for line in lines if line["status"] == "ok" and line["error"] is not None]


def _group(lines: Iterable[_Line], *names: str) -> dict[tuple, list[_Line]]:
    groups: dict[tuple, list[_Line]] = {}
    for line in lines:
        groups.setdefault(tuple(line[name] for name in names), []).append(line)
    return groups


def draw(lines: list[_Line]) -> Figure:
    """Draw time and memory over the number of particles, a column for each layout and sum; what is compensated is in the table."""
    kinds = _group((line for line in lines if line["status"] == "ok" and not line["compensated"]), "layout", "sums")
    figure = Figure(figsize=(WIDTH, 1.2 + 3.2 * len(PANELS)), layout="constrained")
    panels = figure.subplots(len(PANELS), max(len(kinds), 1), squeeze=False, sharex=True, sharey="row")
    last_ways = {line["way"] for line in [*kinds.values()][-1]} if kinds else set()
    for column, ((layout, what), scenes) in zip(panels.T, kinds.items(), strict=False):
        for axes, (name, label) in zip(column, PANELS.items(), strict=True):
            ways = _group((line for line in scenes if line[name]), "way")
            for (way,), of_way in ways.items():
                _plot(axes, [x["points"] for x in of_way], [x[name] for x in of_way], way)
            dress(axes, "particles" if axes is column[-1] else "", label if axes in panels[:, 0] else "")
            ends = [(way, of[-1]["points"], of[-1][name], _STYLES[way][0]) for (way,), of in ways.items()]
            if axes in panels[:, -1]:
                write_names(axes, ends)
            for way, x, y, color in (end for end in ends if end[0] not in last_ways):
                text = axes.annotate(way, (x, y), (-14, 8), textcoords="offset points", ha="right", fontsize=8, color=color)
                text.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.5})  # lines go on behind it
        column[0].set_title(f"{layout}: {what}", loc="left", fontsize=10)
    head(figure, _headline(lines))
    return figure


def _headline(lines: list[_Line]) -> str:
    ratios = [line["ratio"] for line in _good(lines) if line["ratio"] and line["build_ms"] is not None and not line["compensated"]]
    span = f" takes {factor(min(ratios))} to {factor(max(ratios))} times as long as {FUSED}" if ratios else ""
    return f"A list and a sum over it{span}" if span else "Sums over neighbors"


def draw_payoff(lines: list[_Line]) -> Figure:
    """Draw the time of one sum over the number of sums that share a list, of the largest scene of each layout and sum."""
    kinds = _group((line for line in _good(lines) if not line["compensated"]), "layout", "sums")
    figure = Figure(figsize=(WIDTH, 3.9 * max(len(kinds), 1)), layout="constrained")
    for axes, ((layout, what), scenes) in zip(
        figure.subplots(max(len(kinds), 1), squeeze=False)[:, 0], kinds.items(), strict=False
    ):
        largest, ends = max(line["points"] for line in scenes), []
        for line in (line for line in scenes if line["points"] == largest):
            times = [(line["build_ms"] or 0) / k + line["sum_ms"] for k in SHARED]
            _plot(axes, SHARED, times, line["way"])
            ends.append((line["way"], SHARED[-1], times[-1], _STYLES[line["way"]][0]))
        dress(axes, "sums per rebuild of the list", "time of a sum and its share of the list [ms]")
        write_names(axes, ends)
        axes.set_title(f"{layout}, {plain(largest)} particles: {what}", loc="left", fontsize=10)
    pays = [line["pays_from"] for line in _good(lines) if line["pays_from"]]
    least = min(pays, default=math.inf)
    head(figure, "No list pays off, however many sums it serves" if least == math.inf else f"A list pays off from {least} sums on")
    return figure


def _plot(axes: Axes, x: Iterable[float], y: Iterable[float], way: str) -> None:
    color, marker = _STYLES[way]
    axes.plot([*x], [*y], color=color, marker=marker, markeredgecolor="white", linewidth=1.8 if color == OURS else 1.1)
