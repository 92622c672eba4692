"""Rows: what one measurement says, and the file that they are kept in, one JSON line each."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from experiments._errors import UsageError

STATUSES = ("ok", "missing", "failed", "timeout", "skipped")
RETRIED = ("missing", "failed", "timeout")
SCENE_FIELDS = ("spacing", "cutoff_ratio", "dtype", "dim", "seed", "angle", "growth", "order", "motion")
"""What decides, beside layout and fill, where particles are and what a pair is."""


@dataclass
class Row:
    """One method on one scene, measured in one process of its own. What was not reached is None.

    Attributes:
        key: Digest of scene, method, process and way of measuring; rows with the same key replace each other.
        layout: Name of the layout.
        method: Name of the adapter.
        fill_asked: Fill that the config asked for, as a share of the full domain.
        spacing: Distance of lattice neighbors [m].
        cutoff_ratio: Cutoff in spacings.
        dtype: Precision of the positions.
        dim: Dimensions.
        seed: Seed of random layouts.
        process: Which of the processes that measured the same, from 0.
        angle: Of turnedN and cutN [degrees].
        growth: Of grownN: how many times larger the domain became.
        order: Of the particles: layout, shuffled, or sorted.
        motion: How far particles went between two searches [spacings].
        status: One of `STATUSES`.
        reason: Why the status is not ok; of several processes as one row, why some of them have no figures.
        fill: Fill that the scene has.
        cutoff: Cutoff [m], rounded to the dtype.
        points: Number of particles n.
        allocate_s: Time to find the capacity of the list, for methods that need one before they search [s].
        compile_s: Time of what else is done once: compilation [s].
        first_s: First run after that [s].
        median_s: Median of the repeats, from raw positions to the result [s].
        p10_s: 10th percentile of the repeats [s].
        p90_s: 90th percentile of the repeats [s].
        parts: Median seconds of the parts of a search, by name, where a method tells them apart.
        rebuilt: Share of the searches that made a list anew, of methods that keep one while particles move.
        repeats: Number of timed runs after the first.
        seconds: All their times [s].
        others_cores: Cores that other processes of the machine kept busy meanwhile, on average; None below 0.2 s.
        peak_bytes: Peak resident memory over the start (imports done, positions made), allocation, compilation and the first search
            included.
        search_bytes: That of the first search over what was resident after compilation: what it takes itself, at least list_bytes;
            unknown where the peak cannot be reset. On an accelerator `device_bytes`.
        list_bytes: Size of the result.
        scratch_bytes: search_bytes - list_bytes.
        device_bytes: Peak of the accelerator's memory over what it held before, as JAX and Warp count it: positions, and what the
            compiler tries out, included; None on a CPU.
        planned_list_bytes: The list as `jfrnn.memory_plan` says beforehand; the library's own methods, process 0.
        planned_scratch_bytes: What is needed besides, as it says.
        memory_source: Of search_bytes: VmHWM, reset at both starts; ru_maxrss, which cannot be: earlier peaks hide later ones;
            device.
        pairs: Unordered pairs that the method found.
        directed_pairs: Entries (i, j) of a full list.
        exact_pairs: Unordered pairs of the oracle.
        missing: Unordered pairs that the oracle has and the method has not.
        extra: Unordered pairs that the method has and the oracle has not, repeated ones included.
        compared: `pairs`; `counts` where a method gives only neighbors per particle; or `sample`: the same of 20 000 particles,
            where there are more than two million. `exact_pairs`, `missing` and `extra` are theirs then, `pairs` still those of all.
        density_error: Largest error of a poly6 density over the neighbors that were found, over the mean density.
        gradient_error: The same of the length of its gradient, over the mean density per cutoff.
        jump_error: The same of a sum of unit vectors, the gradient of 1 - r / cutoff, over the mean number of neighbors: it does
            not vanish at the cutoff, where methods differ.
        device: Where it ran.
        versions: Python and the packages.
        machine: Processor, cores, memory [bytes], operating system.
        commit: Commit of the project.
        dirty: Whether the working tree differed from it.
        config: Name of the config.
        config_hash: Digest of what the config says.
        time: When the row was finished, UTC.
    """

    key: str
    layout: str
    method: str
    fill_asked: float | None
    spacing: float
    cutoff_ratio: float
    dtype: str
    dim: int
    seed: int
    process: int = 0
    angle: float | None = None
    growth: float | None = None
    order: str = "layout"
    motion: float = 0.0
    status: str = "failed"
    reason: str | None = None
    fill: float | None = None
    cutoff: float | None = None
    points: int | None = None
    allocate_s: float | None = None
    compile_s: float | None = None
    first_s: float | None = None
    median_s: float | None = None
    p10_s: float | None = None
    p90_s: float | None = None
    parts: dict[str, float] = field(default_factory=dict)
    rebuilt: float | None = None
    repeats: int | None = None
    seconds: list[float] = field(default_factory=list)
    others_cores: float | None = None
    peak_bytes: int | None = None
    search_bytes: int | None = None
    list_bytes: int | None = None
    scratch_bytes: int | None = None
    device_bytes: int | None = None
    planned_list_bytes: int | None = None
    planned_scratch_bytes: int | None = None
    memory_source: str | None = None
    pairs: int | None = None
    directed_pairs: int | None = None
    exact_pairs: int | None = None
    missing: int | None = None
    extra: int | None = None
    compared: str | None = None
    density_error: float | None = None
    gradient_error: float | None = None
    jump_error: float | None = None
    device: str | None = None
    versions: dict[str, str | None] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)
    commit: str | None = None
    dirty: bool | None = None
    config: str | None = None
    config_hash: str | None = None
    time: str | None = None

    @property
    def scene_name(self) -> str:
        """Layout and fill in words, such as `corners 11 %`."""
        return name_scene(self.layout, self.fill_asked)

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


RowT = TypeVar("RowT")


class RowFile(Generic[RowT]):
    """Rows of one kind, dataclasses with a key, in DIR/rows.jsonl.

    Whatever was written before a kill stays; half a last line is cut off.
    """

    def __init__(self, folder: Path, kind: type[RowT] = Row) -> None:
        """Name the file; nothing is read or written yet."""
        self.path, self._kind = folder / "rows.jsonl", kind

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runners off the folder; the system lets go of it when this process ends, however it does.

        Raises:
            UsageError: Another process runs this sweep now.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with (self.path.parent / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UsageError(
                    f"{self.path.parent}: another process fills this folder now; wait for it or take another"
                ) from None
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
        self._write(json.dumps(asdict(cast(Any, row)), allow_nan=False).encode() + b"\n")

    def _write(self, data: bytes) -> None:
        with self.path.open("ab") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())

    def read(self) -> list[RowT]:
        """Return the latest row of each key, in the order of their first appearance; half a last line is passed over.

        Raises:
            UsageError: A line is no row.
        """
        return list({cast(Any, row).key: row for row in self.read_all()}.values())

    def read_all(self) -> list[RowT]:
        """Return the rows as they stand in the file, also those that others with their key have replaced.

        Raises:
            UsageError: A line is no row.
        """
        if not self.path.exists():
            return []
        known = {item.name for item in fields(cast(Any, self._kind))}
        rows: list[RowT] = []
        lines = self.path.read_text(encoding="utf-8", errors="replace").split("\n")  # what is no text is no row, and is named
        for number, line in enumerate(lines, start=1):
            try:
                values = json.loads(line)
                rows.append(self._kind(**{name: value for name, value in values.items() if name in known}))
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                if number < len(lines):  # what follows the last line feed is empty, or what a kill left
                    raise UsageError(f"{self.path}: line {number} is no row ({error}): repair or remove that line") from error
        return rows


def read_latest(folder: Path) -> list[Row]:
    """Return the rows of a sweep that count: of one method on one scene in one round, the last in the file.

    A config that changes how it measures, by how many repeats say, gives its rows other keys, and those from before stay.

    Raises:
        UsageError: A line is no row.
    """
    return list({(*row.scene_key, row.method, row.process): row for row in RowFile(folder).read_all()}.values())
