"""The memory that a search or a pair sum will take, known from shapes alone: `memory_plan`."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import SingleDeviceSharding

from jfrnn import _engine as engine
from jfrnn._geometry import Cutoff, check_capacity, check_cutoff, check_flag, check_kind, check_size, check_skin, make_cutoff
from jfrnn._search import check_total
from jfrnn._sums import pair_sum
from jfrnn._tracing import Flag, Given, Number, Real, Size, Tree
from jfrnn._triangles import TRIANGLE_ENGINES, TriangleEngine, fastest_of, find_triangles

Device = Any  # jax.Device, which type checkers treat as a variable
MemoryStats = Any  # XLA's memory analysis of a compiled program


@dataclasses.dataclass(frozen=True)
class MemoryPlan:
    """The bytes that one search, count or pair sum takes in addition to its given positions and values.

    Attributes:
        list_bytes: The result of a search [B]: 4 per slot, 4 per row for its count, 8 for `status` and `required` (of
            `search_edges` 8 per edge, 4 per row and 12); with a skin,
            also copies of positions and queries, and 4; with `reverse`, another 4 per slot, and for queries 8 per source; on a GPU
            by "warp", from 4097 particles on and without queries, 4 per particle for their order.
        scratch_bytes: Memory needed in addition while it runs [B].
        backend: The engine, never "auto".
        sums_bytes: The results of a pair sum, and of its gradient if planned [B].
        counts_bytes: The result of `count`, 4 per row [B]; None if the plan is not that of a count.
    """

    list_bytes: int
    scratch_bytes: int
    backend: str
    sums_bytes: int = 0
    counts_bytes: int | None = None

    @property
    def result_bytes(self) -> int:
        """The list, the sums or the counts [B]."""
        return self.list_bytes + self.sums_bytes + (self.counts_bytes or 0)

    @property
    def total_bytes(self) -> int:
        """Results and scratch together [B]."""
        return self.result_bytes + self.scratch_bytes

    def __str__(self) -> str:
        """Return one line each for the results, scratch and total, in MB of 10^6 B."""
        done, given, result = ("search", "positions", "list") if self.list_bytes else ("pair sum", "positions and values", "sums")
        if self.counts_bytes is not None:
            done, given, result = "count", "positions", "counts"
        lines = [f"one {done} with backend={self.backend!r}, beside the {given}:"]
        parts = {result: self.result_bytes, "scratch": self.scratch_bytes, "total": self.total_bytes}
        return "\n".join([*lines, *(f"  {name:<8}{size / 1e6:10.2f} MB" for name, size in parts.items())])


def memory_plan(
    n: Size,
    cutoff: Number,
    capacity: Size | None = None,
    *,
    total: Size | None = None,
    dim: int = 3,
    dtype: np.dtype | type | str = np.float32,
    queries: int | None = None,
    skin: Real = 0.0,
    reverse: Flag = False,
    fn: Callable[[Any, Any, Any], Any] | None = None,
    values: Tree = None,
    gradient: bool = False,
    faces: int | None = None,
    backend: str = "auto",
    platform: str | None = None,
) -> MemoryPlan:
    """Predict the memory of a `search`, `search_edges` (total), `count`, `pair_sum` (fn) or `search_triangles` (faces).

    Nothing depends on where the particles are. For "warp" and "hashgrid" the plan adds the sizes of the arrays that they allocate,
    and works for platforms that this machine lacks. For "jax" and "brute" it is XLA's analysis of the program, compiled for these
    shapes, which takes seconds. Pair sums are compiled too. The plan is that of open space; the guide "Memory"
    (docs/guides/memory.md) tells what lists of batches, boxes, species and exclusions keep in addition.

    Args:
        n: Number of particles, from 0 to 2^31 - 32.
        cutoff: Interaction radius [length], checked as in `search`; it does not change the bytes.
        capacity: Slots per row; None: no list is made, and the plan is that of `count` or of a pair sum.
        total: Edges of a flat list, which `search_edges` makes; without capacity.
        dim: 2 or 3.
        dtype: Dtype of the positions, float32 or float64.
        queries: Number of separate queries; None: the particles themselves are the queries.
        skin: As in `search`; only whether there is one changes the bytes.
        reverse: As in `search`, for a full list, or one of queries.
        fn: As in `pair_sum`, which is then planned.
        values: As in `pair_sum`, a pytree of arrays or of their shapes (`jax.ShapeDtypeStruct`), [n, ...].
        gradient: Plan the sums together with a gradient in the positions, of a function of all sums of floats.
        faces: Number of triangles of a wall, in 2D segments: `search_triangles` is then planned, by compilation; the cells and a
            copy of the wall, of faces / 2 + 2 vertices, are part of the list.
        backend: As in `search`, `pair_sum` or `search_triangles`.
        platform: JAX platform, such as "cpu" or "gpu"; default: the one on which JAX places arrays now.

    Returns:
        A `MemoryPlan`; `print` it for a table in MB. "hashgrid" keeps the grid itself, most of its scratch, for the next search.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind or range, or `pair_sum` would raise it.
        ImportError: "warp" or "hashgrid", and Warp is not installed.
        RuntimeError: "auto", "jax", "brute" or a pair sum, and JAX does not have the platform here; "warp" or "hashgrid", and it is
            none of "cpu", "gpu" and "cuda".

    >>> import jfrnn
    >>> print(jfrnn.memory_plan(1_000_000, 0.1, 64, backend="warp", platform="gpu"))
    one search with backend='warp', beside the positions:
      list        264.00 MB
      scratch      44.03 MB
      total       308.03 MB
    """
    n, queries = check_size("n", n), None if queries is None else check_size("queries", queries)
    dim, dtype = check_kind(dim, dtype)
    radius = make_cutoff(check_cutoff(cutoff, dtype), dtype, closed=False)
    rows, gradient = n if queries is None else queries, check_flag("gradient", gradient)
    where = engine.default_platform() if platform is None else platform
    skin, reverse = check_skin(skin, float(radius.radius), dtype), check_flag("reverse", reverse)
    _check_parts(faces, queries, fn, capacity, gradient or values is not None)
    if (skin or reverse) and (faces is not None or fn is not None or (capacity is None and total is None)):
        raise ValueError("skin and reverse are those of a list: say its capacity or total, or leave them out.")
    if total is not None and not (faces is None and fn is None and capacity is None):
        raise ValueError("total is that of a flat list, which has no capacity, no faces and no fn: leave them out.")
    if faces is not None:
        sizes = (n, check_size("faces", faces), dim, check_capacity(capacity))
        return _plan_of_triangles(
            sizes, dtype, radius, engine.parse_backend(backend, TRIANGLE_ENGINES, " with faces"), _device_of(where)
        )
    named = engine.parse_backend(backend, engine.ENGINES)
    if fn is not None:
        points = _shapes_of(n, queries, dim, dtype)
        return _plan_of_sum(fn, points, float(cutoff), values, gradient, named, _device_of(where))
    capacity, total = None if capacity is None else check_capacity(capacity), None if total is None else check_total(total)
    chosen = named or engine.fastest_engine(_device_of(where).platform, n)
    scratch = chosen.scratch_bytes(where, n, rows, dim, dtype == np.float64, queries is None, radius.scaled)
    if scratch is None:
        scratch = _compiled_scratch(_shapes_of(n, queries, dim, dtype, _device_of(where)), radius, chosen, capacity, total)
    elif total is not None:
        scratch += 8 * rows + 4  # counts, and where rows begin
        length = engine.length_of_rows(chosen, where, (n, rows), total)
        if length is not None:
            scratch += 4 * rows * (length + 2)  # rows, and counts and starts once more, for a condition
        elif where == "cpu":
            scratch += 4 * total  # XLA writes one of the two arrays anew
    if capacity is None and total is None:
        return MemoryPlan(0, scratch, chosen.name, counts_bytes=4 * rows)
    kept = (n + (queries or 0)) * dim * dtype.itemsize + 4 if skin else 0
    if total is not None:
        kept += 4 * total + 8 * n if reverse else 0
        return MemoryPlan(8 * total + 4 * (rows + 1) + 8 + kept, scratch, chosen.name)
    slots = rows * (capacity or 0)
    kept += 4 * slots + (0 if queries is None else 8 * n) if reverse else 0
    kept += 4 * n if engine.has_order(chosen, where, n, queries is None) else 0
    return MemoryPlan(4 * (slots + rows) + 8 + kept, scratch, chosen.name)


def _check_parts(
    faces: int | None, queries: int | None, fn: Callable[..., Any] | None, capacity: Size | None, of_sums: bool
) -> None:
    """Refuse arguments that do not belong to what is planned."""
    if faces is not None and (fn is not None or queries is not None):
        raise ValueError("faces belong to a search for triangles, which knows neither fn nor queries: leave them out.")
    if faces is None and fn is not None and capacity is not None:
        raise ValueError(f"capacity is that of a list, which a pair sum does not make: leave it out, or fn, got {capacity}.")
    if faces is None and fn is None and of_sums:
        raise ValueError("values and gradient belong to a pair sum: say its fn, too.")


def _shapes_of(n: int, queries: int | None, dim: int, dtype: np.dtype, device: Device = None) -> list[jax.ShapeDtypeStruct | None]:
    at = None if device is None else SingleDeviceSharding(device)
    return [None if size is None else jax.ShapeDtypeStruct((size, dim), dtype, sharding=at) for size in (n, queries)]


def _device_of(platform: str) -> Device:
    try:
        return jax.local_devices(backend=platform)[0]
    except RuntimeError as error:
        raise RuntimeError(
            f"platform={platform!r} is none that JAX has here, so that nothing can be compiled for it: plan where it is, or name "
            "backend='warp', which can be planned anywhere."
        ) from error


def _compiled_scratch(
    points: list[jax.ShapeDtypeStruct | None], cutoff: Cutoff, chosen: engine.Engine, capacity: Size | None, total: Size | None
) -> int:
    """Compile the search, or the count, for these shapes, and return XLA's size of its temporary arrays [B]."""
    options = engine.Options(engine.Filter(drop_self=points[1] is None, later_only=False), chosen, closed=False)
    inputs: Any = engine.Inputs(points[0], points[1], None, None, cutoff)  # pyright: ignore[reportArgumentType] (shapes of arrays)
    if total is not None:
        lowered = engine.list_flat.lower(inputs, options, total)
    else:
        lowered = (
            engine.count_rows.lower(inputs, options) if capacity is None else engine.list_rows.lower(inputs, options, capacity)
        )
    return int(_analysis(lowered).temp_size_in_bytes)


def _plan_of_triangles(
    sizes: tuple[int, int, int, int], dtype: np.dtype, cutoff: Cutoff, named: TriangleEngine | None, device: Device
) -> MemoryPlan:
    """Compile a search of n particles for triangles, in dim dimensions, with this capacity."""
    n, faces, dim, capacity = sizes
    at = SingleDeviceSharding(device)
    chosen = named or fastest_of(device.platform, engine.fastest_engine(device.platform, n))
    points, corners = (jax.ShapeDtypeStruct((size, dim), dtype, sharding=at) for size in (n, faces // 2 + 2))
    triples: Any = jax.ShapeDtypeStruct((faces, dim), np.int32, sharding=at)
    analysis = _analysis(find_triangles.lower(points, corners, triples, None, cutoff, chosen, capacity))
    closed = 1  # one byte for `closed`, which a separate program computes
    return MemoryPlan(int(analysis.output_size_in_bytes) + closed, int(analysis.temp_size_in_bytes), chosen.name)


def _analysis(lowered: jax.stages.Lowered) -> MemoryStats:
    analysis = lowered.compile().memory_analysis()
    if analysis is None:
        raise RuntimeError("the compiler of this platform does not say what memory a program takes: plan another backend.")
    return analysis


def _plan_of_sum(
    fn: Callable[[Any, Any, Any], Any],
    points: list[jax.ShapeDtypeStruct | None],
    cutoff: float,
    values: Tree,
    gradient: bool,
    named: engine.Engine | None,
    device: Device,
) -> MemoryPlan:
    """Compile a pair sum for sources and queries of these shapes, with the engine that "auto" means."""

    def program(x: Array, queries: Array | None, values: Tree, *, backend: Given) -> Tree:
        def loss(x: Array) -> Tree:
            sums = pair_sum(fn, x, cutoff, values, queries=queries, backend=backend)
            floats = (leaf for leaf in jax.tree.leaves(sums) if jnp.issubdtype(leaf.dtype, jnp.floating))
            return sum(jnp.vdot(leaf, leaf) for leaf in floats), sums

        return jax.grad(loss, has_aux=True)(x) if gradient else loss(x)[1]

    def plan(backend: str) -> MemoryPlan:
        analysis = _analysis(jax.jit(functools.partial(program, backend=backend)).lower(*points, shapes))
        return MemoryPlan(0, int(analysis.temp_size_in_bytes), backend, int(analysis.output_size_in_bytes))

    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), values)
    with jax.default_device(device):
        if named is not None:
            return plan(named.name)
        if engine.fastest_engine(device.platform, 1).translates:
            with contextlib.suppress(TypeError, ValueError, NotImplementedError):  # then "jax" sums it, or explains the error
                return plan("warp")
        return plan("jax")
