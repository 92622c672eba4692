"""How long a sweep will take: from rows that were measured before, corrected by those that this run has measured."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from experiments import methods
from experiments._config import Spec
from experiments._rows import SCENE_FIELDS, SearchRow

RESULTS = Path(__file__).parent / "results"
STARTED_S = 3.0  # what a process takes besides its search: imports, positions, comparison with the exact pairs [s]
PRIOR_S = 15.0  # how much time the earlier rows weigh against what this run has taken [s]
Known = dict[tuple[Any, ...], tuple[float, float]]


class Forecast:
    """Says how long rows will take that are still to be measured.

    Attributes:
        absent: Methods of the sweep that cannot be imported here; their rows take no time.
    """

    def __init__(self, pending: Iterable[Spec], here: Iterable[SearchRow] = (), results: Path = RESULTS) -> None:
        """Look up the rows.

        Args:
            pending: What will be measured.
            here: Rows that are there already.
            results: Holds folders of rows that were measured before.
        """
        pending = list(pending)
        self.absent = [name for name in dict.fromkeys(spec.method for spec in pending) if methods.lacks(name)]
        self._known: Known = {}
        if pending:
            self._known = _read(results) | {_place(vars(row)): _times(vars(row)) for row in here if row.status == "ok"}
        self._expected = self._taken = 0.0
        self._unknown: list[float] = []

    def note(self, spec: Spec, seconds: float) -> None:
        """Remember how long a row took that was measured now [s]."""
        if spec.method in self.absent:
            return
        expected = self._alone(spec)
        if expected is None:
            self._unknown.append(seconds)
        else:
            self._expected, self._taken = self._expected + expected, self._taken + seconds

    def left(self, pending: Iterable[Spec]) -> float | None:
        """Return how long these rows will take together [s], None where nothing tells.

        Rows of which nothing is known are taken to need what others of their kind have needed in this run, else what known rows do.
        """
        each = [self._alone(spec) for spec in pending if spec.method not in self.absent]
        known = [seconds for seconds in each if seconds is not None]
        pace = (PRIOR_S + self._taken) / (PRIOR_S + self._expected)
        told = pace * sum(known)
        if len(known) == len(each):
            return told
        seen = self._unknown or [pace * seconds for seconds in known]
        return told + (len(each) - len(known)) * sum(seen) / len(seen) if seen else None

    def _alone(self, spec: Spec) -> float | None:
        """Return how long a row took where it was measured before [s], with the repeats that are asked for now."""
        place = _place(vars(spec) | {"fill_asked": spec.fill})
        times = self._known.get(place) or self._known.get((*place[:-1], not place[-1]))
        if times is None:
            return None
        once, median = times
        runs = min(max(spec.repeats, spec.min_seconds / max(median, 1e-9)), spec.max_repeats)
        return STARTED_S + once + min(runs * median, spec.most_seconds + median)


def in_words(seconds: float | None) -> str:
    """Return a time as a reader says it."""
    if seconds is None:
        return "a time that the first rows will tell"
    if seconds < 90:
        return f"about {max(seconds, 1):.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


def _read(folder: Path) -> Known:
    """Return what all rows below a folder tell: those of sweeps that are ok."""
    known: Known = {}
    for path in sorted(folder.glob("*/rows.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            if row.get("status") == "ok" and row.get("median_s") and "fill_asked" in row:
                known[_place(row)] = _times(row)
    return known


def _place(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return what a time belongs to: method and scene, and whether it is the first process of a row, which compiles its kernels."""
    scene = (row.get(name) for name in SCENE_FIELDS)
    return (row["method"], row["layout"], row["fill_asked"], *scene, row.get("process", 0) == 0)


def _times(row: dict[str, Any]) -> tuple[float, float]:
    """Return the seconds of what is done once, and the median of a search."""
    return sum(row.get(name) or 0.0 for name in ("allocate_s", "compile_s", "first_s")), row["median_s"] or 0.0
