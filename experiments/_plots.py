"""The pictures of a report, drawn from rows alone: filled marks are ours, hollow ones the thesis's."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from statistics import geometric_mean

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from experiments import _table, _thesis
from experiments._rows import SearchRow

# Colors of M. Okabe and K. Ito, distinct to color-blind eyes too; other methods take those that are left.
COLORS = {
    **{"warp": "#CC79A7", "hashgrid": "#E69F00", "jax": "#0072B2", "cll": "#D55E00"},
    **{"scipy-kdtree": "#009E73", "scipy-kdtree-nolist": "#56B4E9", "brute": "#999999"},
}
OTHER_COLORS = (
    *("#000000", "#F0E442", "#7F3C8D", "#6B4423", "#1F77B4", "#8C564B", "#17BECF", "#BCBD22", "#2CA02C", "#AF4B91"),
    *("#98DF8A", "#FF9896", "#9467BD", "#C49C94", "#393B79", "#637939", "#E377C2", "#843C39"),
)
OTHER_MARKERS = ("P", "p", "h", "<", ">", "d", "8")
MARKERS = {
    **{"warp": "*", "hashgrid": "X", "jax": "o", "cll": "s"},
    **{"scipy-kdtree": "^", "scipy-kdtree-nolist": "v", "brute": "D"},
}
PLAIN = FuncFormatter(lambda number, _: _table.count(int(number)) if number >= 1000 else f"{number:g}")
Value = Callable[[SearchRow], float | None]
ThesisValue = Callable[[_thesis.Figures], float]

SECONDS = "time of a search [s], median; bars: its interval"
MEGABYTES = "peak memory of a search over its start [MB]"


def draw_all(rows: Sequence[SearchRow], folder: Path, origin: str) -> list[Path]:
    """Draw every picture into the folder and return their paths; none where no row has figures.

    Args:
        rows: Rows of a sweep.
        folder: Where the pictures go.
        origin: Machine, versions and date, written below each picture.
    """
    good = _table.in_order([row for row in rows if row.status == "ok"])
    if not good:
        return []

    def memory(row: SearchRow) -> float | None:
        return _table.megabytes(row.search_bytes or row.peak_bytes)

    seconds, density, thesis_seconds, thesis_memory = map(attrgetter, ("median_s", "density_error", "seconds", "megabytes"))
    speed = SECONDS.split(";")[0]
    wanted: tuple[tuple[str, Value, Callable[[], Figure]], ...] = (
        ("runtime_by_layout", seconds, partial(_by_layout, good, seconds, thesis_seconds, SECONDS)),
        ("memory_by_layout", memory, partial(_by_layout, good, memory, thesis_memory, MEGABYTES)),
        ("runtime_by_fill", seconds, partial(_by_fill, good, seconds, thesis_seconds, speed)),
        ("memory_by_fill", memory, partial(_by_fill, good, memory, thesis_memory, MEGABYTES)),
        ("speed_against_error", seconds, partial(against_error, good, seconds, speed, "Speed")),
        ("memory_against_error", memory, partial(against_error, good, memory, MEGABYTES, "Memory")),
        ("speed_against_sum_error", density, partial(against_sum_error, good)),
    )
    pictures = {name: draw() for name, value, draw in wanted if any(value(row) is not None for row in good)}
    paths = []
    for name, figure in pictures.items():
        figure.text(0.01, 0.008, origin, fontsize=7, color="0.45", wrap=True)
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=150)
    return paths


def _methods(rows: Iterable[SearchRow]) -> list[str]:
    """Return the methods of the rows, known ones first."""
    present = {row.method for row in rows}
    return [*(name for name in COLORS if name in present), *sorted(present - set(COLORS))]


def _color(method: str, methods: list[str]) -> str:
    others = [name for name in methods if name not in COLORS]
    return COLORS.get(method) or OTHER_COLORS[others.index(method) % len(OTHER_COLORS) if method in others else 0]


def _marker(method: str) -> str:
    return MARKERS.get(method) or OTHER_MARKERS[sum(method.encode()) % len(OTHER_MARKERS)]


def _title(label: str) -> str:
    """Return the label of an axis without what stands behind its unit, as a title."""
    return f"{label[0].upper()}{label[1:].split(' [')[0]}"


def _figure(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(rect=(0, 0.035, 1, 0.965))  # type: ignore[union-attr]
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def label_logarithmic(axis: Axis, short: float = 1000) -> None:
    """Write plain numbers at the powers of ten, and at 2 and 5 times these where an axis ends below `short` times its begin."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < short * low else (1,)))
    axis.set_major_formatter(PLAIN)


def dress(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Make both axes logarithmic and name them."""
    axes.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    for axis, short in ((axes.xaxis, 100), (axes.yaxis, 1000)):  # numbers side by side take more room
        label_logarithmic(axis, short)
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(axes: Axes, methods: list[str], thesis: Iterable[tuple[str, str]], *, lines: bool = False) -> None:
    """Name our methods and the thesis's beside the axes; `thesis` holds pairs of our method and its counterpart."""
    solid, dashed = ("-", "--") if lines else ("none", "none")
    handles = [Line2D([], [], color=_color(name, methods), marker=_marker(name), linestyle=solid, label=name) for name in methods]
    for ours, theirs in thesis:
        handle = Line2D([], [], color=_color(ours, methods), marker=_marker(ours), linestyle=dashed, label=f"thesis: {theirs}")
        handle.set_markerfacecolor("none")
        handles.append(handle)
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)


def _theirs(rows: list[SearchRow], value: ThesisValue) -> dict[tuple[str, str], list[tuple[SearchRow, float]]]:
    """Return the thesis's values on the scenes of these rows, by our method and its counterpart."""
    scenes = {row.scene_key: row for row in rows}
    found = defaultdict(list)
    for ours, theirs in _thesis.counterparts(row.method for row in rows).items():
        for row in scenes.values():
            if (figures := _thesis.figures(row, theirs)) is not None:
                found[ours, theirs].append((row, value(figures)))
    return dict(found)


def _by_layout(rows: list[SearchRow], value: Value, thesis_value: ThesisValue, label: str) -> Figure:
    """Draw a mark per row: scenes downwards, values to the right on a log axis."""
    names, methods = _table.name_scenes(rows), _methods(rows)
    theirs = _theirs(rows, thesis_value)
    places = {key: number for number, key in enumerate(dict.fromkeys(row.scene_key for row in rows))}
    points = {row.scene_key: row.points or 0 for row in rows}
    height = max(1.8 + max(0.52, 0.06 * len(methods)) * len(places), 2 + 0.2 * len(methods))
    figure, axes = _figure(10.5, height, f"{_title(label)}, by layout")
    for number in range(0, len(places), 2):
        axes.axhspan(number - 0.5, number + 0.5, color="0.97", zorder=0)
    offsets = {name: 0.62 * ((number + 0.5) / len(methods) - 0.5) for number, name in enumerate(methods)}
    for row in rows:
        if not (middle := value(row)):
            continue
        y, color = places[row.scene_key] + offsets[row.method], _color(row.method, methods)
        low, high = getattr(row, "low_s", None) or row.p10_s, getattr(row, "high_s", None) or row.p90_s
        if value(row) == row.median_s and low and high:
            axes.plot([low, high], [y, y], color=color, linewidth=1.5)
        axes.plot(middle, y, color=color, marker=_marker(row.method), markersize=6, linestyle="none")
    for (ours, _), values in theirs.items():
        y = [places[row.scene_key] + offsets.get(ours, 0.0) + 0.31 / len(methods) for row, _ in values]  # beside ours, not upon it
        x = [number for _, number in values]
        style = {"color": _color(ours, methods), "marker": _marker(ours), "markerfacecolor": "none", "linestyle": "none"}
        axes.plot(x, y, markersize=6, **style)  # pyright: ignore[reportArgumentType]
    labels = [f"{names[key]}\n{_table.count(points[key])} points" for key in places]
    axes.set_yticks(list(places.values()), labels, fontsize=9)
    axes.set(xscale="log", ylim=(len(places) - 0.5, -0.5), xlabel=label)
    label_logarithmic(axes.xaxis)
    axes.yaxis.grid(False)
    _legend(axes, methods, theirs)
    return figure


def _by_fill(rows: list[SearchRow], value: Value, thesis_value: ThesisValue, label: str) -> Figure:
    """Draw the geometric mean of the layouts that are asked to fill the same, and a bar from the least to the most of them."""
    methods, theirs = _methods(rows), _theirs(rows, thesis_value)
    figure, axes = _figure(10.5, 6.0, f"{_title(label)}, by fill (mean and range of the layouts)")
    shifts = {name: 1.018 ** (number - (len(methods) - 1) / 2) for number, name in enumerate(methods)}
    for method in methods:
        mine = [(row, number) for row in rows if row.method == method and (number := value(row))]
        _draw_over_fill(axes, mine, shifts[method], color=_color(method, methods), marker=_marker(method), linestyle="-")
    for (ours, _), values in theirs.items():
        style = {"color": _color(ours, methods), "marker": _marker(ours), "markerfacecolor": "white", "linestyle": "--"}
        _draw_over_fill(axes, values, shifts.get(ours, 1.0), **style)
    ticks = [number * 10.0**power for power in range(-6, 3) for number in (1, 2, 5) if number * 10**power <= 100]
    axes.set(xscale="log", yscale="log", xlabel="fill: points / points of the full domain [%]", ylabel=label)
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(PLAIN)
    label_logarithmic(axes.yaxis)
    fills = [100 * row.fill for row in rows if row.fill]
    axes.set_xlim(min(fills) / 1.25, max(fills) * 1.25)
    _legend(axes, methods, theirs, lines=True)
    return figure


def _draw_over_fill(axes: Axes, values: list[tuple[SearchRow, float]], shift: float, **style: str) -> None:
    """Draw the values of one method; the shift keeps marks of methods apart."""
    groups = defaultdict(list)
    for row, number in values:
        if row.fill:
            groups[row.fill_asked].append((100 * row.fill, number))
    means = sorted((geometric_mean(fills), numbers) for fills, numbers in (zip(*group, strict=True) for group in groups.values()))
    x, y = [shift * fill for fill, _ in means], [geometric_mean(numbers) for _, numbers in means]
    axes.vlines(
        x, [min(numbers) for _, numbers in means], [max(numbers) for _, numbers in means], color=style["color"], linewidth=1.5
    )
    axes.plot(x, y, markersize=6, linewidth=1.2, **style)  # pyright: ignore[reportArgumentType]


def against_error(rows: list[SearchRow], value: Value, label: str, title: str) -> Figure:
    """Draw a value over missing and extra pairs: exact methods stand on the left edge, good ones low."""
    methods = _methods(rows)
    figure, axes = _figure(
        10.5, max(6.0, 2 + 0.2 * len(methods)), f"{title} against error: a mark per scene, larger for more points"
    )
    _scatter(axes, rows, lambda row: row.errors, value)
    axes.set_xscale("symlog", linthresh=1)
    most = max((row.errors or 0 for row in rows), default=0)
    axes.set(yscale="log", xlim=(-0.5, max(2.0 * most, 10)), xlabel="missing + extra pairs, against the exact answer")
    axes.set_ylabel(label)
    axes.axvline(0, color="0.6", linewidth=0.8, zorder=0.5)
    axes.xaxis.set_major_formatter(PLAIN)
    label_logarithmic(axes.yaxis)
    _legend(axes, methods, [])
    return figure


def against_sum_error(rows: list[SearchRow]) -> Figure:
    """Draw time over the largest error of a sum over neighbors: what wrong pairs do, and rounding to sums without a list."""
    methods = _methods(rows)
    figure, axes = _figure(10.5, max(6.0, 2 + 0.2 * len(methods)), "Speed against the error of a sum over neighbors")

    def error(row: SearchRow) -> float | None:
        known = [value for value in (row.density_error, row.jump_error) if value is not None]
        return max(known) if known else None

    _scatter(axes, rows, error, lambda row: row.median_s)
    axes.set_xscale("symlog", linthresh=1e-8)
    axes.set(yscale="log", xlim=(-5e-9, 1), ylabel=SECONDS.split(";")[0])
    axes.set_xlabel(
        "largest error of a particle, over the mean: of unit vectors, which jump at the cutoff; of pair-sum, its density"
    )
    axes.axvline(0, color="0.6", linewidth=0.8, zorder=0.5)
    label_logarithmic(axes.yaxis)
    _legend(axes, methods, [])
    return figure


def _scatter(axes: Axes, rows: list[SearchRow], x: Value, y: Value) -> None:
    """Draw a mark per row, larger for more points; rows that lack a value are left out."""
    methods = _methods(rows)
    for row in rows:
        place, height = x(row), y(row)
        if place is None or not height or not row.points:
            continue
        style = {"color": _color(row.method, methods), "marker": _marker(row.method), "alpha": 0.8, "linewidths": 0.5}
        axes.scatter(place, height, s=15 + 9 * math.log2(max(row.points / 1000, 1)), edgecolor="white", **style)
