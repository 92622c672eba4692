"""The thesis's figures 6.1 to 6.8 drawn again: its numbers hollow, ours filled beside them."""

import io
from collections.abc import Iterable
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from experiments import _look, _thesis

Frame = Any  # a pd.DataFrame; what its columns hold, its annotations do not know
SHOWN = {"CLL": ("cll",), "ANN-NL": ("ann-kd-nolist", "scipy-kdtree-nolist"), "ANN": ("ann-kd-naive", "ann-kd", "scipy-kdtree")}
"""Methods of the thesis, and which of ours stands beside each: the first that has rows."""
COLORS: dict[str, str] = dict(zip(("CLL", "ANN-NL", "ANN"), _look.COLORS, strict=False))
HATCHES = {"CLL": "", "ANN-NL": "///", "ANN": "..."}


def compare_entries(table: Frame) -> Frame:
    """Return a line for each entry of Table 6.1: layout, fill [%], method, times [s] and memories [MB] of both, parts of the times.

    The table is that of `_study.table`; ours is NaN where it has no such row.
    """
    good, lines = table[table.status == "ok"], []
    for (layout, percent, method), figures in _thesis.table().items():
        here = good[(good.layout == layout) & ((100 * good.fill_asked + 1e-9).astype(int) == percent)]
        ours = next((name for name in SHOWN[method] if (here.method == name).any()), None)
        line: dict[str, Any] = {"layout": layout, "fill": percent, "method": method, "ours": ours}
        line |= {"thesis_s": figures.seconds, "thesis_mb": figures.megabytes}
        line |= {f"thesis_{name}": seconds for name, seconds in figures.parts.items()}
        row = here[here.method == ours].iloc[0] if ours else {}
        line |= {name: row.get(name, np.nan) for name in ("median_s", "low_s", "high_s", "search_mb", *figures.parts)}
        lines.append(line)
    made = pd.DataFrame(lines)
    made["scene"] = made.layout + made.fill.map(" {} %".format)
    return made


def bars(lines: Frame, ours: str, theirs: str, label: str, methods: Iterable[str], title: str) -> Figure:
    """Draw two bars for each method on each scene, of the columns `ours` and `theirs` of lines from `compare_entries`.

    To the title is added which method is first, here and in the thesis.
    """
    title = f"{title}. First is {_first(lines, ours, methods)} here, {_first(lines, theirs, methods)} in the thesis"
    methods = [name for name in methods if (lines.method == name).any()]
    scenes = list(dict.fromkeys(lines.scene))
    figure, axes = _axes(title, label)
    width = 0.8 / (2 * len(methods))
    for number, method in enumerate(methods):
        mine = lines[lines.method == method].set_index("scene").reindex(scenes)
        left = np.arange(len(scenes)) + (2 * number - len(methods)) * width
        style: Any = {"align": "edge", "edgecolor": COLORS[method]}
        axes.bar(left, mine[ours], width, **style, facecolor=COLORS[method], label=f"{method}: ours")
        axes.bar(left + width, mine[theirs], width, **style, fill=False, hatch=HATCHES[method], label=f"{method}: thesis")
    axes.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right")
    axes.set_ylim(top=8 * axes.get_ylim()[1])  # room for the legend
    axes.legend(fontsize=8, ncols=len(methods), loc="upper left", frameon=False)
    return figure


def _first(lines: Frame, column: str, methods: Iterable[str]) -> str:
    """Say which method takes least, and on how many of the scenes that have figures of all."""
    table = lines[lines.method.isin([*methods])].pivot(index="scene", columns="method", values=column)
    table = table.dropna(axis="columns", how="all").dropna()
    if table.empty:
        return "none"
    first = table.idxmin(axis="columns").value_counts()
    return f"{first.index[0]} on {first.iloc[0]} of {len(table)} scenes"


def split(lines: Frame, title: str) -> Figure:
    """Draw how the time of ANN with a list divides into counting, fetching and making the list, ours and the thesis's."""
    parts = {"t_ksearch": "#56B4E9", "t_frsearch": "#0072B2", "t_processing": "#E69F00"}
    mine = lines[lines.method == "ANN"].set_index("scene")
    figure, axes = _axes(title, "time [s]")
    for side, (prefix, hatch) in enumerate((("", None), ("thesis_", "//"))):
        for number, (part, color) in enumerate(parts.items()):
            place = np.arange(len(mine)) + 0.4 * side - 0.4 + 0.13 * number
            label = f"{part}: {'thesis' if prefix else 'ours'}"
            axes.bar(place, mine[prefix + part], 0.12, align="edge", color=color, hatch=hatch, edgecolor="white", label=label)
    axes.set_xticks(range(len(mine)), mine.index, rotation=30, ha="right")
    axes.set_ylim(top=30 * axes.get_ylim()[1])  # room for the legend
    axes.legend(fontsize=8, ncols=2, loc="upper left", frameon=False)
    return figure


def over_fill(lines: Frame, ours: str, theirs: str, label: str, methods: Iterable[str], title: str) -> Figure:
    """Draw the mean over layouts for each fill, ours as a line and the thesis's dashed."""
    figure, axes = _axes(title, label)
    for method in methods:
        means = lines[lines.method == method].groupby("fill")[[ours, theirs]].mean()
        axes.plot(means.index, means[ours], "o-", color=COLORS[method], label=f"{method}: ours")
        axes.plot(means.index, means[theirs], "o--", color=COLORS[method], markerfacecolor="white", label=f"{method}: thesis")
    axes.set(xscale="log", xlabel="fill [%]")
    axes.xaxis.set_major_formatter(_look.PLAIN)
    axes.legend(fontsize=8, frameon=False)
    return figure


def effect_bars(axes: Axes, made: Frame, factor: str, title: str) -> None:
    """Draw ratios with their intervals, a mark for each line of `_study.effects`; the title says what is beyond noise of 1."""
    found = ", ".join(dict.fromkeys(made.method[made.verdict == "beyond noise"])) or "nothing"
    title = fill(f"{title}; beyond noise: {found}", 80)
    methods = list(dict.fromkeys(made.method))
    values = list(dict.fromkeys(made[factor]))
    for number, value in enumerate(values):
        part = made[made[factor] == value]
        y = [methods.index(method) + 0.7 * ((number + 0.5) / len(values) - 0.5) for method in part.method]
        color, marker = (of[number % len(of)] for of in (_look.COLORS, _look.MARKERS))
        axes.hlines(y, part.low, part.high, color=color, linewidth=1.5)
        label = f"{factor} {value:g}" if isinstance(value, float) else str(value)
        axes.plot(part.ratio, y, marker, color=color, markersize=5, label=label)
    axes.axvline(1, color="0.5", linewidth=0.8)
    axes.set_yticks(range(len(methods)), methods)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set(xlabel="ratio of times")
    if made.ratio.max() > 3 * made.ratio.min() or made.high.max() > 5:
        axes.set_xscale("log")
        _look.label_logarithmic(axes.xaxis)
        axes.xaxis.set_minor_locator(NullLocator())
    axes.legend(fontsize=8, frameon=False)


def show(figure: Figure) -> None:
    """Put a figure into the output of a notebook's cell."""
    from IPython.display import Image, display

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=90)
    display(Image(stream.getvalue()))


def _axes(title: str, label: str) -> tuple[Figure, Axes]:
    figure, axes = _look.make_axes(title, 4.8)
    axes.set(yscale="log", ylabel=label)
    axes.yaxis.set_major_formatter(_look.PLAIN)
    return figure, axes
