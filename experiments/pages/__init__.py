"""The tables of README.md and docs/ that hold measured figures: each is made from rows under experiments/results.

In a page, a table stands between two comments, `<!-- table NAME -->` and `<!-- end -->`, and a figure in running text between
`<!-- value NAME -->` and `<!-- end -->`; `python -m experiments tables` writes what is between them. A test compares what stands in
the pages with the rows, and finds figures that stand outside of such comments.
"""

import re
from collections.abc import Callable
from pathlib import Path

from experiments._errors import UsageError
from experiments.pages import answers, configs, cpu, fluids, gpu, jax_md, liquid, options, values

ROOT = Path(__file__).parent.parent.parent
TABLES: dict[str, Callable[[], str]] = (
    cpu.TABLES | liquid.TABLES | gpu.TABLES | fluids.TABLES | answers.TABLES | jax_md.TABLES | options.TABLES | configs.TABLES
)
VALUES = values.VALUES | liquid.VALUES | jax_md.VALUES | options.VALUES
_PLACE = re.compile(r"(<!-- table ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
_UNIT = r"(?:[mnµu]?s|%|[GMk]?B|[GM]iB|times|\N{MULTIPLICATION SIGN}|fold|steps/s|per second|seconds?|minutes?|hours?)"
_FIGURE = re.compile(rf"(?<![\w.`=-])\d[\d .,]*(?:\s(?:to|and|or)\s\d[\d .,]*)?\s?{_UNIT}(?![\w/])")
_VALUE = re.compile(r"(<!-- value ([a-z0-9-]+) -->)(.*?)(<!-- end -->)")


def pages() -> list[Path]:
    """Return the pages that may hold tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def fill_in(text: str) -> str:
    """Return a page with all of its tables and figures made anew."""

    def make(place: re.Match[str]) -> str:
        return f"{place[1]}\n{_known('table', TABLES, place[2])()}\n\n{place[4]}"

    def tell(place: re.Match[str]) -> str:
        return f"{place[1]}{_known('value', VALUES, place[2])()}{place[4]}"

    return _VALUE.sub(tell, _PLACE.sub(make, text))


def _known(kind: str, known: dict[str, Callable[[], str]], name: str) -> Callable[[], str]:
    if name not in known:
        raise UsageError(f"{kind} {name}: there is no such {kind}; there are {', '.join(known)}")
    return known[name]


def loose_figures(text: str) -> list[str]:
    """Return the figures with a unit, or a factor, of a page that are neither made from rows nor in code."""
    for made in (_PLACE, _VALUE, re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)):
        text = made.sub("", text)
    return [found[0] for found in _FIGURE.finditer(text)]


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


def names_in(path: Path) -> list[str]:
    """Return the names of the tables and figures of a page."""
    text = path.read_text(encoding="utf-8")
    return [place[2] for found in (_PLACE, _VALUE) for place in found.finditer(text)]
