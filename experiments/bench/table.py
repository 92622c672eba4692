"""How a question is answered: rows as they are measured, and a table of them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pandas as pd

from experiments import _machine, methods
from experiments._commands import take_folder
from experiments._config import digest
from experiments._loop import Task, fill, in_parts, with_result
from experiments._rows import RowFile

Line = dict[str, Any]
Part = tuple[str, Callable[[], Iterable[Line]]]
Found = TypeVar("Found")


UNTOLD = ("kind", "key", "versions", "machine", "commit", "dirty", "time", "seconds", "wrong_cases")  # in a table of many kinds
ROUNDED = 1e-3  # share of the particles for which the answer of a peer may be wrong: its distances are rounded


class Way(NamedTuple):
    """Who does what.

    Attributes:
        make: Returns what answers, of a scene.
        wrong: How many particles of a scene such an answer is wrong for.
        method: Of a peer, the adapter in `experiments.methods` that says whether it is installed.
        package: Of a peer, the distribution whose version is told.
    """

    who: str
    what: str
    make: Callable[[Any], Any]
    wrong: Callable[[Any, Any], int]
    method: str | None = None
    package: str = "jfrnn"


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


class Ready(NamedTuple):
    """What a way made of a scene, and a call of it whose answer is right."""

    made: Any
    call: Callable[[], Any]


def judge(row: Line, way: Way, scene: Any, compiled: Callable[[Any], Callable[[], Any]]) -> Ready | None:  # noqa: ANN401
    """Make a way ready; where it cannot be had or its answer is wrong, return None, and the row says why.

    The row also says who does what, and for how many particles, at `scene.x`, the answer is wrong. `compiled` returns a call of
    what the way makes.
    """

    def answer() -> tuple[Ready, int]:
        made = way.make(scene)
        call = compiled(made)
        return Ready(made, call), way.wrong(scene, call())

    row |= {"who": way.who, "what": way.what}
    found = ask(row, way.method, answer)
    if found is None:
        return None
    ready, wrong = found
    row |= {"status": "ok", "wrong": wrong}
    if way.method is not None:
        row["peer"] = _machine.versions([way.package])[way.package]
    if wrong <= (0 if way.method is None else ROUNDED * len(scene.x)):
        return ready
    row |= {"status": "failed", "reason": f"the answer is wrong for {wrong} particles"}
    return None


def fill_parts(
    folder: Path,
    parts: Iterable[Part],
    given: object,
    about: Line,
    describe: Callable[[Line], str | None] = lambda row: None,
    retry_failed: bool = False,
) -> list[Line]:
    """Measure what the folder does not hold yet, and return the rows of all parts, each of which has a name and makes rows.

    What is `given` decides what is measured, too: with another value, all is. `about` is what else rows say of where they were
    measured, and `describe` makes a line of a row for the reader. With `retry_failed`, parts whose last row is of something missing
    or failed are measured again.

    Raises:
        NoResultError: none of these rows has a result.
    """
    import jax

    tasks = []
    for label, rows in parts:
        key = digest([label, given])
        tasks.append(Task((key,), label, lambda _, key=key, rows=rows: in_parts(key, rows())))
    about |= {"device": jax.devices()[0].device_kind}
    return with_result(fill(RowFile(take_folder(folder), dict), tasks, describe, about=about, retry_failed=retry_failed))


def measure(folder: Path, name: str, parts: Iterable[Part], given: object, columns: Sequence[str]) -> pd.DataFrame:
    """Measure what the folder does not hold yet, write the whole table as NAME.csv beside rows.jsonl, and return it.

    Parts and what is given are as in `fill_parts`; what a row lacks of the columns is left empty.
    """
    import jax

    about = {"platform": jax.devices()[0].platform, "versions": _machine.versions()}
    rows = fill_parts(folder, parts, [name, given], about)
    frame = pd.DataFrame(
        [row | {"jax": row["versions"]["jax"], "warp": row["versions"]["warp-lang"]} for row in rows], dtype=object
    )
    frame = frame.reindex(columns=[*columns])
    frame.to_csv(folder / f"{name}.csv", index=False)
    return frame


def report(rows: list[Line], folder: Path) -> str:
    """Return a table for each kind of rows, with the columns that one of them has, and write it as KIND.csv into the folder."""
    parts = []
    for kind, part in pd.DataFrame(rows, dtype=object).groupby("kind", sort=False):
        shown = part.drop(columns=[*UNTOLD], errors="ignore").dropna(axis="columns", how="all")
        shown.to_csv(folder / f"{kind}.csv", index=False)
        parts.append(f"{kind}\n{text(shown.where(shown.notna(), ''))}")
    return "\n\n".join(parts)


def text(frame: pd.DataFrame, columns: Sequence[str] | None = None) -> str:
    """Return columns of a table, all without, as text."""
    shown = frame if columns is None else frame.filter([*columns])
    return shown.to_string(index=False, na_rep="", float_format="{:.4g}".format)
