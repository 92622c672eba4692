"""What rows of `sph speed` say: a table; pictures of where a step's time goes, and of error against seconds."""

from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from experiments._plots import COLORS, OTHER_COLORS, dress
from experiments.sph.speed import StepRow
from experiments.sph.stages import STAGES

_PALETTE = (*COLORS.values(), *OTHER_COLORS)
_MARKERS = "o^sDvX*P"


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
        for color, stage in zip(_PALETTE, STAGES, strict=False):
            width = 1e9 * max(row.parts[stage], 0.0) / (row.particles or 1)
            axes.barh([name], [width], left=left, color=color, label=stage)
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
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes, lines = figure.add_subplot(), {}
    for row in rows:
        lines.setdefault((row.dtype, row.skin), []).append(row)
    skins = sorted({skin for _, skin in lines})
    for (dtype, skin), of in lines.items():
        seconds, error = [row.seconds for row in of], [row.error["l2 of velocity"] for row in of]
        label = f"{dtype}, {f'list, skin {skin:g} spacings' if skin else 'pair_sum'}"
        k = skins.index(skin)
        axes.plot(seconds, error, "--" if dtype == "float64" else "-", marker=_MARKERS[k], color=_PALETTE[k], label=label)
    for row in (row for row in rows if (row.dtype, row.skin) == (rows[0].dtype, rows[0].skin)):
        at = row.seconds or 0, row.error["l2 of velocity"]
        axes.annotate(f"{row.nx}²", at, xytext=(4, 4), textcoords="offset points", fontsize=8)
    dress(axes, "run, compilation left out [s]", "velocity, relative L2 error")
    axes.set_title(f"Taylor-Green vortices, Re = 100, {rows[0].device}", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    return figure
