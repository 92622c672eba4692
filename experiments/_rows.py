"""Rows: what one measurement says, and the file that they are kept in, one JSON line each."""

import fcntl
import gzip
import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

from experiments._errors import UsageError

RETRIED = ("missing", "failed", "timeout")
SCENE_FIELDS = ("spacing", "cutoff_ratio", "dtype", "dim", "seed", "angle", "growth", "order", "motion")
"""What decides, beside layout and fill, where particles are and what a pair is."""


@dataclass(kw_only=True)
class SearchRow:
    """One method on one scene, measured in one process of its own; times are from raw positions to the result.

    What was not reached is None.
    """

    key: str  # digest of what is measured and how: rows with the same key replace each other
    status: str = "failed"  # or "ok", "missing", "timeout", "skipped"
    reason: str | None = None  # why the status is not ok; of several processes as one row, why some of them have no figures
    others_cores: float | None = None  # that other processes kept busy meanwhile, on average; None where less than 0.2 s passed
    device: str | None = None  # where it ran
    versions: dict[str, str | None] = field(default_factory=dict)  # of Python and of packages
    machine: dict[str, Any] = field(default_factory=dict)  # processor, cores, memory [bytes], operating system
    commit: str | None = None  # of the project
    dirty: bool | None = None  # whether the working tree differed from it
    time: str | None = None  # when the row was finished, UTC
    first_s: float | None = None  # first run, compilation included where it is not told apart [s]
    median_s: float | None = None  # of the repeats [s]
    p10_s: float | None = None
    p90_s: float | None = None
    repeats: int | None = None  # number of timed runs after the first
    layout: str
    method: str  # name of the adapter
    fill_asked: float | None  # share of the full domain that the config asked for
    spacing: float  # distance of lattice neighbors [m]
    cutoff_ratio: float  # cutoff in spacings
    dtype: str
    dim: int
    seed: int  # of random layouts
    process: int = 0  # which of the processes that measured the same
    angle: float | None = None  # of turnedN and cutN [degrees]
    growth: float | None = None  # of grownN: how many times larger the domain became
    order: str = "layout"  # of the particles: layout, shuffled, or sorted
    motion: float = 0.0  # how far particles went between two searches [spacings]
    fill: float | None = None  # that the scene has
    cutoff: float | None = None  # [m], rounded to the dtype
    points: int | None = None  # number of particles n
    allocate_s: float | None = None  # to find the capacity of the list, for methods that need one before they search [s]
    compile_s: float | None = None  # what else is done once: compilation [s]
    parts: dict[str, float] = field(default_factory=dict)  # median seconds of its parts, where a method tells them apart
    rebuilt: float | None = None  # share of the searches that made a list anew, of methods that keep one while particles move
    seconds: list[float] = field(default_factory=list)  # all times [s]
    # Peak resident memory over the start (imports done, positions made): allocation, compilation and first search included.
    peak_bytes: int | None = None
    # That of the first search over what was resident after compilation: what it takes itself, at least list_bytes; unknown where
    # the peak cannot be reset. On an accelerator device_bytes.
    search_bytes: int | None = None
    list_bytes: int | None = None  # size of the result
    scratch_bytes: int | None = None  # search_bytes - list_bytes
    # Peak of the accelerator's memory over what it held before, as JAX and Warp count it: positions, and what the compiler tries
    # out, included; None on a CPU.
    device_bytes: int | None = None
    planned_list_bytes: int | None = None  # as `jfrnn.memory_plan` says beforehand; the library's own methods, process 0
    planned_scratch_bytes: int | None = None  # what is needed besides, as it says
    memory_source: str | None = None  # VmHWM, reset at both starts; ru_maxrss, where earlier peaks hide later ones; device
    pairs: int | None = None  # unordered pairs that the method found
    directed_pairs: int | None = None  # entries (i, j) of a full list
    exact_pairs: int | None = None  # unordered pairs of the oracle
    missing: int | None = None  # unordered pairs that the oracle has and the method has not
    extra: int | None = None  # unordered pairs that the method has and the oracle has not, repeated ones included
    # `pairs`; `counts` where a method gives only neighbors per particle; or `sample`: the same of 20 000 particles, where there are
    # more than two million. exact_pairs, missing and extra are theirs then, pairs still those of all.
    compared: str | None = None
    density_error: float | None = None  # largest error of a poly6 density over the neighbors that were found, over the mean density
    gradient_error: float | None = None  # of the length of its gradient, over the mean density per cutoff
    # Of a sum of unit vectors, the gradient of 1 - r / cutoff, over the mean number of neighbors: it does not vanish at the cutoff,
    # where methods differ.
    jump_error: float | None = None
    config: str | None = None  # its name
    config_hash: str | None = None  # digest of what it says

    @property
    def scene_name(self) -> str:
        """Layout and fill in words, that which was made where it is known: `corners 2.88 %` of 2 that were asked for."""
        return name_scene(self.layout, self.fill_asked and (self.fill or self.fill_asked))

    @property
    def machine_kind(self) -> tuple[str, ...]:
        """Processor, cores and operating system: times of one kind of machine may be divided by each other."""
        return tuple(str(self.machine.get(name)) for name in ("cpu", "cores", "system"))

    @property
    def scene_key(self) -> tuple[Any, ...]:
        """What decides the positions and the cutoff."""
        return (self.layout, self.fill_asked, *(getattr(self, name) for name in SCENE_FIELDS))

    @property
    def errors(self) -> int | None:
        """Missing and extra pairs together."""
        return None if self.missing is None or self.extra is None else self.missing + self.extra


def name_scene(layout: str, fill: float | None) -> str:
    """Return layout and fill in words, such as `corners 11 %`."""
    return layout if fill is None else f"{layout} {100 * fill:.4g} %"


RowT = TypeVar("RowT")  # a `SearchRow`, or a dict


def values_of(row: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the columns of a row by name."""
    return dict(row) if isinstance(row, dict) else asdict(row)


class RowFile(Generic[RowT]):
    """Rows of one kind in DIR/rows.jsonl: dataclasses, whose fields are the columns, or dicts, which have any.

    Whatever was written before a kill stays; half a last line is cut off. Rows that are done with may be packed by
    `gzip -9n DIR/rows.jsonl`: they are read from rows.jsonl.gz, before those of rows.jsonl, and new ones go to the latter.
    """

    def __init__(self, folder: Path, kind: type[RowT] = SearchRow) -> None:
        """Name the file; nothing is read or written yet."""
        self.path, self._kind = folder / "rows.jsonl", kind

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other runners off the folder; the system lets go of it when this process ends, however it does."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with (self.path.parent / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                folder = self.path.parent
                raise UsageError(f"{folder}: another process fills this folder now; wait for it or take another") from None
            yield

    def repair(self) -> None:
        """End the file with a whole line: complete its last line with a line feed, or cut it off where it is no JSON."""
        if not self.path.exists():
            return
        text = self.path.read_bytes()
        start = text.rfind(b"\n") + 1
        if start == len(text):
            return
        try:
            json.loads(text[start:])
        except ValueError:
            os.truncate(self.path, start)
        else:
            self._write(b"\n")

    def append(self, row: RowT) -> None:
        """Write a row and wait until it is on the disk."""
        self._write(json.dumps(values_of(row), allow_nan=False).encode() + b"\n")

    def _write(self, data: bytes) -> None:
        with self.path.open("ab") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())

    def read(self) -> list[RowT]:
        """Return the latest row of each key, in the order of their first appearance; half a last line is passed over."""
        rows = self.read_all()
        return list({_key(row, number): row for number, row in enumerate(rows)}.values())

    def read_all(self) -> list[RowT]:
        """Return the rows as they stand in the file, also those that others with their key have replaced; refuse what is no row."""
        kind: Any = self._kind
        known = None if kind is dict else {item.name for item in fields(kind)}
        rows: list[Any] = []
        lines = read_text(self.path).split("\n")
        for number, line in enumerate(lines, start=1):
            try:
                values = json.loads(line)
                rows.append(kind(**{name: value for name, value in values.items() if known is None or name in known}))
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                if number < len(lines):  # what follows the last line feed is empty, or what a kill left
                    raise UsageError(f"{self.path}: line {number} is no row ({error}): repair or remove that line") from error
        return rows


def read_text(path: Path) -> str:
    """Return what is packed beside a file (as PATH.gz), and then what the file holds; nothing where there is neither."""
    packed = path.with_name(f"{path.name}.gz")
    try:
        data = gzip.decompress(packed.read_bytes()) if packed.exists() else b""
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise UsageError(f"{packed}: cannot be unpacked ({error}): pack its rows anew, or remove it") from error
    if path.exists():
        data += path.read_bytes()
    return data.decode("utf-8", errors="replace")  # bytes that are no text make a line that is no row, and is named


def _key(row: Any, number: int) -> Any:  # noqa: ANN401
    """Return the key of a row; rows that have none are all different."""
    return row.get("key", number) if isinstance(row, dict) else row.key


def read_latest(folder: Path) -> list[SearchRow]:
    """Return the rows of a sweep that count: of one method on one scene in one round, the last in the file.

    A config that changes how it measures, by how many repeats say, gives its rows other keys, and those from before stay.
    """
    return list({(*row.scene_key, row.method, row.process): row for row in RowFile(folder).read_all()}.values())
