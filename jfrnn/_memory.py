"""What a search will take of the memory, known from shapes alone: `memory_plan`."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax.sharding import SingleDeviceSharding

from jfrnn import _warp
from jfrnn._auto import WARP_ENGINES, default_platform, fastest_engine
from jfrnn._backends import Inputs, Options, list_rows
from jfrnn._exact import Cutoff
from jfrnn._inputs import checked_backend, checked_capacity, checked_cutoff, checked_kind, checked_size
from jfrnn._runs import Filter


@dataclasses.dataclass(frozen=True)
class MemoryPlan:
    """Say how many bytes one search takes, beside the positions that it is given.

    Attributes:
        list_bytes: The result [B]: 4 per slot, 4 per row for its count, 8 for `status` and `required`.
        scratch_bytes: What the search needs besides while it runs [B].
        backend: The engine, never "auto".
    """

    list_bytes: int
    scratch_bytes: int
    backend: str

    @property
    def total_bytes(self) -> int:
        """List and scratch together [B]."""
        return self.list_bytes + self.scratch_bytes

    def __str__(self) -> str:
        """Return a line each for list, scratch and total, in MB of 10^6 B."""
        lines = [f"one search with backend={self.backend!r}, beside the positions:"]
        parts = {"list": self.list_bytes, "scratch": self.scratch_bytes, "total": self.total_bytes}
        return "\n".join([*lines, *(f"  {name:<8}{size / 1e6:10.2f} MB" for name, size in parts.items())])


def memory_plan(
    n: int,
    cutoff: float,
    capacity: int,
    *,
    dim: int = 3,
    dtype: Any = np.float32,  # noqa: ANN401
    queries: int | None = None,
    backend: str = "auto",
    platform: str | None = None,
) -> MemoryPlan:
    """Say what one `search` with these shapes will take of the memory, before anything is allocated.

    Nothing depends on where the particles are. "warp" and "hashgrid": the sizes of the arrays that they ask for, known for a
    platform that is elsewhere too. "jax" and "brute": what XLA reports of the program that it compiles for these shapes, which
    takes seconds; not in it are the 32 B per point that a sort of "jax" takes for a moment on CPU.

    Args:
        n: Number of particles, from 0 to 2^31 - 32.
        cutoff: Interaction radius [length], checked as in `search`; it does not change the bytes.
        capacity: Slots per row.
        dim: 2 or 3.
        dtype: Of the positions, float32 or float64.
        queries: Number of separate queries; None: the particles themselves are the queries.
        backend: As in `search`.
        platform: JAX platform, such as "cpu" or "gpu"; default: the one on which JAX makes arrays now.

    Returns:
        A `MemoryPlan`; `print` it for a table in MB. "hashgrid" keeps the grid itself, most of its scratch, for the next search.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind or range.
        ImportError: "warp" or "hashgrid", and Warp is not installed.
        RuntimeError: "auto", "jax" or "brute", and JAX does not have the platform here; "warp" or "hashgrid", and it is none of
            "cpu", "gpu" and "cuda".

    >>> import jfrnn
    >>> print(jfrnn.memory_plan(1_000_000, 0.1, 64, backend="warp", platform="gpu"))
    one search with backend='warp', beside the positions:
      list        260.00 MB
      scratch      44.02 MB
      total       304.02 MB
    """
    n, queries = checked_size("n", n), None if queries is None else checked_size("queries", queries)
    dim, dtype = checked_kind(dim, dtype)
    capacity, radius, engine = checked_capacity(capacity), checked_cutoff(cutoff, dtype), checked_backend(backend)
    rows = n if queries is None else queries
    where = default_platform() if platform is None else platform
    if engine == "auto":
        engine = fastest_engine(_device_of(where).platform, n)
    if engine in WARP_ENGINES:
        scratch = _warp.scratch_bytes(engine, where, n, rows, dim, dtype == np.float64, queries is None)
    else:
        at = SingleDeviceSharding(_device_of(where))
        points = [None if size is None else jax.ShapeDtypeStruct((size, dim), dtype, sharding=at) for size in (n, queries)]
        scratch = _compiled_scratch(points, radius, engine, capacity)
    return MemoryPlan(4 * rows * (capacity + 1) + 8, scratch, engine)


def _device_of(platform: str) -> Any:  # noqa: ANN401
    try:
        return jax.local_devices(backend=platform)[0]
    except RuntimeError as error:
        raise RuntimeError(
            f"platform={platform!r} is none that JAX has here, so that nothing can be compiled for it: plan where it is, or name "
            "backend='warp', which can be planned anywhere."
        ) from error


def _compiled_scratch(points: list[jax.ShapeDtypeStruct | None], cutoff: Cutoff, engine: str, capacity: int) -> int:
    """Compile the search for sources and queries of these shapes, and return what XLA says of its temporary arrays [B]."""
    options = Options(Filter(drop_self=points[1] is None, later_only=False), engine, closed=False)
    inputs: Any = Inputs(points[0], points[1], None, None, cutoff)  # pyright: ignore[reportArgumentType] (shapes of arrays)
    analysis = list_rows.lower(inputs, options, capacity).compile().memory_analysis()
    if analysis is None:
        raise RuntimeError("the compiler of this platform does not say what memory a program takes: plan another backend.")
    return int(analysis.temp_size_in_bytes)
