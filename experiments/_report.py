"""The report of a folder of rows, by what the first of them says; of a sweep a short table, table.csv and pictures."""

import json
import math
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments import _plots, _statistics, _table, methods
from experiments._errors import UsageError
from experiments._rows import RowFile, SearchRow, read_latest, read_text

_KINDS = (  # columns by which rows are known, and the module of their report; others are those of a sweep
    ({"figures", "curves"}, "experiments.sph.validate"),
    ({"compensated", "way"}, "experiments.bench.sums"),
    ({"scaling", "devices"}, "experiments.bench.distributed"),
    ({"kind"}, "experiments.bench.table"),
)
PRINTED = ("s", "MB", "missing", "extra")
ABSENT = "·"


def kind_of(folder: Path) -> tuple[Any, str | None]:
    """Return the kind of the rows of a folder, and the module of their report.

    There is no module for a sweep, where the first is no row, and for rows of a bench that prints its table itself.
    """
    try:
        columns = set(dict(json.loads(read_text(folder / "rows.jsonl").partition("\n")[0])))
    except (OSError, TypeError, ValueError):
        columns = set()
    other = (dict if "key" in columns and "fill_asked" not in columns else SearchRow), None
    return next(((dict, module) for known, module in _KINDS if known <= columns), other)


def report(folder: Path) -> None:
    """Print the tables of a folder, and write them and pictures beside the rows."""
    kind, module = kind_of(folder)
    if kind is dict and module is None:
        raise UsageError(f"{folder}: rows of a bench, whose own command prints their table: give it again, with --out {folder}")
    if module is None:
        report_sweep(folder)
    else:
        print(import_module(module).report(RowFile(folder, kind).read(), folder))


def report_sweep(folder: Path) -> None:
    """Print the table of a sweep, which has to hold rows, and the paths of its files: table.csv and the pictures, beside them."""
    rows = read_latest(folder)
    if not rows:
        raise UsageError(f"{folder}: no rows; fill it with `python -m experiments run CONFIG.toml --out {folder}`")
    lines = _table.lines(rows)
    pictures = _plots.draw_all(_statistics.summarize(rows), folder, describe_origin(rows))
    pd.DataFrame(lines, columns=[*_table.COLUMNS], dtype=object).to_csv(folder / "table.csv", index=False, lineterminator="\r\n")
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 80
    console.print(rich_table(lines))
    for text in (*remarks(lines), describe_origin(rows)):
        console.print(text, soft_wrap=True)
    for path in (folder / "table.csv", *pictures):
        console.print(str(path), soft_wrap=True)


def describe_origin(rows: Iterable[SearchRow]) -> str:
    """Say on what, with what, beside what and when the rows were measured, from the rows alone."""
    rows = list(rows)
    machines = _distinct(_describe_machine(row.machine) for row in rows if row.machine)
    packages = ("jax", "scipy", "warp-lang")
    versions = _distinct(", ".join(f"{name} {row.versions[name]}" for name in packages if row.versions.get(name)) for row in rows)
    commits = _distinct(f"commit {row.commit[:10]}{' with changes' if row.dirty else ''}" for row in rows if row.commit)
    others = max((row.others_cores or 0.0 for row in rows), default=0.0)
    beside = [f"others kept up to {others:.1f} cores busy"] if others > _table.NOTEWORTHY_CORES else []
    dates = sorted({row.time[:10] for row in rows if row.time})
    when = " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else ""
    return " · ".join(" / ".join(part) for part in (machines, versions, commits, beside, [when]) if any(part))


def _distinct(texts: Iterable[str]) -> list[str]:
    return [text for text in dict.fromkeys(texts) if text]


def _describe_machine(machine: dict[str, Any]) -> str:
    memory = machine.get("memory_bytes")
    size = f", {memory / 2**30:.0f} GiB" if memory else ""
    return f"{machine.get('cpu')}, {machine.get('cores')} cores{size}"


def _count(value: int | None) -> str:
    return ABSENT if value is None else _table.count(value)


def _errors(line: dict[str, Any], name: str) -> str:
    return _table.pairs_mark(line) + _count(line[name])


def _seconds(value: float | None, digits: int = 4) -> str:
    """Return a time with so many decimals, and more where they would leave fewer than three figures."""
    if value is None:
        return ABSENT
    digits = max(digits, 2 - math.floor(math.log10(value))) if 0 < value < 0.01 else digits
    return f"{value:.{digits}f}"


def _megabytes(value: float | None) -> str:
    return ABSENT if value is None else f"{value:.1f}"


def rich_table(lines: list[dict[str, Any]]) -> Table:
    """Return the printed table, scene by scene: what has figures, or says why it has none, but for what is not installed.

    It fits a terminal of 80 columns, where long names of scenes are broken; `table.csv` has all columns.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for title in PRINTED:
        table.add_column(title, justify="right", no_wrap=True)
    previous = None
    for line in split_absent(lines)[0]:
        if line["scene"] != previous:
            if previous is not None:
                table.add_section()
            table.add_row(Text(f"{line['scene']}, {_count(line['points'])} points", "bold"))
            previous = line["scene"]
        wrong = [Text(_errors(line, name), "yellow" if line[name] else "") for name in ("missing", "extra")]
        ok = line["status"] == "ok"
        seconds = _table.busy_mark(line) + _seconds(line["median_s"]) if ok else line["status"]
        table.add_row(f"  {line['method']}", seconds, _megabytes(line["search_mb"]), *wrong, style=None if ok else "dim")
    return table


def split_absent(lines: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the lines of methods that are there, and what is said of the others: a line each would tell no more."""
    absent = dict.fromkeys(line["method"] for line in lines if line["status"] == "missing")
    said = [f"not installed: {', '.join(absent)} ({methods.HOW_TO_INSTALL})"] if absent else []
    return [line for line in lines if line["status"] != "missing"], said


def remarks(lines: list[dict[str, Any]]) -> list[str]:
    """Return what is to be said below the printed table: what is not installed, and what its marks mean, where they occur."""
    said = split_absent(lines)[1]
    marks = {_table.busy_mark(line) for line in lines}
    if "*" in marks:
        said.append("*: other processes kept more than a quarter of a core busy meanwhile, so that this time may be too long")
    if "°" in marks:
        said.append("°: repeats took too little time to tell whether other processes worked meanwhile")
    if any(_table.pairs_mark(line) for line in lines):
        said.append("~: told from counts of neighbors, or from a sample of the particles")
    return [*said, "s: median time of a search; MB: its peak memory, 10^6 bytes; missing, extra: pairs against the exact answer"]
