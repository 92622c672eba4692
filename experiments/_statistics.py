"""Medians with confidence intervals, over processes: what differs between two runs of a program counts too."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from experiments._rows import SearchRow

CONFIDENCE = 0.95
LEAST_CONFIDENCE = 0.7  # two rounds tell with 50 %, three with 75 %: below it, nothing is said
FIRST_ALONE = ("density_error", "gradient_error", "jump_error", "planned_list_bytes", "planned_scratch_bytes")
"""What the first process alone finds out."""


class Interval(NamedTuple):
    """A median, between which two values it lies, and with which probability (below that asked for where values are too few)."""

    middle: float
    low: float
    high: float
    confidence: float


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Return the median of measurements and its interval between two order statistics: no assumption on the distribution.

    The number of values below the median is binomial. Five values reach 93.75 % from the least to the largest, six 96.9 %.
    Source: Conover, Practical Nonparametric Statistics (1999), section 3.2.
    """
    ordered = np.sort(np.asarray(values, float))
    n = len(ordered)
    rank = max(int(stats.binom.ppf((1 - confidence) / 2, n, 0.5)), 1)  # of the lower end, from 1
    reached = 1 - 2 * float(stats.binom.cdf(rank - 1, n, 0.5))
    return Interval(float(np.median(ordered)), float(ordered[rank - 1]), float(ordered[n - rank]), max(reached, 0.0))


@dataclass
class Summary(SearchRow):
    """All processes of one method on one scene as one row; times are medians of the processes' medians.

    Attributes:
        processes: That gave figures.
        medians: Median of each, by process [s].
        machines: The kind of machine of each, by process.
        low_s: Where the interval of the median begins [s]; of one process, that of its repeats.
        high_s: Where it ends [s].
        confidence: Of the interval.
    """

    processes: int = 0
    medians: dict[int, float] = field(default_factory=dict)
    machines: dict[int, tuple[str, ...]] = field(default_factory=dict)
    low_s: float | None = None
    high_s: float | None = None
    confidence: float | None = None


def summarize(rows: Iterable[SearchRow]) -> list[Summary]:
    """Return one row for each method on each scene, in the order of their first appearance."""
    groups: dict[tuple[Any, ...], list[SearchRow]] = defaultdict(list)
    for row in rows:
        groups[(*row.scene_key, row.method)].append(row)
    return [_summary(sorted(group, key=lambda row: row.process)) for group in groups.values()]


def _summary(group: list[SearchRow]) -> Summary:
    good = [row for row in group if row.status == "ok" and row.median_s is not None]
    known = (good or group)[0]
    summary = Summary(**{item.name: getattr(known, item.name) for item in fields(SearchRow)})
    if not good:
        return summary
    summary.medians = {row.process: row.median_s for row in good if row.median_s is not None}
    summary.machines = {row.process: row.machine_kind for row in good}
    summary.processes = len(good)
    if len(good) < len(group):
        bad = next(row for row in group if row.status != "ok" or row.median_s is None)
        summary.reason = f"{len(group) - len(good)} of {len(group)} processes, the first of them {bad.status}: {bad.reason}"
    pooled = [second for row in good for second in row.seconds]
    sampled = list(summary.medians.values()) if len(good) > 1 else pooled
    edges = median_interval(sampled)[1:] if sampled else (None, None, None)
    p10, p90 = np.percentile(pooled, (10, 90)).tolist() if pooled else (known.p10_s, known.p90_s)
    middle = float(np.median(list(summary.medians.values())))
    worst = {name: max((getattr(row, name) or 0 for row in good), default=0) for name in ("missing", "extra")}
    worst = {name: value for name, value in worst.items() if getattr(known, name) is not None}
    busy = [row.others_cores for row in good if row.others_cores is not None]
    return replace(
        summary,
        median_s=middle,
        p10_s=p10,
        p90_s=p90,
        seconds=pooled,
        repeats=len(pooled) or known.repeats,
        others_cores=max(busy) if busy else None,
        compile_s=known.compile_s if known.process == 0 else None,  # later ones find their kernels compiled
        parts={name: float(np.median([row.parts[name] for row in good if name in row.parts])) for name in known.parts},
        **worst,
        **{name: next((value for row in good if (value := getattr(row, name)) is not None), None) for name in FIRST_ALONE},
        **{name: _middle(good, name) for name in ("search_bytes", "peak_bytes", "scratch_bytes", "device_bytes")},
        **dict(zip(("low_s", "high_s", "confidence"), edges, strict=True)),
    )


def _middle(rows: list[SearchRow], name: str) -> int | None:
    values = [value for row in rows if (value := getattr(row, name)) is not None]
    return int(np.median(values)) if values else None


def _shared_rounds(mine: Summary, theirs: Summary) -> list[int]:
    """Return the rounds in which a machine of one kind measured both."""
    both = sorted(set(mine.medians) & set(theirs.medians))
    return [k for k in both if mine.machines.get(k) == theirs.machines.get(k)]


def ratio_interval(mine: Summary, theirs: Summary) -> Interval | None:
    """Return how many times as long one takes as the other, process by process of the same round: drift of the machine cancels.

    None where there are no two rounds in which one kind of machine measured both: then only repeats within one process are known.
    """
    rounds = _shared_rounds(mine, theirs)
    if len(rounds) < 2:
        return None
    return median_interval([mine.medians[k] / theirs.medians[k] for k in rounds])


def within_noise(mine: Summary, theirs: Summary) -> bool | None:
    """Whether the interval of their ratio holds 1; of one process, whether those of the repeats overlap; None: too few."""
    ratio = ratio_interval(mine, theirs)
    if ratio is not None:
        return ratio.low <= 1 <= ratio.high if ratio.confidence > LEAST_CONFIDENCE else None
    if not _shared_rounds(mine, theirs) or any((one.confidence or 0.0) < LEAST_CONFIDENCE for one in (mine, theirs)):
        return None
    return not (mine.high_s < theirs.low_s or theirs.high_s < mine.low_s)  # pyright: ignore[reportOperatorIssue]
