"""The pictures that lead the pages of benchmarks, each library in a color of its own; and two sketches.

They are drawn from rows whenever the pages are built, so that no picture is older than its rows.
"""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from experiments._look import OURS, PEER, PEERS_COLORS, dress, factor, head, plain, write_names
from experiments.pages import cpu, liquid, options
from experiments.pages.rows import machine, number, one, read, whole

_CPU = ("pair-sum", "warp", "cll", "vesin", "matscipy-neighbours", "scipy-kdtree", "nanoflann-cpp", "nvalchemi")
_COUNTERS = {"scipy": "SciPy", "hashgrid": "wp.HashGrid"}
_SPREAD = {  # columns of options, what they are called, and how their lines look
    **{"list_s": ("jfrnn, list", "-o"), "count_s": ("jfrnn, counts", "-s"), "sum_s": ("jfrnn, sum", "-D")},
    **{"beside_count_s": ("one cutoff", ":v"), "scipy_s": ("SciPy", "-^"), "hashgrid_s": ("wp.HashGrid", "-P")},
}
_LIQUID = {  # ways, and how their lines look
    **{"pair_sum, list": "-o", "pair_sum, list, float64": "--o", "pair_sum": "-s", "distances, grad": "-D"},
    **{"OpenMM": "-^", "LAMMPS lj/cut": "-P", "LAMMPS lj/mdf": "--P", "jax-md dense": "-v", "jax-md ordered sparse": "--v"},
}
_GPU = {
    "jfrnn warp": "jfrnn, list",
    "warp HashGrid": "wp.HashGrid, without JAX",
    "nvalchemi 0.5.0 cell_list": "nvalchemi, cell_list",
}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"steps": _steps(), "spread": _spread(), "liquid": _liquid()}
    for name, make in {"cpu": _cpu, "gpu": _gpu, "cells": _cells, "halo": _halo}.items():
        figures[name] = Figure(figsize=(7.0, 4.2), layout="constrained")
        make(figures[name].add_subplot())
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


def _cpu(axes: Axes) -> None:
    """Draw milliseconds of a search; what is wrong is hollow, and says how wrong."""
    rows = [row for method in _CPU if (row := one(read("thesis_cpu/table.csv"), scene="full 100 %", method=method))]
    rows.sort(key=lambda row: -float(row["median_s"]))
    for place, row in enumerate(rows):
        ms, color = 1e3 * float(row["median_s"]), OURS if row["method"] in cpu.OURS else PEER
        wrong = [f"{whole(row[kind])} {kind}" for kind in ("missing", "extra") if row[kind] not in ("0", "")]
        axes.plot(ms, place, "o", ms=9, color=color, mfc="white" if wrong else color)
        said = f"{number(ms)} ms" + (f": {', '.join(wrong)}" if wrong else "")
        axes.annotate(said, (ms, place), (10, 0), textcoords="offset points", va="center", color=color, fontsize=9)
    axes.set_yticks(range(len(rows)), [cpu.name_of(row["method"]).replace("`", "") for row in rows])
    axes.set(xscale="log", xlim=(20, 60_000), xlabel="milliseconds of a search, 250 000 particles, 2 cores")
    axes.xaxis.set_major_formatter(lambda ms, _: plain(ms))
    others = {row["method"]: float(row["median_s"]) for row in rows if row["method"] not in cpu.OURS}
    first, ours = min(others, key=lambda name: others[name]), one(rows, method="warp") or {}
    brief = cpu.name_of(first).partition(" (")[0]
    said = f"jfrnn's list is exact and {factor(others[first] / float(ours['median_s']))} times as fast as {brief}"
    _entitle(axes, f"{said}, the next. Hollow: pairs missing or extra")
    _clear(axes)


def _gpu(axes: Axes) -> None:
    """Draw milliseconds of a list over particles, names at the ends of lines, and the floor: its bytes over the bandwidth.

    These are 12 B of a position, and 4 B of a count and of each slot; the bandwidth is what a copy reached in the same run.
    """
    rows = read("h200/rows.jsonl")
    bandwidth = (one(rows, kind="ceiling") or {})["bytes_per_s"]
    rows = [row for row in rows if row["kind"] == "call" and row.get("median_s")]
    ends, found = [], {}
    for method, title in _GPU.items():
        found[method] = {row["points"]: 1e3 * row["median_s"] for row in rows if row["method"] == method}
        x, y = zip(*sorted(found[method].items()), strict=True)
        color, marker = (OURS, "o") if title.startswith("jfrnn") else (PEERS_COLORS[len(ends) - 1], "s" if "Hash" in title else "^")
        axes.plot(x, y, color=color, marker=marker)
        ends.append((title, x[-1], y[-1], color))
    floor = {
        row["points"]: 4e3 * row["points"] * (4 + row["capacity"]) / bandwidth for row in rows if row["method"] == "jfrnn warp"
    }
    axes.plot(*zip(*sorted(floor.items()), strict=True), "--k")
    ends.append(("floor: bytes / bandwidth", *max(floor.items()), "k"))
    axes.set(xscale="log", yscale="log", xlabel="particles, 108 neighbors on average, one H200", ylabel="milliseconds of a list")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: plain(value))
    ours, *others = found.values()
    spans = [sorted(of[n] / ours[n] for n in of if n in ours) for of in others]
    said = [
        f"{factor(span[0])} to {factor(span[-1])} times as fast as {title}"
        for span, title in zip(spans, ("wp.HashGrid", "nvalchemi"), strict=True)
    ]
    _entitle(axes, f"jfrnn's list is {', '.join(said)}")
    write_names(axes, ends)
    _clear(axes)


def _liquid() -> Figure:
    """Draw steps per second of a Lennard-Jones liquid over particles, a line for each way, a panel for each machine."""
    figure = Figure(figsize=(7.0, 0.5 + 3.2 * len(liquid.MACHINES)), layout="constrained")
    libraries = list(dict.fromkeys(who.partition(" ")[0] for who in _LIQUID if who not in liquid.OURS))
    for axes, platform in zip(np.ravel(figure.subplots(len(liquid.MACHINES))), liquid.MACHINES, strict=True):
        rows, ends = liquid.rows_of(platform), []
        for who, style in _LIQUID.items():
            points = [(n, float(row["steps_per_s"])) for n, row in sorted(liquid.speeds(rows, who).items())]
            if points:
                color = OURS if who in liquid.OURS else PEERS_COLORS[libraries.index(who.partition(" ")[0])]
                axes.plot(*zip(*points, strict=True), style, color=color, ms=5)
                ends.append((f"jfrnn, {who}" if who in liquid.OURS else who, *points[-1], color))
        dress(axes, f"particles, {machine(rows)}", "steps per second")
        axes.set_title(fill(f"jfrnn's list: {liquid.said(platform)}", 90, break_on_hyphens=False), loc="left", fontsize=9)
        write_names(axes, ends)
    head(figure, "Steps per second of a Lennard-Jones liquid, over particles")
    return figure


def _spread() -> Figure:
    """Draw milliseconds over the largest cutoff over the least, a panel for each machine that was measured."""
    found = [(where, rows) for where in options.machines() if (rows := options.spread_rows(where))]
    figure = Figure(figsize=(7.0, 0.5 + 3.2 * len(found)), layout="constrained")
    spans = []
    for axes, (where, rows) in zip(np.ravel(figure.subplots(len(found), squeeze=False)), found, strict=True):
        ends = []
        for column, (title, style) in _SPREAD.items():
            points = [(float(row["spread"]), 1e3 * float(row[column])) for row in rows if row.get(column)]
            if points:
                color = OURS if title.startswith("jfrnn") else PEER
                axes.plot(*zip(*points, strict=True), style, color=color, ms=5)
                ends.append((title, *points[-1], color))
        dress(axes, "largest cutoff over the least", "milliseconds")
        said = f"{whole(rows[0]['n'])} uniform points, about 30 neighbors each, {where.name}"
        axes.set_title(said, loc="left", fontsize=9)
        write_names(axes, ends)
        behind = {peer: sorted(float(row[f"{peer}_behind"]) for row in rows if row.get(f"{peer}_behind")) for peer in _COUNTERS}
        said = [f"{_COUNTERS[peer]} takes {factor(of[0])} to {factor(of[-1])} times" for peer, of in behind.items() if of]
        spans.append(f"{' and '.join(said)} on {'an ' if where.name.startswith('H') else ''}{where.name}")
    head(figure, f"To count within a cutoff per particle, {', '.join(spans)} what jfrnn takes")
    return figure


def _cells(axes: Axes) -> None:
    """Draw a query, its circle, and the runs of cells that hold its candidates."""
    x = np.random.default_rng(3).uniform((0, 0), (8, 5), (150, 2))
    query = np.array([4.3, 2.6])
    row = np.floor(query[1])
    near = np.hypot(*(x - query).T) < 1
    candidate = (np.abs(np.floor(4 * x[:, 0]) - np.floor(4 * query[0])) <= 4) & (np.abs(np.floor(x[:, 1]) - row) <= 1)
    for k in (-1, 0, 1):
        first, last = (np.floor(4 * query[0]) - 4) / 4, (np.floor(4 * query[0]) + 5) / 4
        axes.add_patch(Rectangle((first, row + k), last - first, 1, color="#56b4e9", alpha=0.35, lw=0))
        axes.annotate(f"run {int(k) + 2}", (last, row + k + 0.5), (6, 0), textcoords="offset points", va="center", color=OURS)
    axes.plot(*x[~candidate].T, ".", color="0.7")
    axes.plot(*x[candidate & ~near].T, ".", color=OURS)
    axes.plot(*x[near].T, "o", color="#d55e00", ms=5)
    axes.plot(*query, "k+", ms=10, mew=2)
    axes.add_patch(Circle((query[0], query[1]), 1, fill=False, color="k"))
    axes.set(xticks=range(9), yticks=range(6), xlim=(0, 8), ylim=(0, 5), aspect="equal")
    axes.tick_params(labelbottom=False, labelleft=False, length=0)
    axes.grid(alpha=0.5)
    _entitle(axes, "Cells as wide as the cutoff; three runs of candidates (blue), neighbors in orange")


def _steps() -> Figure:
    """Draw the four steps of the array engine, for forty particles and one query, with cells undivided along x."""
    across, down = 6, 4
    x = np.random.default_rng(7).uniform((0.15, 0.15), (across - 0.15, down - 0.15), (40, 2))
    cells = np.floor(x[:, 0]).astype(int) + across * np.floor(x[:, 1]).astype(int)
    order = np.argsort(cells, kind="stable")
    x, cells = x[order], cells[order]  # as the engine has them: a particle's index is its place in the order
    query = int(np.argmin(np.hypot(*(x - (3.4, 1.6)).T)))
    first = cells[query] - 1 + across * np.array([-1, 0, 1])
    runs = [np.flatnonzero((cells >= cell) & (cells <= cell + 2)) for cell in first]
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    sort, stencil, gather, compact = figure.subplots(2, 2, height_ratios=(3, 2)).ravel()
    for axes in (sort, stencil):
        axes.set(xticks=range(across + 1), yticks=range(down + 1), xlim=(0, across), ylim=(0, down), aspect="equal")
        axes.tick_params(labelbottom=False, labelleft=False, length=0)
        axes.grid(alpha=0.6)
    for cell in range(across * down):
        sort.text(cell % across + 0.04, cell // across + 0.04, str(cell), fontsize=6, color="0.5")
    for k, at in enumerate(x):
        sort.text(*at, str(k), fontsize=7, color=OURS, ha="center", va="center", clip_on=True)
    for k, (cell, run) in enumerate(zip(first, runs, strict=True), start=1):
        left, low = cell % across, cell // across
        stencil.add_patch(Rectangle((left, low), 3, 1, color="#56b4e9", alpha=0.35, lw=0))
        stencil.text(left - 0.1, low + 0.5, f"run {k}:\n{run[0]} to {run[-1]}", fontsize=8, va="center", ha="right", color=OURS)
    stencil.plot(*x.T, ".", color="0.5", ms=4)
    stencil.plot(*x[query], "k+", ms=10, mew=2)
    stencil.add_patch(Circle((x[query, 0], x[query, 1]), 1, fill=False))
    _draw_rows(gather, compact, [[int(k) for k in run] for run in runs], np.hypot(*(x - x[query]).T) < 1, query)
    titles = ("1. Sort particles by the number of their cell", "2. Three runs around a query", "3. A bit for each candidate")
    for axes, title in zip((sort, stencil, gather, compact), (*titles, "4. Set bits become a padded row"), strict=True):
        axes.set_title(title, loc="left", fontsize=9, fontweight="bold")
    return figure


def _draw_rows(gather: Axes, compact: Axes, runs: list[list[int]], near: np.ndarray, query: int) -> None:
    """Draw a box for each candidate of each run, filled where it is a neighbor, and the row of neighbors."""
    found = [k for run in runs for k in run if near[k] and k != query]
    padded = [*found, len(near), len(near)]
    for axes, rows in ((gather, runs), (compact, [padded])):
        for row, indices in enumerate(rows):
            for place, k in enumerate(indices):
                face, ink = (OURS, "white") if k in found else ("white", "0.4")
                axes.add_patch(Rectangle((place, -row), 0.9, 0.9, facecolor=face, edgecolor="0.5"))
                axes.text(place + 0.45, 0.45 - row, str(k), ha="center", va="center", fontsize=8, color=ink)
        axes.set(xlim=(-0.2, max(map(len, rows)) + 0.2), ylim=(-len(rows) + 0.8, 1.2), aspect="equal")
        axes.set_axis_off()


def _halo(axes: Axes) -> None:
    """Draw particles of four devices, and the halo of one of them."""
    x = np.random.default_rng(4).normal((4, 2.5), (1.6, 0.9), (600, 2))
    bounds = np.quantile(x[:, 0], (0.25, 0.5, 0.75))
    owner = np.searchsorted(bounds, x[:, 0])
    mine = x[owner == 1]
    low, high = mine[:, 0].min() - 0.4, mine[:, 0].max() + 0.4
    halo = (owner != 1) & (x[:, 0] > low) & (x[:, 0] < high)
    axes.plot(*x[(owner != 1) & ~halo].T, ".", color="0.75")
    axes.plot(*x[halo].T, "x", color="#d55e00", ms=4)
    axes.plot(*mine.T, ".", color=OURS)
    for bound in bounds:
        axes.axvline(bound, color="0.3", lw=1)
    axes.axvspan(low, high, color="#56b4e9", alpha=0.15, lw=0)
    axes.set(aspect="equal", xticks=[], yticks=[])
    _entitle(axes, "Four devices, equally many particles each; one of them (blue) and its halo (crosses)")


def _entitle(axes: Axes, title: str) -> None:
    assert isinstance(axes.figure, Figure)
    head(axes.figure, title)


def _clear(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="x", alpha=0.3)
