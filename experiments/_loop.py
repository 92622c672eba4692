"""The loop of everything that measures: what is there is not measured again, and each row is on disk before the next one starts."""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from typing import Any, Generic

from tqdm import tqdm

from experiments import _machine
from experiments._errors import NoResultError
from experiments._rows import RETRIED, RowFile, RowT


class Shown(tqdm):
    """What the user sees on stderr while it runs: a bar with a label and with time passed and left, and lines above it."""

    monitor_interval = 0  # no thread looks after it

    def __init__(self, total: int, completed: int = 0) -> None:
        """Begin the bar; of nothing there is none."""
        words = "{n_fmt}/{total_fmt} {elapsed}<{remaining} {desc}"
        super().__init__(total=total, initial=completed, file=sys.stderr, disable=total == 0, bar_format=words, mininterval=0)

    def label(self, text: str) -> None:
        """Say beside the bar what is going on."""
        self.set_description_str(text)

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        self.write(text, file=sys.stderr)


@dataclass(frozen=True)
class Task(Generic[RowT]):
    """Rows that are measured together.

    Attributes:
        keys: Of the rows that there have to be; where one is missing, all are measured again.
        label: What is shown meanwhile.
        measure: Makes the rows; they may be more than there are keys.
        stale: Whether a row that is there has to be measured again.
    """

    keys: tuple[str, ...]
    label: str
    measure: Callable[[Shown], Iterable[RowT]]
    stale: Callable[[RowT], bool] = lambda row: False


def fill(
    file: RowFile[RowT],
    tasks: Sequence[Task[RowT]],
    describe: Callable[[RowT], str | None],
    *,
    retry_failed: bool = False,
    about: dict[str, Any] | None = None,
    begin: Callable[[list[Task[RowT]], Shown], None] = lambda left, shown: None,
) -> list[RowT]:
    """Measure what a file does not hold yet, in the order of the tasks, and return the rows of all of them.

    The file gets each row as it comes, with machine, commit, time, and what `about` says besides. `describe` makes a line for the
    reader of a row, or None. With `retry_failed`, rows that are missing, failed or ran out of time are measured again. `begin` is
    told what is left to measure. Refused where another process fills the file, or a line of it is no row.
    """
    with file.lock():
        file.repair()
        there = {_column(row, "key"): row for row in file.read() if not (retry_failed and _column(row, "status") in RETRIED)}
        left = [task for task in tasks if any(key not in there or task.stale(there[key]) for key in task.keys)]
        total, missing = (sum(len(task.keys) for task in some) for some in (tasks, left))
        told = {"machine": _machine.machine(), **_machine.commit(), **(about or {})} if left else {}
        with Shown(total, total - missing) as shown:
            if missing < total:
                shown.say(f"{total - missing} of {total} rows are there already")
            begin(left, shown)
            for task in left:
                _measure(task, file, describe, told, shown)
        place = {key: number for number, key in enumerate(key for task in tasks for key in task.keys)}
        rows = [(place.get(str(_column(row, "key")).partition("/")[0]), row) for row in file.read()]
        return [row for number, row in sorted(((n, r) for n, r in rows if n is not None), key=lambda pair: pair[0])]


def _measure(
    task: Task[RowT], file: RowFile[RowT], describe: Callable[[RowT], str | None], about: dict[str, Any], shown: Shown
) -> None:
    shown.label(task.label)
    for row in task.measure(shown):
        stamped = _stamp(row, about)
        file.append(stamped)
        if (line := describe(stamped)) is not None:
            shown.say(line)
    shown.update(len(task.keys))


def with_result(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table, whose status is "ok" or not told where they have a result.

    Raises:
        NoResultError: there are rows, and none has one.
    """
    outcomes = [(row.get("status"), row.get("reason")) for row in rows]
    if rows and all(status not in (None, "ok") for status, _ in outcomes):
        why = dict.fromkeys(": ".join(filter(None, outcome)) for outcome in outcomes)
        raise NoResultError(f"none of {len(rows)} rows has a result ({'; '.join(why)})")
    return rows


def in_parts(key: str, rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield rows as they come, with keys: the last one has the key of the whole, which is done only when that one is there."""
    previous = None
    for number, row in enumerate(rows):
        if previous is not None:
            yield {"key": f"{key}/{number}"} | previous
        previous = row
    if previous is not None:
        yield {"key": key} | previous


def _column(row: Any, name: str) -> Any:  # noqa: ANN401
    return row.get(name) if isinstance(row, dict) else getattr(row, name)


def _stamp(row: Any, about: dict[str, Any]) -> Any:  # noqa: ANN401
    about = about | {"time": datetime.now(UTC).isoformat(timespec="seconds")}
    if isinstance(row, dict):
        return row | {name: value for name, value in about.items() if name not in row}
    known = {item.name for item in fields(row)}
    return replace(row, **{name: value for name, value in about.items() if name in known and not getattr(row, name)})
