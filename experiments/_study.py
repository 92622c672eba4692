"""What notebooks ask of the rows of sweeps: a table of rounds, and effects of one thing at a time with their uncertainty."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from experiments import _table
from experiments._errors import UsageError
from experiments._rows import SCENE_FIELDS, SearchRow, read_latest

RESULTS = Path(__file__).parent / "results"
Frame = Any  # a pd.DataFrame; what its columns hold, its annotations do not know


def rows(sweep: str) -> list[SearchRow]:
    """Return the committed rows of a sweep, by the name of its folder below experiments/results."""
    folder = RESULTS / sweep
    if not (found := read_latest(folder)):
        raise UsageError(f"{folder}: no rows; fill it with `python -m experiments run CONFIG.toml --out {folder}`")
    return found


def table(found: list[SearchRow]) -> Frame:
    """Return the lines of a report, one for each method on each scene."""
    return pd.DataFrame(_table.lines(found))


def rounds(found: list[SearchRow]) -> Frame:
    """Return a line per process with figures: method, scene, process, machine, median_s [s], search_mb [MB], pairs."""
    names = ("method", "layout", "fill_asked", *SCENE_FIELDS, "process", "points", "median_s", "pairs", "rebuilt")
    good = [row for row in found if row.status == "ok"]
    more = [{"machine": ", ".join(row.machine_kind), "search_mb": (row.search_bytes or np.nan) / 1e6} for row in good]
    lines = [{name: getattr(row, name) for name in names} | other for row, other in zip(good, more, strict=True)]
    return pd.DataFrame(lines, columns=[*names, "machine", "search_mb"])


class Effect(NamedTuple):
    """A ratio of two medians over rounds, the interval that holds it with 95 %, and how probable so much is without any effect."""

    ratio: float
    low: float
    high: float
    p: float
    rounds: int
    scenes: int

    def __str__(self) -> str:
        """Say it in a line."""
        if not np.isfinite(self.low):
            return f"{self.ratio:.3g} (too few rounds to say how sure)"
        verdict = "within noise" if self.low <= 1 <= self.high else "beyond noise"
        count = f"{self.rounds} rounds, {self.scenes} scene{'s' if self.scenes > 1 else ''}"
        return f"{self.ratio:.3g} [{self.low:.3g}, {self.high:.3g}], p = {self.p:.2g}, {verdict} ({count})"


def effect(lines: Frame, factor: str, before: object, after: object, value: str = "median_s") -> Effect | None:
    """Return value(after) / value(before) of scenes and methods that differ in one factor alone, None where there are none.

    The unit is the round: a geometric mean over its scenes, so that processes of one round, which share what the machine did then,
    count once; what machines of different kinds measured is not compared. Intervals and p: Student's t on the logarithms. Lines are
    those of `rounds`; all columns that describe the scene but the factor are the same.
    """
    chosen = lines[lines[factor].isin([before, after])]
    if chosen.empty:
        return None
    fixed = [name for name in ("method", "layout", "fill_asked", *SCENE_FIELDS) if name != factor]
    if factor == "layout":  # what only one of the layouts has is no other scene
        fixed = [name for name in fixed if name not in ("angle", "seed")]
    index = chosen[fixed].map(str).agg(" ".join, axis=1)
    wide = chosen.assign(scene=index).pivot_table(index=["process", "machine", "scene"], columns=factor, values=value)
    if before not in wide or after not in wide:
        return None
    logs = np.log(wide[after] / wide[before]).dropna()
    if logs.empty:
        return None
    means = logs.groupby(level="process").mean()
    count, scenes = len(means), logs.index.get_level_values("scene").nunique()
    if count < 2:
        return Effect(float(np.exp(means.mean())), np.nan, np.nan, np.nan, count, scenes)
    test: Any = stats.ttest_1samp(means, 0.0)
    low, high = test.confidence_interval(0.95)
    return Effect(float(np.exp(means.mean())), float(np.exp(low)), float(np.exp(high)), float(test.pvalue), count, scenes)


def effects(lines: Frame, factor: str, before: object, others: Sequence[object], value: str = "median_s") -> Frame:
    """Return a table of effects, a line for each method and each other value of a factor, with p adjusted for their number.

    Adjusted as Benjamini and Hochberg (1995) do: of the lines with `p_adjusted` below 5 %, one in twenty is there by chance.
    """
    found = []
    for method, part in lines.groupby("method", sort=False):
        for after in others:
            if (one := effect(part, factor, before, after, value)) is not None:
                found.append({"method": method, factor: after, **one._asdict()})
    made: Frame = pd.DataFrame(found, columns=["method", factor, *Effect._fields])
    known = made["p"].notna().to_numpy()
    adjusted = np.full(len(made), np.nan)
    if known.any():
        adjusted[known] = stats.false_discovery_control(made["p"][known].astype(float))
    made["p_adjusted"] = adjusted
    made["verdict"] = np.where(known, np.where(adjusted < 0.05, "beyond noise", "within noise"), "one round")
    return made
