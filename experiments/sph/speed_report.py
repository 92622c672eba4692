"""What rows of `sph speed` say: a table; pictures of where a step's time goes, and of error against seconds."""

from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from experiments._look import COLORS, MARKERS, dress, factor, make_axes, write_names
from experiments.sph.speed import StepRow
from experiments.sph.stages import STAGES

_HATCHES = ("", "///", "...", "xxx", "")


def report(rows: list[StepRow], folder: Path) -> str:
    """Write table.csv, stages.png and tradeoff.png into the folder, as far as there are rows, and return tables as text."""
    texts = []
    for kind, lines in (("step", steps(rows)), ("stages", stages(rows)), ("tradeoff", tradeoff(rows))):
        if lines:
            frame = pd.DataFrame(lines)
            frame.to_csv(folder / f"{kind}.csv", index=False)
            texts.append(frame.to_string(index=False, na_rep="", float_format="%.3g"))
    for name, draw in (("stages", draw_stages), ("tradeoff", draw_tradeoff)):
        if good := [row for row in rows if row.kind == name and row.status == "ok"]:
            draw(good).savefig(folder / f"{name}.png", dpi=110)
    return "\n\n".join(texts)


def steps(rows: list[StepRow]) -> list[dict[str, Any]]:
    """Return a line per way and scene; `faster` is how many times faster the scene's first way is."""
    lines, first = [], {}
    for row in (row for row in rows if row.kind == "step"):
        best = first.setdefault((row.scene, row.nx), row.median_s)
        faster = row.median_s / best if row.median_s and best else None
        line = {
            "particles": row.particles,
            "way": row.way,
            "steps/s": row.steps_per_s,
            "particle-steps/s": row.particle_steps_per_s,
        }
        line |= {"faster": faster, "rebuilds": row.rebuilds, "MB": row.bytes and row.bytes / 1e6, "roundings": row.difference}
        lines.append(line | {"status": row.outcome})
    return lines


def stages(rows: list[StepRow]) -> list[dict[str, Any]]:
    """Return a line per way and scene, milliseconds by stage."""
    of = [row for row in rows if row.kind == "stages"]
    return [
        {"particles": row.particles, "way": row.way}
        | {f"{name} [ms]": 1e3 * row.parts[name] if row.parts else None for name in STAGES}
        | {"status": row.outcome}
        for row in of
    ]


def tradeoff(rows: list[StepRow]) -> list[dict[str, Any]]:
    """Return a line per run with a known answer."""
    of = [row for row in rows if row.kind == "tradeoff"]
    return [
        {"nx": row.nx, "dtype": row.dtype, "way": row.way, "skin": row.skin, "steps": row.steps, "seconds": row.seconds}
        | row.error
        | {"rebuilds": row.rebuilds, "status": row.outcome}
        for row in of
    ]


def draw_stages(rows: list[StepRow]) -> Figure:
    """Draw where a step's time goes, nanoseconds per particle, a bar for each way and scene; each has its own scale."""
    figure = Figure(figsize=(6.4, 1.2 + 0.85 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), squeeze=False)[:, 0]
    for axes, row in zip(panels, rows, strict=True):
        left, name = 0.0, f"{row.way}\n{row.particles:,}".replace(",", "\u2009")
        for color, hatch, stage in zip(COLORS[:5], _HATCHES, STAGES, strict=True):
            width = 1e9 * max(row.parts[stage], 0.0) / (row.particles or 1)
            axes.barh([name], [width], left=left, color=color, label=stage, hatch=hatch, edgecolor="white")
            left += width
        axes.set_xlim(0, left)
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time of a step [ns per particle]")
    panels[0].set_title(f"{rows[0].scene}, {rows[0].dtype}, {rows[0].device}", fontsize=10)
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(STAGES), frameon=False, fontsize=8)
    return figure


def draw_tradeoff(rows: list[StepRow]) -> Figure:
    """Draw the error of velocities over the seconds of a run: a line per precision and skin, a mark per resolution."""
    lines: dict[tuple[str, float | None], list[StepRow]] = {}
    for row in rows:
        lines.setdefault((row.dtype, row.skin), []).append(row)
    last = {kind: of[-1] for kind, of in lines.items()}
    errors = [row.error["l2 of velocity"] for row in last.values()]
    seconds = [row.seconds or 0 for row in last.values()]
    ratio = factor(max(seconds) / min(seconds)) if min(seconds) else "many"
    spread = " to ".join(dict.fromkeys(f"{each:.2g}" for each in (min(errors), max(errors))))
    title = f"At {rows[-1].nx}² particles all ways err by {spread}, and the slowest takes {ratio} times as long as the fastest"
    figure, axes = make_axes(title, 4.4)
    skins = sorted({skin for _, skin in lines}, key=lambda skin: skin or 0)
    ends = []
    for (dtype, skin), of in lines.items():
        x, y = [row.seconds or 0 for row in of], [row.error["l2 of velocity"] for row in of]
        color, marker = COLORS[skins.index(skin)], MARKERS[skins.index(skin)]
        axes.plot(x, y, "--" if dtype == "float64" else "-", marker=marker, color=color)
        ends.append((f"{dtype}, {f'list, skin {skin:g}' if skin else 'pair_sum'}", x[-1], y[-1], color))
    for row in (row for row in rows if (row.dtype, row.skin) == (rows[0].dtype, rows[0].skin)):
        at = row.seconds or 0, row.error["l2 of velocity"]
        axes.annotate(f"{row.nx}²", at, xytext=(4, 4), textcoords="offset points", fontsize=8)
    dress(axes, f"run, compilation left out [s]; Taylor-Green vortices, Re = 100, {rows[0].device}", "velocity, relative L2 error")
    write_names(axes, ends)
    return figure
