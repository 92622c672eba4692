"""The measurement of one sum in many ways over numbers of particles: a process per row, each on disk before the next one starts."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, field_validator

from experiments import _layouts, _machine, _sweep, _ways
from experiments._config import Positive, Table, Timeout
from experiments._rows import RETRIED, RowFile

ERROR_UNIT = "eps·√neighbors"
"""Of errors of sums: what rounding makes of a sum of so many terms, in machine epsilons."""


class Config(Table):
    """Scenes × ways, and how each row is measured.

    Attributes:
        ways: Names, see `experiments._ways.WAYS`.
        layouts: Of full domains.
        spacings: Distances of lattice neighbors [m], each a number of particles.
        gradients: Whether the gradient is asked for, too.
        compensated: Whether rounding errors are carried along; ways that cannot do so are run without.
        most_points: Of ways that larger scenes are skipped for.
        cutoff_ratio: Cutoff in spacings.
        dtype: Precision of the positions.
        seed: Seed of random layouts and of what each particle contributes.
        repeats: Fewest timed runs of a row.
        min_seconds: Runs go on until they took this long together [s] ...
        max_repeats: ... or until there are so many.
        timeout: A row's process is ended after this time [s].
    """

    ways: tuple[str, ...] = Field(min_length=1)
    layouts: tuple[str, ...] = Field(min_length=1)
    spacings: tuple[Positive, ...] = Field(min_length=1)
    gradients: tuple[bool, ...] = (False, True)
    compensated: tuple[bool, ...] = (False, True)
    most_points: dict[str, int] = Field(default_factory=dict)
    cutoff_ratio: Positive = 3.0
    dtype: Literal["float32", "float64"] = "float32"
    seed: Annotated[int, Field(ge=0)] = 0
    repeats: Annotated[int, Field(ge=1)] = 5
    min_seconds: Annotated[FiniteFloat, Field(ge=0)] = 1.0
    max_repeats: Annotated[int, Field(ge=1)] = 50
    timeout: Timeout = 300.0

    @field_validator("ways")
    @classmethod
    def _ways_exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(map(_ways.known, names))

    @field_validator("layouts")
    @classmethod
    def _layouts_exist(cls, layouts: tuple[str, ...]) -> tuple[str, ...]:
        for layout in layouts:
            if not _layouts.is_layout(layout):
                raise ValueError(f"unknown layout {layout!r}; allowed: {', '.join(_layouts.names())}")
        return layouts

    def specs(self) -> Iterator[_ways.Spec]:
        """Yield the rows, those of one scene and one sum side by side."""
        shared = self.model_dump(include={"cutoff_ratio", "dtype", "seed", "repeats", "min_seconds", "max_repeats", "timeout"})
        for layout, spacing, gradient, name in product(self.layouts, self.spacings, self.gradients, self.ways):
            way, most = _ways.WAYS[name], self.most_points.get(name)
            if gradient and not way.sums:
                continue
            for compensated in self.compensated if way.compensates else (False,):
                about = {"layout": layout, "spacing": spacing, "way": name, "gradient": gradient, "compensated": compensated}
                yield _ways.Spec(**about, most_points=most, **shared)


@dataclass
class Row:
    """One way on one scene, measured in a process of its own. What was not reached is None.

    Attributes:
        key: Digest of what is measured and how; rows with the same key replace each other.
        layout, spacing, cutoff_ratio, dtype, seed, way, gradient, compensated: As in `experiments._ways.Spec`.
        status: As in `experiments._rows.Row`.
        reason: Why the status is not ok.
        points: Number of particles n.
        cutoff: Cutoff [m], rounded to the dtype.
        first_s: First run, compilation included [s].
        median_s: Median of the repeats: list and sums [s].
        p10_s: 10th percentile of the repeats [s].
        p90_s: 90th percentile of the repeats [s].
        repeats: Number of timed runs.
        build_s: Of these the list alone, median [s]; None where there is none.
        sum_s: Of these the sums alone, median [s].
        peak_bytes: Peak of the memory over the start of a run: list, sums and scratch.
        memory_source: VmHWM, or memory_stats of a device; ru_maxrss hides later peaks behind earlier ones.
        error: Largest error against float64 over the sum of |terms|, in eps·sqrt(number of neighbors);
            what the terms are rounded by is in it.
        others_cores, device, versions, machine, commit, dirty, time: As in `experiments._rows.Row`.
    """

    key: str
    layout: str
    spacing: float
    cutoff_ratio: float
    dtype: str
    seed: int
    way: str
    gradient: bool
    compensated: bool
    status: str = "failed"
    reason: str | None = None
    points: int | None = None
    cutoff: float | None = None
    first_s: float | None = None
    median_s: float | None = None
    p10_s: float | None = None
    p90_s: float | None = None
    repeats: int | None = None
    build_s: float | None = None
    sum_s: float | None = None
    peak_bytes: int | None = None
    memory_source: str | None = None
    error: float | None = None
    others_cores: float | None = None
    device: str | None = None
    versions: dict[str, str | None] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)
    commit: str | None = None
    dirty: bool | None = None
    time: str | None = None


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[Row]:
    """Measure every row of the config that the folder does not hold yet, and return all rows of the config.

    Args:
        config: What is measured.
        folder: Holds rows.jsonl.
        retry_failed: Whether rows that are missing, failed or ran out of time are measured again.
    """
    file = RowFile(folder, Row)
    specs = list(config.specs())
    with file.locked(), _sweep.progress(len(specs)) as shown:
        file.repair()
        done = {row.key for row in file.read() if not (retry_failed and row.status in RETRIED)}
        bar = shown.add_task("", total=len(specs))
        about = {"machine": _machine.machine(), **_machine.commit()}
        for spec in specs:
            if spec.key not in done:
                shown.update(bar, description=f"{spec.layout} {spec.spacing:g} m · {spec.way}")
                row = _measured(spec, about)
                file.append(row)
                shown.console.print(describe(row), highlight=False, markup=False, soft_wrap=True)
            shown.advance(bar)
        rows = {row.key: row for row in file.read()}
    return [rows[spec.key] for spec in specs]


def _measured(spec: _ways.Spec, about: dict[str, Any]) -> Row:
    asked = {name: value for name, value in asdict(spec).items() if name in Row.__dataclass_fields__ and name != "repeats"}
    answer = _sweep.ask({"do": "sum", "spec": asdict(spec)}, spec.timeout, cold=False)
    return Row(key=spec.key, **asked, **answer, **about, time=datetime.now(UTC).isoformat(timespec="seconds"))


def describe(row: Row) -> str:
    """Return a row as a line for the reader."""
    what = f"{row.way}{', compensated' * row.compensated}{', gradient' * row.gradient}"
    if row.status != "ok":
        return f"{what:<42} {row.status}: {row.reason}"
    bytes_each = (row.peak_bytes or 0) / (row.points or 1)
    error = "" if row.error is None else f", error {row.error:.2g} {ERROR_UNIT}"
    return f"{what:<42} {row.points:>9} points {row.median_s:9.4f} s {bytes_each:8.0f} B per particle{error}"
