"""Table 6.1 of the thesis, and which of its rows belong to a row of ours. Source: reference/README.md."""

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from experiments._rows import SearchRow

FILE = Path(__file__).parent / "reference" / "table_6_1.csv"
COUNTERPARTS = {
    **{"cll": "CLL", "ann-kd-naive": "ANN", "ann-kd": "ANN", "ann-bd": "ANN", "ann-kd-nolist": "ANN-NL"},
    **{"scipy-kdtree": "ANN", "scipy-kdtree-nolist": "ANN-NL"},
}
"""Methods of ours and what the thesis has that is like them, the most alike first."""
SPACING, CUTOFF_RATIO, DIM, ORDER = 1e-4, 3.0, 3, "layout"


@dataclass(frozen=True)
class Figures:
    """What the thesis says about one method on one scene: t_total [s] and the largest resident set of the process [MB].

    `parts` holds t_ksearch, t_frsearch and t_processing [s].
    """

    method: str
    points: int
    seconds: float
    megabytes: float
    parts: dict[str, float] = field(default_factory=dict, compare=False)


@cache
def table() -> dict[tuple[str, int, str], Figures]:
    """Return Table 6.1 by layout, fill in percent and method."""
    rows = csv.DictReader(FILE.read_text(encoding="utf-8").splitlines())
    return {
        (row["layout"], int(row["fill_percent"]), row["method"]): Figures(
            *(row["method"], int(row["points"]), float(row["t_total_s"]), float(row["memory_mb"])),
            {name: float(row[f"{name}_s"]) for name in ("t_ksearch", "t_frsearch", "t_processing")},
        )
        for row in rows
    }


def counterparts(present: Iterable[str]) -> dict[str, str]:
    """Return for each method of the thesis the one of these methods that is most like it; where none is, one of SciPy's."""
    present, chosen = set(present), {}
    for ours, theirs in COUNTERPARTS.items():
        if theirs not in chosen.values() and ours in present:
            chosen[ours] = theirs
    for ours, theirs in reversed(COUNTERPARTS.items()):
        if theirs not in chosen.values():
            chosen[ours] = theirs
    return chosen


def figures(row: SearchRow, method: str | None = None) -> Figures | None:
    """Return what the thesis says of the scene of a row, by a method of its own or the counterpart; None where it says nothing."""
    wanted = method or COUNTERPARTS.get(row.method)
    same_lattice = math.isclose(row.spacing, SPACING) and math.isclose(row.cutoff_ratio, CUTOFF_RATIO) and row.dim == DIM
    same_lattice = same_lattice and row.order == ORDER
    fill = row.fill if row.fill_asked is None else row.fill_asked
    if wanted is None or fill is None or not same_lattice:
        return None
    return table().get((row.layout, int(100 * fill + 1e-9), wanted))
