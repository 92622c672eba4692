"""The pictures of a report, drawn from rows alone: eight methods at most in those that lead, all of them in small panels."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from statistics import geometric_mean
from textwrap import fill
from typing import Any

from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from experiments import _look, _table, _thesis
from experiments._rows import SearchRow

Value = Callable[[SearchRow], float | None]
Lines = dict[str, dict[int, float]]  # by method: values by place
MOST_SCENES = 14  # side by side; where there are more, each layout has one place


@dataclass(frozen=True)
class Quantity:
    """What is drawn of rows: its value and label, what the thesis says of it, and which headline it gets (`fast` or `lean`)."""

    value: Value
    label: str
    thesis: Callable[[_thesis.Figures], float]
    what: str


def _memory(row: SearchRow) -> float | None:
    return _table.megabytes(row.search_bytes or row.peak_bytes)


TIME = Quantity(attrgetter("median_s"), "time of a search [s]", attrgetter("seconds"), "fast")
MEMORY = Quantity(_memory, "peak memory of a search [MB]", attrgetter("megabytes"), "lean")


def draw_all(rows: Sequence[SearchRow], folder: Path, origin: str) -> list[Path]:
    """Draw every picture into the folder, with its origin below, and return their paths; none where no row has figures."""
    good = _table.in_order([row for row in rows if row.status == "ok"])
    wanted: tuple[tuple[str, Value, Callable[[], Figure]], ...] = (
        ("runtime_by_layout", TIME.value, partial(by_layout, good, TIME)),
        ("memory_by_layout", MEMORY.value, partial(by_layout, good, MEMORY)),
        ("runtime_by_fill", TIME.value, partial(by_fill, good, TIME)),
        ("memory_by_fill", MEMORY.value, partial(by_fill, good, MEMORY)),
        ("speed_against_error", TIME.value, partial(against_error, good, TIME)),
        ("memory_against_error", MEMORY.value, partial(against_error, good, MEMORY)),
        ("speed_against_sum_error", _sum_error, partial(against_sum_error, good)),
        ("runtime_of_all", TIME.value, partial(of_all, good, TIME)),
        ("memory_of_all", MEMORY.value, partial(of_all, good, MEMORY)),
    )
    paths = []
    for name, value, draw in wanted:
        if any(value(row) is not None for row in good):
            figure = draw()
            below = f"{figure.get_supxlabel()}\n{fill(origin, 130)}".strip()
            figure.supxlabel(below, x=0.015, ha="left", fontsize=6.5, color="0.35")
            paths.append(folder / f"{name}.png")
            figure.savefig(paths[-1], dpi=160)
    return paths


def _only(found: dict[str, dict[str, float]], chosen: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return what was found of the methods of a picture: its title is about nothing else."""
    return {place: {name: value for name, value in of.items() if name in chosen} for place, of in found.items()}


def _beside(rows: Sequence[SearchRow]) -> bool:
    """Whether most times were measured beside other work, or too briefly to tell."""
    marked = sum(row.others_cores is None or row.others_cores > _table.NOTEWORTHY_CORES for row in rows)
    return 2 * marked > len(rows)


def by_layout(rows: Sequence[SearchRow], quantity: Quantity) -> Figure:
    """Draw a line per method over scenes, or over layouts where scenes are many."""
    whole, lines, found = _by_place(rows, quantity.value)
    names, shared = _shorten(whole)
    chosen = [name for name in _look.choose(_methods(rows)) if lines.get(name)]
    scenes = "layouts" if len({row.scene_key for row in rows}) > MOST_SCENES else "scenes"
    figure, axes = _look.make_axes(_look.headline(_only(found, chosen), quantity.what, scenes, _beside(rows)), 4.8)
    for name in reversed(chosen):  # ours on top
        axes.plot(*zip(*sorted(lines[name].items()), strict=True), **_style(name, chosen))
    _make_room(axes, [value for name in chosen for value in lines[name].values()])
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8, rotation_mode="anchor")
    axes.set(yscale="log", xlim=(-0.3, len(names) - 0.7), xlabel=shared, ylabel=quantity.label)
    _look.label_logarithmic(axes.yaxis)
    last = {name: max(lines[name].items()) for name in chosen}
    _look.write_names(axes, [(_look.name_of(name), *end, _look.color_of(name, chosen)) for name, end in last.items()])
    return figure


def by_fill(rows: Sequence[SearchRow], quantity: Quantity) -> Figure:
    """Draw over fill the geometric mean of the layouts that are asked to fill the same, with a bar from the least to the most."""
    filled = [row for row in rows if row.fill]
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    fills: dict[str, list[float]] = defaultdict(list)
    for row in filled:
        if value := quantity.value(row):
            found[f"{row.fill_asked}"][row.method].append(value)
            fills[f"{row.fill_asked}"].append(100 * (row.fill or 1))
    means = {asked: {name: geometric_mean(values) for name, values in of.items()} for asked, of in found.items()}
    places = {asked: geometric_mean(values) for asked, values in fills.items()}
    chosen = _look.choose(name for name in _methods(filled) if any(name in of for of in means.values()))
    said = _look.headline(_only(means, chosen), quantity.what, "fills", _beside(filled))
    figure, axes = _look.make_axes(f"{said} (means of layouts)", 4.4)
    ends = []
    for name in chosen:
        line = sorted((places[asked], of[name], found[asked][name]) for asked, of in means.items() if name in of)
        x, y, values = zip(*line, strict=True)
        axes.vlines(x, [min(of) for of in values], [max(of) for of in values], color=_look.color_of(name, chosen), linewidth=1)
        axes.plot(x, y, **_style(name, chosen))
        ends.append((_look.name_of(name), x[-1], y[-1], _look.color_of(name, chosen)))
    if places:
        axes.set_xlim(min(places.values()) / 1.25, max(places.values()) * 1.25)
    _make_room(axes, [value for of in found.values() for values in of.values() for value in values])
    axes.set(xscale="log", yscale="log", xlabel="fill: points / points of the full domain [%]", ylabel=quantity.label)
    axes.xaxis.set_major_locator(FixedLocator(_apart(places.values(), 0.07)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda percent, _: f"{percent:.3g}")
    _look.label_logarithmic(axes.yaxis)
    _look.write_names(axes, ends)
    return figure


def against_error(rows: Sequence[SearchRow], quantity: Quantity) -> Figure:
    """Draw a value of the scene that most methods searched over wrong pairs: what is exact in lines of its own, in order."""
    scene = _fullest_scene(row for row in rows if quantity.value(row) and row.errors is not None)
    lists = {row.method: row for row in scene if row.method not in _look.WITHOUT_LIST} or {row.method: row for row in scene}
    drawn = [lists[name] for name in _look.choose(row.method for row in scene) if name in lists]
    exact, wrong = [row for row in drawn if not row.errors], [row for row in drawn if row.errors]
    title = f"{len(exact)} of the {len(drawn)} lists drawn {'is' if len(exact) == 1 else 'are'} exact"
    title = title if len(drawn) > 1 else quantity.label.split(" [")[0].capitalize()
    if exact and wrong and not (quantity is TIME and _beside(scene)):
        best, other = (min(of, key=lambda row: quantity.value(row) or 0) for of in (exact, wrong))
        ratio = _look.factor((quantity.value(other) or 0) / (quantity.value(best) or 1))
        least, times = {"fast": ("fastest", "times as long as"), "lean": ("leanest", "times the memory of")}[quantity.what]
        title += f"; the {least} of the others, {_look.spoken(other.method)}, takes {ratio} {times} {_look.spoken(best.method)}"
    label = f"{quantity.label}; {scene[0].scene_name}, {_look.plain(scene[0].points or 0)} points" if scene else quantity.label
    return _strip(scene, quantity.value, lambda row: row.errors, title, label, "missing and extra pairs; fewer is better")


def against_sum_error(rows: Sequence[SearchRow]) -> Figure:
    """Draw time over the largest error of a sum over neighbors: what wrong pairs do, and rounding to sums without a list."""
    scene = _fullest_scene(row for row in rows if row.median_s and _sum_error(row) is not None)
    worst = max((row.jump_error or 0.0 for row in scene), default=0.0)
    title = f"Wrong pairs change a sum that jumps at the cutoff by up to {100 * worst:.2g} % of its mean"
    title = title if worst else "No wrong pair, and so no error of a sum that jumps at the cutoff"
    rounding = max((row.density_error or 0.0 for row in scene if row.method == "pair-sum"), default=0.0)
    title += f"; rounding changes the density of pair_sum by {rounding:.0e}" if rounding else ""
    label = f"{TIME.label}; {scene[0].scene_name}, {_look.plain(scene[0].points or 0)} points"
    return _strip(scene, TIME.value, _sum_error, title, label, "error of a sum, over its mean; less is better")


def of_all(rows: Sequence[SearchRow], quantity: Quantity) -> Figure:
    """Draw a panel for each method over all scenes, others in grey: hollow marks have wrong pairs, dashes are the thesis's."""
    names, lines, _ = _by_place(rows, quantity.value)
    wrong = {(row.method, place) for row, place in _places(rows) if row.errors}
    methods = sorted((name for name in lines if lines[name]), key=lambda name: (not _look.is_ours(name), _last(lines[name])))
    across = min(4, len(methods))
    down = math.ceil(len(methods) / across)
    figure = Figure(figsize=(_look.WIDTH, 1.6 + 1.3 * down), layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    theirs = {name: line for name, line in _theirs(rows, quantity).items() if len(line) > 1}
    faint = [sorted(line.items()) for line in lines.values()]
    for axes, method in zip(panels, methods, strict=False):
        _look.clear(axes)
        axes.add_collection(LineCollection(faint, colors=_look.FAINT, linewidths=0.7))
        if method in theirs:
            axes.plot(*zip(*sorted(theirs[method].items()), strict=True), color=_look.COLORS[1], linestyle="--", linewidth=1)
        color = _look.OURS if _look.is_ours(method) else "k"
        x, y = zip(*sorted(lines[method].items()), strict=True)
        axes.plot(x, y, color=color, linewidth=1.3)
        for place, value in zip(x, y, strict=True):
            axes.plot(place, value, "o", ms=3.5, color=color, mfc="white" if (method, place) in wrong else color)
        axes.set_title(_look.name_of(method), loc="left", fontsize=8, color=color, pad=2)
        _make_room(axes, [value for line in lines.values() for value in line.values()])
        axes.set(yscale="log", xticks=range(len(names)))
        axes.tick_params(labelsize=7)
        axes.set_xticklabels([str(k + 1) for k in range(len(names))], fontsize=5.5)
        axes.set_xlim(-0.5, len(names) - 0.5)
    for axes in panels[len(methods) :]:
        axes.remove()
    _look.label_logarithmic(panels[0].yaxis, 100)
    shown = f"All {len(methods)} methods: {quantity.label}. Hollow: pairs missing or extra"
    _look.head(figure, shown + ("; dashed: what the thesis reports, on its machine" if theirs else ""))
    figure.supxlabel(fill(" · ".join(f"{k}: {name}" for k, name in enumerate(names, start=1)), 130))
    return figure


def _methods(rows: Iterable[SearchRow]) -> list[str]:
    return list(dict.fromkeys(row.method for row in rows))


def _sum_error(row: SearchRow) -> float | None:
    known = [value for value in (row.density_error, row.jump_error) if value is not None]
    return max(known) if known else None


def _fullest_scene(rows: Iterable[SearchRow]) -> list[SearchRow]:
    """Return the rows of the scene that most of the methods that lead searched; of several, that with most points."""
    scenes: dict[Any, list[SearchRow]] = defaultdict(list)
    for row in rows:
        scenes[row.scene_key].append(row)
    leading = _look.choose(row.method for of in scenes.values() for row in of)
    return max(scenes.values(), key=lambda of: (sum(row.method in leading for row in of), of[0].points or 0), default=[])


def _places(rows: Sequence[SearchRow]) -> list[tuple[SearchRow, int]]:
    """Return each row and where it stands from left to right: by scene, or by layout where scenes are many."""
    keys = [row.scene_key for row in rows]
    keys = [row.layout for row in rows] if len(set(keys)) > MOST_SCENES else keys
    places = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return [(row, places[key]) for row, key in zip(rows, keys, strict=True)]


def _by_place(rows: Sequence[SearchRow], value: Value) -> tuple[list[str], Lines, dict[str, dict[str, float]]]:
    """Return names of places, the values of each method by place (means where a place holds several), and the same by place."""
    scenes, of_layouts = _table.name_scenes(rows), len({row.scene_key for row in rows}) > MOST_SCENES
    names: dict[int, str] = {}
    values: dict[tuple[str, int], list[float]] = defaultdict(list)
    for row, place in _places(rows):
        points = f"{_look.plain(row.points or 0)} points"
        names.setdefault(place, row.layout if of_layouts else f"{scenes[row.scene_key]}, {points}")
        if number := value(row):
            values[row.method, place].append(number)
    lines: Lines = {method: {} for method in _methods(rows)}
    found: dict[str, dict[str, float]] = {f"{place}": {} for place in names}
    for (method, place), numbers in values.items():
        lines[method][place] = found[f"{place}"][method] = geometric_mean(numbers)
    return list(names.values()), lines, {place: of for place, of in found.items() if of}


def _shorten(names: Sequence[str]) -> tuple[list[str], str]:
    """Return what tells scenes apart, a line for each part, and what they share."""
    parts = [name.split(", ") for name in names]
    shared = [part for part in parts[0] if all(part in of for of in parts)] if len(parts) > 1 else []
    return ["\n".join(part for part in of if part not in shared) for of in parts], ", ".join(shared)


def _theirs(rows: Sequence[SearchRow], quantity: Quantity) -> Lines:
    """Return the thesis's values by our method that is like its own."""
    found: Lines = defaultdict(dict)
    for ours, theirs in _thesis.counterparts(row.method for row in rows).items():
        for row, place in _places(rows):
            if (figures := _thesis.figures(row, theirs)) is not None:
                found[ours][place] = quantity.thesis(figures)
    return found


def _apart(places: Iterable[float], least: float) -> list[float]:
    """Return those of places on a logarithmic axis whose labels have room: each so much of the axis from the one before."""
    chosen: list[float] = []
    every = sorted(places)
    for place in every:
        if not chosen or math.log(place / chosen[-1]) >= least * math.log(every[-1] / every[0]):
            chosen.append(place)
    return chosen


def _last(line: dict[int, float]) -> float:
    return line[max(line)] / (1 + max(line))


def _style(method: str, chosen: Sequence[str], size: float = 6.5) -> Any:  # noqa: ANN401
    marker = _look.MARKERS[list(chosen).index(method) % len(_look.MARKERS)]  # no two of eight have the same
    style = {"color": _look.color_of(method, chosen), "marker": marker, "markersize": size}
    return style | {"linewidth": 2.0 if _look.is_ours(method) else 1.1, "markeredgecolor": "white", "markeredgewidth": 0.6}


def _make_room(axes: Axes, drawn: Sequence[float]) -> None:
    """Show what is about one and the same number: around that, Matplotlib finds no decade."""
    if drawn and max(drawn) < 1.01 * min(drawn):
        axes.set_ylim(min(drawn) / 2, max(drawn) * 2)


def _strip(scene: list[SearchRow], value: Value, error: Value, title: str, label: str, errors: str) -> Figure:
    """Draw values to the right: above, a line for each method without error, in order; below, errors downwards, names beside."""
    chosen = _look.choose(row.method for row in scene)
    marks = {row.method: (value(row) or 0.0, error(row) or 0.0) for row in scene if row.method in chosen}
    exact = sorted((name for name, (_, off) in marks.items() if not off), key=lambda name: marks[name])
    wrong = [name for name, (_, off) in marks.items() if off]
    heights = [0.27 * len(exact) + 0.1] * bool(exact) + [2.2] * bool(wrong) or [1.0]
    figure = Figure(figsize=(_look.WIDTH, 1.8 + sum(heights)), layout="constrained")
    _look.head(figure, title)
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes in panels:
        _look.clear(axes)
        axes.set(xscale="log")
    for place, name in enumerate(exact):
        panels[0].plot([marks[name][0]], [place], **_style(name, chosen, 8) | {"linestyle": "none"})
    if exact:
        panels[0].set(ylim=(len(exact) - 0.4, -0.6), facecolor="0.97", ylabel="exact" if len(exact) > 1 else "")
        panels[0].set_yticks(range(len(exact)), [_look.name_of(name) for name in exact])
        for text, name in zip(panels[0].get_yticklabels(), exact, strict=True):
            text.set(color=_look.color_of(name, chosen), fontweight="bold" if _look.is_ours(name) else "normal")
    for name in wrong:
        panels[-1].plot(*([number] for number in marks[name]), **_style(name, chosen, 8) | {"linestyle": "none"})
    if marks:
        panels[-1].set_xlim(min(at for at, _ in marks.values()) / 1.6, max(at for at, _ in marks.values()) * 1.6)
    panels[-1].set_xlabel(label)
    _look.label_logarithmic(panels[-1].xaxis, 200)
    if wrong:
        found = [marks[name][1] for name in wrong]
        room = max(2.0, (max(found) / min(found)) ** 0.15)  # for names above and below
        panels[-1].set(yscale="log", ylabel=fill(errors, 28), ylim=(max(found) * room, min(found) / room))
        figure.align_ylabels(panels)
        if min(found) >= 1:
            _look.label_logarithmic(panels[-1].yaxis)
        panels[-1].yaxis.set_minor_formatter(NullFormatter())
        _look.write_names_near(
            figure, panels[-1], [(_look.name_of(name), *marks[name], _look.color_of(name, chosen)) for name in wrong]
        )
    return figure
