"""The public functions `search`, `search_edges` and `count`."""

import dataclasses
import functools

import jax
from jax import Array
from jax.core import Tracer

from jfrnn._engine import Inputs, count_rows, mark_counts
from jfrnn._geometry import Box, check_capacity, check_flag, check_slack, known_status
from jfrnn._search.edge_list import EdgeList, count_total
from jfrnn._search.exports import check_total
from jfrnn._search.neighbor_list import NeighborList
from jfrnn._search.present import MOST_SLOTS
from jfrnn._search.problem import Asked, check_problem, count_capacity, find_fields
from jfrnn._tracing import (
    AnyCutoff,
    Backend,
    Flag,
    Flags,
    IndexRows,
    Indices,
    Points,
    RadiusRule,
    Real,
    Size,
    call_apart,
    own_transfers,
)


def search(
    positions: Points,
    cutoff: AnyCutoff,
    *,
    queries: Points | None = None,
    box: Box | None = None,
    batch: Indices | tuple[Indices, Indices] | None = None,
    radius_rule: RadiusRule = "gather",
    species: Indices | tuple[Indices, Indices] | None = None,
    exclude: IndexRows | None = None,
    half: Flag = False,
    include_self: Flag = False,
    closed: Flag = False,
    skin: Real = 0.0,
    active: Flags | None = None,
    capacity: Size | None = None,
    slack: Real = 1.0,
    reverse: Flag = False,
    backend: Backend = "auto",
) -> NeighborList:
    """Find every pair of particles closer than a cutoff, exactly.

    (i, j) is a pair iff |x_j - x_i| < cutoff in exact arithmetic on the given floats, the cutoff being rounded once to their dtype.
    Without `capacity` the neighbors are counted first, so that no row can overflow. Cost: O(n + candidates); empty space is free.
    The guide "A search in full" (docs/guides/search.md) tells more of each option, of memory, and of what compiles.

    Args:
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64; see `Box` for fractional coordinates.
        cutoff: Interaction radius [length]: a static number > 0; or one per particle, shape [n], by `radius_rule` (with queries
            [m], [n] or a tuple of both); or with `species` a symmetric table [s, s]. Arrays may be traced and hold 0.
        queries: Points [length] whose neighbors are wanted, shape [m, d], same dtype; default: the positions, without themselves.
        box: Periodic box: each periodic image of j within the cutoff is a pair of its own.
        batch: System of each particle, shape [n], integers; with queries a tuple of [n] and [m]. Only particles of one system pair.
        radius_rule: Whose cutoff a pair has: "gather" that of i, "scatter" that of j, "either" the larger, "both" the smaller,
            "mean" the mean, "sum" the sum.
        species: Row of the table `cutoff` of each particle, shape [n], integers; with queries a tuple of [n] and [m].
        exclude: Pairs that are no neighbors, shape [e, 2], integers; [e, 2 + d] excludes one image (i, j, S). -1 is padding.
        half: List each unordered pair once, in the row of its smaller index. Not with the rules "gather" and "scatter".
        include_self: Make each particle its own neighbor.
        closed: Count pairs at exactly the cutoff (<= instead of <).
        skin: Verlet skin [length], static: the list holds all pairs within cutoff + skin, and `update` seldom has to rebuild it.
        active: Which particles take part, shape [n], bool; positions of the others may be anything.
        capacity: Slots per row, static; required if positions are traced. Default: `slack` times the longest row, rounded up.
        slack: Factor >= 1 on the counted capacity, room for later motion.
        reverse: Keep where each pair stands the other way round, 4 B per slot: derivatives need not find it in each call.
        backend: "warp" (compiled kernels), "jax" (any device), "hashgrid" (`wp.HashGrid`), "brute", or "auto", the fastest there.

    Returns:
        A `NeighborList`; `idx` has shape [m, capacity], unused slots hold n. `status` tells of overflow and coordinates not finite.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or `capacity` is missing under jit.
        ImportError, RuntimeError: the engine's package is not there, or it cannot run on the platform.

    Jit and vmap: yes, with capacity. Gradients: `NeighborList.vectors`. Source: Hockney & Eastwood 1981, ch. 8; Peifle 2019, §2.2.

    >>> import jax.numpy as jnp, jfrnn
    >>> nbrs = jfrnn.search(jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]]), 1.0)
    >>> nbrs.count.tolist(), [indices.tolist() for indices in nbrs.pairs()]
    ([1, 1, 0], [[0, 1], [1, 0]])
    """
    options = (radius_rule, species, exclude, half, include_self, closed, backend, skin, active)
    problem, inputs = check_problem(Asked(positions, cutoff, queries, box, batch, *options))
    slack = check_slack(slack)
    if capacity is None:
        _refuse_traced(inputs, "capacity", "capacity=int(jfrnn.count(positions, cutoff + skin).max())")
        capacity = count_capacity(inputs, problem.options, slack)
    capacity, reverse = check_capacity(capacity), check_flag("reverse", reverse)
    rows = inputs.sources.shape[0] if inputs.queries is None else inputs.queries.shape[0]
    if reverse and rows * capacity > MOST_SLOTS:
        raise ValueError(f"reverse=True numbers slots by int32, got {rows} rows of {capacity} slots: search without.")
    with own_transfers():
        given = {"room": capacity, "moving": problem.skin > 0, "reversing": reverse, "flat": False}
        fields = call_apart(functools.partial(find_fields, options=problem.options, **given), inputs)
        nbrs = NeighborList(**fields, box_numbers=None, problem=problem)
        return dataclasses.replace(nbrs, box_numbers=nbrs._find_box_numbers(inputs)) if problem.skin > 0 else nbrs


def search_edges(  # noqa: D417 (ten arguments share a line)
    positions: Points,
    cutoff: AnyCutoff,
    *,
    total: Size | None = None,
    queries: Points | None = None,
    box: Box | None = None,
    batch: Indices | tuple[Indices, Indices] | None = None,
    radius_rule: RadiusRule = "gather",
    species: Indices | tuple[Indices, Indices] | None = None,
    exclude: IndexRows | None = None,
    half: Flag = False,
    include_self: Flag = False,
    closed: Flag = False,
    skin: Real = 0.0,
    active: Flags | None = None,
    slack: Real = 1.0,
    reverse: Flag = False,
    backend: Backend = "auto",
) -> EdgeList:
    """Find every pair of particles closer than a cutoff, as edges one after another, sorted by receiver.

    These are the pairs of `search`, in memory that follows their number, not the longest row times the number of rows.

    Args:
        positions, cutoff, batch, radius_rule, species, half, include_self, closed, active, backend: As in `search`.
        total: Number of edges that there is room for, a static int up to 2³¹ - 1. Required if positions are traced. Default:
            `slack` times as many as there are pairs, rounded up by 6 % at most.
        queries: As in `search`; the receivers are then queries.
        box: As in `search`. Each image of a neighbor has an edge of its own.
        exclude: As in `search`; `total` knows nothing of excluded pairs.
        skin: As in `search`: the list holds pairs within cutoff + skin, of which `EdgeList.edges` masks those beyond the cutoff.
        slack: Factor >= 1 on the counted total, room for later motion.
        reverse: Keep the edges in the order of their senders, so that derivatives need not sort them in each call.

    Returns:
        An `EdgeList`; `status` tells of overflow and of coordinates that are not finite.

    Raises:
        TypeError, ValueError, ImportError, RuntimeError: as in `search`; ValueError: there are more than 2³¹ - 1 pairs.

    Jit and vmap: yes, with total. Differentiable: see `EdgeList.edges`. Memory: the guide "Memory" (docs/guides/memory.md).

    >>> import jax.numpy as jnp, jfrnn
    >>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
    >>> nbrs = jfrnn.search_edges(x, 1.0, total=4)
    >>> nbrs.receivers.tolist(), nbrs.senders.tolist()
    ([0, 1, 3, 3], [1, 0, 3, 3])
    >>> nbrs.edges(x).distance.tolist()
    [0.5, 0.5, 0.0, 0.0]
    """
    options = (radius_rule, species, exclude, half, include_self, closed, backend, skin, active)
    problem, inputs = check_problem(Asked(positions, cutoff, queries, box, batch, *options))
    problem = dataclasses.replace(problem, options=problem.options._replace(ordered=False))
    slack, reverse = check_slack(slack), check_flag("reverse", reverse)
    if total is None:
        _refuse_traced(inputs, "total", "total=int(jfrnn.count(positions, cutoff + skin).sum())")
        total = count_total(inputs, problem.options, slack)
    total = check_total(total)
    with own_transfers():
        given = {"room": total, "moving": problem.skin > 0, "reversing": reverse, "flat": True}
        fields = call_apart(functools.partial(find_fields, options=problem.options, **given), inputs)
    return EdgeList(**fields, box_numbers=None, problem=problem)


def count(
    positions: Points,
    cutoff: AnyCutoff,
    *,
    queries: Points | None = None,
    box: Box | None = None,
    batch: Indices | tuple[Indices, Indices] | None = None,
    radius_rule: RadiusRule = "gather",
    species: Indices | tuple[Indices, Indices] | None = None,
    exclude: IndexRows | None = None,
    half: Flag = False,
    include_self: Flag = False,
    closed: Flag = False,
    active: Flags | None = None,
    backend: Backend = "auto",
) -> Array:
    """Count the neighbors that `search` would list, without listing them. All arguments are those of `search`.

    Returns:
        Neighbors per row, shape [m], int32. Inside jit, what cannot be known is the smallest int32: the rows of particles with a
        non-finite coordinate, which are never counted as neighbors; and all rows if the data show that pairs may be missing (a box
        that is too small, a particle too far outside of it, a cutoff per particle that is negative or not finite, an unknown
        species or system).

    Raises:
        TypeError, ValueError, ImportError, RuntimeError: as in `search`; ValueError: outside jit, what the `status` of a search
            would report.

    Memory: as in `search`, without the list. Differentiable: no (integers). Jit: yes. vmap: yes.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.count(jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]]), 1.0).tolist()
    [1, 1, 0]
    """
    options = (radius_rule, species, exclude, half, include_self, closed, backend, 0.0, active)
    problem, inputs = check_problem(Asked(positions, cutoff, queries, box, batch, *options))
    with own_transfers():
        counts, _, status = call_apart(functools.partial(count_rows, options=problem.options), inputs)
        known = known_status(status)
        if known is None:
            return call_apart(mark_counts, inputs, counts, status)
    problem.refuse(known, inputs)
    return counts


def _refuse_traced(inputs: Inputs, name: str, how: str) -> None:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(inputs)):
        raise ValueError(
            f"{name} must be given where positions are traced (jax.jit, vmap, grad, scan), because it is a shape: pass {how} of "
            f"concrete positions, with room to move, or the {name} of an earlier search, and check nbrs.overflow."
        )
