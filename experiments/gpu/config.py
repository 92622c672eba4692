"""What a run on a GPU is told, see experiments/configs/h200.toml."""

from typing import Annotated, Literal

from pydantic import AfterValidator, NonNegativeInt, PositiveInt

from experiments._config import Dtype, Positive, Table
from experiments.bench import ways


class Exactness(Table):
    """Which hard cases are decided on the device."""

    backend: Literal["jax", "warp", "hashgrid", "brute", "bvh"]
    dtypes: list[Dtype]
    dims: list[Literal[2, 3]]
    capacity: PositiveInt
    # which table of jfrnn.cases, or "sums" of whole numbers against lists
    cases: Literal["hard", "periodic", "radii", "batches", "triangles", "sums"] = "hard"
    # every case is filled up to so many rows with points that are nowhere: where queries are many, 32 of them share a warp
    least_rows: NonNegativeInt = 0


class Triangles(Table):
    """Which lists of triangles around a gear are timed: every combination."""

    points: list[PositiveInt]
    faces: PositiveInt  # about
    cutoffs: list[Positive]  # in modules
    dtypes: list[Dtype]


class Config(Table):
    """What is run."""

    seed: int
    reach_in_spacings: Positive
    jitter_in_spacings: Positive
    sizes: list[PositiveInt]
    corners_fill: Positive | None = None  # none: no scene of corners
    counts_only: list[PositiveInt]
    calls: PositiveInt
    steps: PositiveInt
    sums: tuple[Annotated[str, AfterValidator(ways.check_way)], ...] = ()  # of a density and its gradient
    repeats: PositiveInt
    seconds_per_timing: Positive
    exactness: list[Exactness]
    triangles: tuple[Triangles, ...] = ()
