"""The two public verbs: `search` and `count`."""

from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._auto import choose_engine
from jfrnn._backends import Options, count_rows, list_rows, without_inactive
from jfrnn._exact import Cutoff, make_cutoff
from jfrnn._inputs import (
    checked_active,
    checked_backend,
    checked_capacity,
    checked_cutoff,
    checked_flag,
    checked_positions,
    checked_skin,
    checked_slack,
)
from jfrnn._neighbors import NeighborList, counted_capacity
from jfrnn._runs import Filter
from jfrnn._verlet import first_verlet, list_radius


def search(
    positions: Array,
    cutoff: float,
    *,
    queries: Array | None = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
    skin: float = 0.0,
    active: Array | None = None,
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
        skin: Extra shell [length], a static number >= 0: the list holds all pairs within cutoff + skin, so that
            `NeighborList.update` need not make it anew before something has moved skin/2. `vectors` and `distances` mask to the
            cutoff.
        active: Which particles take part, shape [n], bool; default: all. An inactive one has no neighbors and is nobody's, and its
            position may be anything. Room for particles to come: the shapes, and so the compiled program, stay the same.
        capacity: Slots per row, a static int. Required where positions are traced. Default: `slack` times the longest row,
            rounded up to a multiple of 8.
        slack: Factor >= 1 on the counted capacity, room for later motion.
        backend: "warp" (cells, compiled kernels, on CPU and NVIDIA GPUs), "hashgrid" (Warp's own `wp.HashGrid`, there too), "jax"
            (cells, any device), "brute" (all n·m candidates), or "auto": what was measured to be fastest on the platform, "warp" on
            the CPU and on NVIDIA GPUs (where Warp is missing "jax", with a warning), elsewhere "jax". The platform is that of the
            positions, where they are traced that of `jax.default_device`.

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
    problem = _checked_problem(positions, cutoff, queries, half, include_self, closed, backend, skin, active)
    slack = checked_slack(slack)
    if capacity is None:
        capacity = _counted_capacity(problem, slack)
    rows = list_rows(*problem.inputs, checked_capacity(capacity))
    sources = problem.inputs.sources
    return NeighborList(
        rows.idx,
        rows.counts,
        rows.status,
        rows.required,
        first_verlet(without_inactive(sources, problem.inputs.active), problem.inputs.queries) if problem.skin else None,
        cutoff=problem.radius,
        skin=problem.skin,
        half=problem.inputs.options.filter.later_only,
        include_self=queries is None and not problem.inputs.options.filter.drop_self,
        closed=problem.inputs.cutoff.closed,
        own_queries=queries is not None,
        masked=active is not None,
        source_count=sources.shape[0],
        backend=problem.inputs.options.backend,
    )


def count(
    positions: Array,
    cutoff: float,
    *,
    queries: Array | None = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
    active: Array | None = None,
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
        active: As in `search`.
        backend: As in `search`.

    Returns:
        Neighbors per row, shape [m], int32. A particle with a non-finite coordinate has none, and is nobody's.

    Raises:
        TypeError, ValueError, ImportError, RuntimeError: as in `search`.

    Memory: as in `search`, without the list. Differentiable: no (integers). Jit: yes. vmap: yes.
    """
    problem = _checked_problem(positions, cutoff, queries, half, include_self, closed, backend, 0.0, active)
    return count_rows(*problem.inputs)


class _Inputs(NamedTuple):
    """What the compiled programs take, but for a capacity; the cutoff is that of the list, with the skin."""

    sources: Array
    queries: Array | None
    active: Array | None
    cutoff: Cutoff
    options: Options


class _Problem(NamedTuple):
    inputs: _Inputs
    radius: float  # of a pair, without the skin
    skin: float


def _checked_problem(
    positions: Any,  # noqa: ANN401
    cutoff: Any,  # noqa: ANN401
    queries: Any,  # noqa: ANN401
    half: bool,
    include_self: bool,
    closed: bool,
    backend: str,
    skin: Any,  # noqa: ANN401
    active: Any,  # noqa: ANN401
) -> _Problem:
    sources = checked_positions("positions", positions)
    if queries is not None:
        queries = checked_positions("queries", queries, like=sources)
        for name, value in (("half", half), ("include_self", include_self)):
            if checked_flag(name, value):
                raise ValueError(f"{name}=True pairs particles with themselves or each other: it cannot be used with queries.")
    active = None if active is None else checked_active(active, sources)
    pair_filter = Filter(
        drop_self=queries is None and not checked_flag("include_self", include_self),
        later_only=checked_flag("half", half),
    )
    dtype = np.dtype(sources.dtype)
    pair_cutoff = checked_cutoff(cutoff, dtype, closed)
    radius = float(pair_cutoff.radius)
    skin = checked_skin(skin, radius, dtype)
    list_cutoff = make_cutoff(list_radius(radius, skin, dtype), dtype, pair_cutoff.closed) if skin else pair_cutoff
    engine = choose_engine(checked_backend(backend), sources, queries)
    options = Options(pair_filter, engine, float(list_cutoff.radius) if engine == "hashgrid" else None)
    return _Problem(_Inputs(sources, queries, active, list_cutoff, options), radius, skin)


def _counted_capacity(problem: _Problem, slack: float) -> int:
    if any(isinstance(x, Tracer) for x in problem.inputs[:3]):
        raise ValueError(
            "capacity must be given where positions are traced (jax.jit, vmap, grad, scan), because it is a shape: pass "
            "capacity=int(jfrnn.count(positions, cutoff + skin).max()) of concrete positions, with room to move, or the capacity "
            "of an earlier search, and check nbrs.overflow."
        )
    return counted_capacity(*problem.inputs, slack)
