"""One sum in many ways over numbers of particles, a process per row."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from experiments import _sweep
from experiments._config import Dtype, LayoutName, Positive, Repeats
from experiments._loop import Shown, Task, fill
from experiments._rows import RowFile, TimedRow
from experiments.bench.ways import WAYS, Spec, check_way

ERROR_UNIT = "eps·√neighbors"
"""The unit of errors of sums: what rounding makes of a sum of so many terms, in machine epsilons."""


class Config(Repeats):
    """Scenes × ways, and how each row is measured."""

    ways: tuple[Annotated[str, AfterValidator(check_way)], ...] = Field(min_length=1)  # of `ways.WAYS`
    layouts: tuple[LayoutName, ...] = Field(min_length=1)  # of full domains
    spacings: tuple[Positive, ...] = Field(min_length=1)  # distances of lattice neighbors [m], each a number of particles
    gradients: tuple[bool, ...] = (False, True)  # whether the gradient is asked for, too
    compensated: tuple[bool, ...] = (False, True)  # whether rounding errors are carried along, by ways that can do so
    most_points: dict[str, int] = Field(default_factory=dict)  # of ways that larger scenes are skipped for
    cutoff_ratio: Positive = 3.0  # cutoff in spacings
    dtype: Dtype = "float32"  # of the positions
    seed: Annotated[int, Field(ge=0)] = 0  # of random layouts, and of what each particle contributes
    min_seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0

    def specs(self) -> Iterator[Spec]:
        """Yield the rows, those of one scene and one sum side by side."""
        shared = self.model_dump(include={"cutoff_ratio", "dtype", "seed", "repeats", "min_seconds", "max_repeats", "timeout"})
        for layout, spacing, gradient, name in product(self.layouts, self.spacings, self.gradients, self.ways):
            way, most = WAYS[name], self.most_points.get(name)
            if gradient and not way.sums:
                continue
            for compensated in self.compensated if way.compensates else (False,):
                about = {"layout": layout, "spacing": spacing, "way": name, "gradient": gradient, "compensated": compensated}
                yield Spec(**about, most_points=most, **shared)


@dataclass(kw_only=True)
class SumRow(TimedRow):
    """One way on one scene, measured in a process of its own; times are of list and sums."""

    layout: str
    spacing: float
    cutoff_ratio: float
    dtype: str
    seed: int
    way: str
    gradient: bool
    compensated: bool
    points: int | None = None  # number of particles n
    cutoff: float | None = None  # [m], rounded to the dtype
    build_s: float | None = None  # the list alone, median [s]; None where there is none
    sum_s: float | None = None  # the sums alone, median [s]
    peak_bytes: int | None = None  # peak of the memory over the start of a run: list, sums and scratch
    memory_source: str | None = None  # VmHWM, or memory_stats of a device; ru_maxrss hides later peaks behind earlier ones
    # Largest error against float64 over the sum of |terms|, in eps·sqrt(number of neighbors), rounding of the terms included.
    error: float | None = None


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[SumRow]:
    """Measure every row of the config that the folder does not hold yet, and return all rows of the config."""
    tasks = [Task((x.key,), f"{x.layout} {x.spacing:g} m · {x.way}", partial(_measure, x)) for x in config.specs()]
    return fill(RowFile(folder, SumRow), tasks, describe, retry_failed=retry_failed)


def _measure(spec: Spec, shown: Shown) -> list[SumRow]:
    known = {item.name for item in fields(SumRow)} - {"repeats"}
    asked: dict[str, Any] = {name: value for name, value in asdict(spec).items() if name in known}
    return [SumRow(key=spec.key, **asked, **_sweep.ask({"do": "sum", "spec": asdict(spec)}, spec.timeout, cold=False))]


def describe(row: SumRow) -> str:
    """Return a row as a line for the reader."""
    what = f"{row.way}{', compensated' * row.compensated}{', gradient' * row.gradient}"
    if row.status != "ok":
        return f"{what:<42} {row.status}: {row.reason}"
    bytes_each = (row.peak_bytes or 0) / (row.points or 1)
    error = "" if row.error is None else f", error {row.error:.2g} {ERROR_UNIT}"
    return f"{what:<42} {row.points:>9} points {row.median_s:9.4f} s {bytes_each:8.0f} B per particle{error}"
