"""The two public verbs: `search` and `count`."""

import functools
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._auto import choose_engine
from jfrnn._backends import Options, neighbors
from jfrnn._exact import Cutoff
from jfrnn._inputs import (
    checked_backend,
    checked_capacity,
    checked_cutoff,
    checked_flag,
    checked_positions,
    checked_slack,
)
from jfrnn._neighbors import NeighborList
from jfrnn._runs import Filter
from jfrnn._warp import Rows

_CAPACITY_STEP = 8  # eager capacities are rounded up to a multiple, so that similar scenes share one compiled program


def search(
    positions: Array,
    cutoff: float,
    *,
    queries: Array | None = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
    capacity: int | None = None,
    slack: float = 1.0,
    backend: str = "auto",
) -> NeighborList:
    """Find every pair of particles closer than a cutoff, exactly.

    (i, j) is a pair iff |x_j - x_i| < cutoff in exact arithmetic on the given floats, the cutoff being rounded once to their
    dtype. Without `capacity` the neighbors are counted first, so that no row can overflow. Cost: O(n + candidates), a particle's
    candidates being the particles in the 3^d cells around it; empty space costs nothing, however large.

    Args:
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64. n = 0 is allowed.
        cutoff: Interaction radius [length], a static number > 0.
        queries: Points [length] whose neighbors among `positions` are wanted, shape [m, d], same dtype; default: the positions
            themselves, each particle being excluded from its own row by index.
        half: Keep each unordered pair once, in the row of its smaller index.
        include_self: Make each particle its own neighbor.
        closed: Count pairs at exactly the cutoff (<= instead of <).
        capacity: Slots per row, a static int. Required where positions are traced. Default: `slack` times the longest row,
            rounded up to a multiple of 8.
        slack: Factor >= 1 on the counted capacity, room for later motion.
        backend: "warp" (cells, compiled kernels, on CPU and NVIDIA GPUs), "hashgrid" (Warp's own `wp.HashGrid`, there too), "jax"
            (cells, any device), "brute" (all n·m candidates), or "auto": what was measured to be fastest on the platform, "warp" on
            the CPU (where Warp is missing "jax", with a warning), elsewhere "jax". The platform is that of the positions, where
            they are traced that of `jax.default_device`.

    Returns:
        A `NeighborList`; `idx` has shape [m, capacity], unused slots hold n. Rows are in no promised order, but the same input
        gives the same bits.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or `capacity` is missing under jit.
        ImportError: "warp" or "hashgrid" without the package that they need.
        RuntimeError: "warp" or "hashgrid" on a platform on which Warp cannot run.
        Overflow of a given capacity and non-finite coordinates are known only from data: `status`, `overflow` and `check` tell.

    Memory: 4 B per slot for the list; besides it, whatever the box, "warp" takes at most 64 B and "hashgrid" 84 B per particle,
    "jax" and "brute" at most 64 MB for the block in work and 100 B per particle (float64: 125 B). See `memory_plan`.
    Differentiable: the list is topology, without gradient; see `NeighborList.vectors`. Jit: yes, with capacity. vmap: yes, with
    capacity. Source: cell lists (Hockney & Eastwood 1981, ch. 8); strict cutoff (Peifle 2019, §2.2).
    """
    problem = _checked_problem(positions, cutoff, queries, half, include_self, closed, backend)
    slack = checked_slack(slack)
    if capacity is None:
        capacity = _counted_capacity(problem, slack)
    rows = _search(*problem, checked_capacity(capacity))
    return NeighborList(
        rows.idx,
        rows.counts,
        rows.status,
        rows.required,
        cutoff=float(problem.cutoff.radius),
        half=problem.options.filter.later_only,
        include_self=queries is None and not problem.options.filter.drop_self,
        closed=problem.cutoff.closed,
        own_queries=queries is not None,
        source_count=problem.sources.shape[0],
        backend=problem.options.backend,
    )


def count(
    positions: Array,
    cutoff: float,
    *,
    queries: Array | None = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
    backend: str = "auto",
) -> Array:
    """Count the neighbors that `search` would list, without listing them.

    Args:
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64.
        cutoff: Interaction radius [length], a static number > 0.
        queries: As in `search`.
        half: As in `search`.
        include_self: As in `search`.
        closed: As in `search`.
        backend: As in `search`.

    Returns:
        Neighbors per row, shape [m], int32. A particle with a non-finite coordinate has none, and is nobody's.

    Raises:
        TypeError, ValueError, ImportError, RuntimeError: as in `search`.

    Memory: as in `search`, without the list. Differentiable: no (integers). Jit: yes. vmap: yes.
    """
    problem = _checked_problem(positions, cutoff, queries, half, include_self, closed, backend)
    return _count(*problem)


class _Problem(NamedTuple):
    sources: Array
    queries: Array | None
    cutoff: Cutoff
    options: Options


def _checked_problem(
    positions: Any,  # noqa: ANN401
    cutoff: Any,  # noqa: ANN401
    queries: Any,  # noqa: ANN401
    half: bool,
    include_self: bool,
    closed: bool,
    backend: str,
) -> _Problem:
    sources = checked_positions("positions", positions)
    if queries is not None:
        queries = checked_positions("queries", queries, like=sources)
        for name, value in (("half", half), ("include_self", include_self)):
            if checked_flag(name, value):
                raise ValueError(f"{name}=True pairs particles with themselves or each other: it cannot be used with queries.")
    pair_filter = Filter(
        drop_self=queries is None and not checked_flag("include_self", include_self),
        later_only=checked_flag("half", half),
    )
    pair_cutoff = checked_cutoff(cutoff, np.dtype(sources.dtype), closed)
    engine = choose_engine(checked_backend(backend), sources, queries)
    radius = float(pair_cutoff.radius) if engine == "hashgrid" else None
    return _Problem(sources, queries, pair_cutoff, Options(pair_filter, engine, radius))


def _counted_capacity(problem: _Problem, slack: float) -> int:
    arrays = [x for x in (problem.sources, problem.queries) if x is not None]
    if any(isinstance(x, Tracer) for x in arrays):
        raise ValueError(
            "capacity must be given where positions are traced (jax.jit, vmap, grad, scan), because it is a shape: pass "
            "capacity=int(jfrnn.count(positions, cutoff).max()) of concrete positions, with room to move, or the capacity of an "
            "earlier search, and check nbrs.overflow."
        )
    with jax.ensure_compile_time_eval():
        longest = int(np.max(_count(*problem), initial=0))
    wanted = math.ceil(max(longest, 1) * slack)
    rounded = -(-wanted // _CAPACITY_STEP) * _CAPACITY_STEP
    return min(rounded, max(wanted, problem.sources.shape[0]))


@functools.partial(jax.jit, static_argnames="options")
def _count(sources: Array, queries: Array | None, cutoff: Cutoff, options: Options) -> Array:
    return neighbors(sources, queries, cutoff, options, None).counts


@functools.partial(jax.jit, static_argnames=("options", "capacity"))
def _search(sources: Array, queries: Array | None, cutoff: Cutoff, options: Options, capacity: int) -> Rows:
    return neighbors(sources, queries, cutoff, options, capacity)
