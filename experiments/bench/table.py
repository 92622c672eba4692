"""How a question is answered: rows as they are measured, and a table of them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import pandas as pd

from experiments import _machine, methods
from experiments._commands import take_folder
from experiments._config import digest
from experiments._loop import Task, fill, in_parts
from experiments._rows import RowFile

Line = dict[str, Any]
Part = tuple[str, Callable[[], Iterable[Line]]]
Found = TypeVar("Found")


class Way(Protocol):
    """A way to answer a question: its method, if it is one of others, may not be installed."""

    @property
    def method(self) -> str | None:
        """The name of its adapter in `experiments.methods`, or None."""
        ...


def installed(ways: Iterable[Way]) -> list[str]:
    """Return the methods of others that are installed, on which a table depends."""
    return sorted({way.method for way in ways if way.method is not None and methods.lacks(way.method) is None})


def ask(row: Line, method: str | None, answer: Callable[[], Found]) -> Found | None:
    """Return an answer; where it cannot be had, None, and the row says what is missing or what was raised."""
    if method is not None and (missing := methods.lacks(method)) is not None:
        row |= {"status": "missing", "reason": missing}
        return None
    try:
        return answer()
    except Exception as error:  # what a peer raises is its answer
        row |= {"status": "failed", "reason": " ".join(f"{type(error).__name__}: {error}".split())[:200]}
        return None


def judge(row: Line, wrong: int, most: float) -> bool:
    """Say whether an answer is right but for so many particles, and let the row say so."""
    row |= {"status": "ok", "wrong": wrong}
    if wrong > most:
        row |= {"status": "failed", "reason": f"the answer is wrong for {wrong} particles"}
    return wrong <= most


def measure(folder: Path, name: str, parts: Iterable[Part], given: object, columns: Sequence[str]) -> pd.DataFrame:
    """Measure what the folder does not hold yet, write the whole table as NAME.csv beside rows.jsonl, and return it.

    Args:
        folder: Takes the files.
        name: Of the table, such as cpu_warp.
        parts: What is measured, by name: each makes rows.
        given: What else decides what is measured: with another value, all is measured.
        columns: Of the table; what a row lacks is left empty.
    """
    import jax

    file = RowFile(take_folder(folder), dict)
    tasks = []
    for label, rows in parts:
        key = digest([name, label, given])
        tasks.append(Task((key,), label, lambda _, key=key, rows=rows: in_parts(key, rows())))
    device, versions = jax.devices()[0], _machine.versions()
    about = {"platform": device.platform, "device": device.device_kind, "versions": versions}
    rows = fill(file, tasks, lambda row: None, about=about)
    frame = pd.DataFrame(
        [row | {"jax": row["versions"]["jax"], "warp": row["versions"]["warp-lang"]} for row in rows], dtype=object
    )
    frame = frame.reindex(columns=[*columns])
    frame.to_csv(folder / f"{name}.csv", index=False)
    return frame


def text(frame: pd.DataFrame, columns: Sequence[str] | None = None) -> str:
    """Return columns of a table, all without, as text."""
    shown = frame if columns is None else frame.filter([*columns])
    return shown.to_string(index=False, na_rep="", float_format="{:.4g}".format)
