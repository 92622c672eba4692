"""The tables of README.md and docs/ that hold measured figures: each is made from rows under experiments/results.

In a page, a table stands between two comments, `<!-- table NAME -->` and `<!-- end -->`; `python -m experiments tables` writes what
is between them. A test compares what stands in the pages with the rows.
"""

import re
from collections.abc import Callable
from pathlib import Path

from experiments._errors import UsageError
from experiments.pages import cpu, fluids, gpu

ROOT = Path(__file__).parent.parent.parent
TABLES: dict[str, Callable[[], str]] = cpu.TABLES | gpu.TABLES | fluids.TABLES
_PLACE = re.compile(r"(<!-- table ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def pages() -> list[Path]:
    """Return the pages that may hold tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def fill_in(text: str) -> str:
    """Return a page with all of its tables made anew."""

    def make(place: re.Match[str]) -> str:
        name = place[2]
        if name not in TABLES:
            raise UsageError(f"table {name}: there is no such table; there are {', '.join(TABLES)}")
        return f"{place[1]}\n{TABLES[name]()}\n\n{place[4]}"

    return _PLACE.sub(make, text)


def write() -> list[Path]:
    """Write the tables of all pages, and return the pages that changed."""
    changed = []
    for path in pages():
        text = path.read_text(encoding="utf-8")
        new = fill_in(text)
        if new != text:
            path.write_text(new, encoding="utf-8")
            changed.append(path)
    return changed


def tables_of(path: Path) -> list[str]:
    """Return the names of the tables of a page."""
    return [place[2] for place in _PLACE.finditer(path.read_text(encoding="utf-8"))]
