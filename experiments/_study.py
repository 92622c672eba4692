"""What notebooks ask of the rows of sweeps: a table of rounds, and effects of one thing at a time with their uncertainty."""

import gc
import io
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stderr
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from experiments import _config, _sweep, _table, _worker
from experiments._config import Config, Scenes
from experiments._rows import SCENE_FIELDS, SearchRow, read_latest

ROOT = Path(__file__).resolve().parent
Frame = Any  # a pd.DataFrame; what its columns hold, its annotations do not know
LIGHT = ("cll", "scipy-kdtree", "scipy-kdtree-nolist", "ann-kd", "ann-kd-nolist", "nanoflann-dynamic", "nanoflann-rebuild")
"""Methods whose processes start within a second."""


def rows(sweep: str, results: str | None = None, *, small: bool = False) -> list[SearchRow]:
    """Return the committed rows of a sweep, or, where there are none or `small` is asked for, rows of a small one made now.

    Args:
        sweep: Name of a config, such as sweep_orientation.
        results: Folder below experiments/results; without it, that of the name.
        small: Whether to measure a coarse lattice with few methods instead, all in this process: for tests.
    """
    folder = ROOT / "results" / (results or sweep)
    if not small and (there := read_latest(folder)):
        return there
    if small:
        return list(_measure(sweep))
    config = shrink(_config.load(ROOT / "configs" / f"{sweep}.toml"))
    with redirect_stderr(io.StringIO()):  # its progress is no result
        made = _sweep.run(config, f"{sweep}, small", ROOT.parent / "out" / "small" / sweep)
    command = f"python -m experiments run experiments/configs/{sweep}.toml --out {folder.relative_to(ROOT.parent)}"
    print(f"no rows of {sweep} are here: what follows is a small version, measured now. `{command}` measures the whole one.")
    return made


@cache
def _measure(sweep: str) -> tuple[SearchRow, ...]:
    """Return rows of a small sweep, measured in this process, once however many ask for them."""
    config = shrink(_config.load(ROOT / "configs" / f"{sweep}.toml"))
    gc.freeze()  # a row collects garbage before it measures memory: what is imported is none, and slow to look through
    try:
        with tempfile.TemporaryDirectory() as out:
            return tuple(_sweep.measure(spec, Path(out), _worker.measure(spec, Path(out))) for spec in config.specs())
    finally:
        gc.unfreeze()


def shrink(config: Config) -> Config:
    """Return a sweep of seconds that has the same axes: a coarse lattice, two values of each, light methods, two rounds."""
    tables = [{name: _few(name, values) for name, values in table.model_dump().items()} for table in config.scenes[:2]]
    scenes = tuple(Scenes.model_validate(table) for table in tables)
    count = len([scene for table in scenes for scene in table.scenes()])
    light = tuple(name for name in LIGHT if name in config.methods)[: 3 if count <= 4 else 2]
    few: dict[str, Any] = {"processes": 2, "repeats": 3, "min_seconds": 0.0, "timeout": 60.0}
    return config.model_copy(update={"scenes": scenes, "methods": light, "spacing": 2.5e-4, **few})


def _few(axis: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """Return two layouts, two coarse spacings, one seed, of all else the first and the last value."""
    if axis == "spacings" and values:
        return (5e-4, 4e-4)
    if axis == "seeds":
        return tuple(values[:1])
    return tuple(values[:2]) if axis == "layouts" or len(values) < 2 else (values[0], values[-1])


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
    count once; what machines of different kinds measured is not compared. Intervals and p: Student's t on the logarithms.

    Args:
        lines: From `rounds`.
        factor: Column that differs; all other columns that describe the scene are the same.
        before: Its value below the fraction bar.
        after: Its value above.
        value: Column that is compared.
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
