"""Which rows a folder holds, by what the first of them says, and which report it gets."""

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from experiments._rows import RowFile, SearchRow, read_text

_KINDS = (  # columns by which rows are known, the module of their report, and, where they are no dicts, of their kind and its name
    ({"figures", "curves"}, "sph.validate", None),
    ({"compensated", "way"}, "bench.sums_report", ("bench.sums", "SumRow")),
    ({"scaling", "devices"}, "bench.distributed", None),
    ({"kind"}, "bench.table", None),
)


def kind_of(folder: Path) -> tuple[Any, str]:
    """Return the kind of the rows of a folder, and the module of their report."""
    columns = _columns(folder / "rows.jsonl")
    for known, report, kind in _KINDS:
        if known <= columns:
            made = dict if kind is None else getattr(import_module(f"experiments.{kind[0]}"), kind[1])
            return made, f"experiments.{report}"
    return SearchRow, "experiments._report"


def report(folder: Path) -> None:
    """Print the tables of a folder, and write them and pictures beside the rows."""
    kind, module = kind_of(folder)
    table = import_module(module).report
    if kind is SearchRow:
        table(folder)
    else:
        typer.echo(table(RowFile(folder, kind).read(), folder))


def _columns(path: Path) -> set[str]:
    """Return what the first row has; nothing where it is no row."""
    try:
        row = json.loads(read_text(path).partition("\n")[0])
    except (OSError, ValueError):
        return set()
    return set(row) if isinstance(row, dict) else set()
