"""What all tables of pages need: rows as they were measured, numbers as people read them, and a table in Markdown."""

import csv
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

TIMES = "\N{MULTIPLICATION SIGN}"
RESULTS = Path(__file__).parent.parent / "results"
Row = dict[str, Any]


def read(name: str) -> list[Row]:
    """Return the rows of a .csv or .jsonl file under experiments/results."""
    with (RESULTS / name).open(encoding="utf-8", newline="") as stream:
        return [json.loads(line) for line in stream] if name.endswith(".jsonl") else list(csv.DictReader(stream))


def one(rows: Iterable[Row], **wanted: object) -> Row | None:
    """Return the first row with these values, compared as text; None if there is none."""
    return next((row for row in rows if all(str(row.get(name)) == str(value) for name, value in wanted.items())), None)


def machine(rows: Iterable[Row]) -> str:
    """Return what rows were measured on, in a word or two: two cores, or a card, as in "H200"."""
    found = re.search(r"[A-Z]+\d+", next(row["device"] for row in rows if row.get("device")))
    return "2 cores" if found is None else found[0]


def number(value: object, scale: float = 1.0, digits: int = 3) -> str:
    """Return a number times `scale` with so many significant digits and without exponent, nothing for nothing."""
    if value in (None, ""):
        return ""
    x = float(str(value)) * scale
    rounded = float(f"{x:.{digits}g}")
    if rounded and abs(rounded) < 1e-3:
        return f"{x:.{digits - 1}e}".replace("e-0", "e-")
    decimals = max(digits - 1 - int(f"{rounded:e}".partition("e")[2]), 0) if rounded else 0
    return f"{rounded:,.{decimals}f}".replace(",", " ")


def whole(value: object) -> str:
    """Return a whole number in groups of three digits."""
    return "" if value in (None, "") else f"{int(float(str(value))):,}".replace(",", " ")


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a head that begins with `>` is that of a column of numbers, which stands to the right.

    No line ends within a number of a head.
    """
    titles = [re.sub(r"(?<=\d) (?=\d{3})", "\N{NO-BREAK SPACE}", head.lstrip("> ")) for head in heads]
    lines = [titles, ["---:" if head.startswith(">") else "---" for head in heads], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
