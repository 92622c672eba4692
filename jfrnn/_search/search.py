"""The public functions `search`, `search_edges` and `count`."""

import dataclasses

import jax
from jax import Array
from jax.core import Tracer

from jfrnn._engine import Inputs, count_rows, mark_counts
from jfrnn._geometry import Box, check_capacity, check_flag, check_slack, known_status
from jfrnn._search.edge_list import EdgeList, count_total
from jfrnn._search.exports import check_total
from jfrnn._search.making import count_capacity, find_fields, find_flat_fields
from jfrnn._search.neighbor_list import NeighborList
from jfrnn._search.problem import check_problem
from jfrnn._search.reverse import MOST_SLOTS
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
    Without `capacity` the neighbors are counted first, so that no row can overflow. Cost: O(n + candidates), a particle's
    candidates being the particles in the 3^d cells around it; empty space costs nothing, however large.

    Args:
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64. n = 0 is allowed. With a box made with
            `fractional=True`, these and `queries` count its lattice vectors, here and wherever the list is given positions.
        cutoff: Interaction radius [length]: a static number > 0; or one per particle, an array of floats of shape [n], which may be
            traced and hold 0, and to which `radius_rule` applies. With separate queries "gather" needs [m], "scatter" [n], and the
            other rules a tuple of both, that of the positions first. Or, with `species`, one per pair of species, a symmetric array
            of floats of shape [s, s], which may be traced; species whose entry is 0 are no neighbors, wherever they are.
        queries: Points [length] whose neighbors among `positions` are wanted, shape [m, d], same dtype; default: the positions
            themselves, each particle being excluded from its own row by index.
        box: Periodic box (`Box`): (i, j) is then listed once for each periodic image of j within the cutoff, with displacement x_j
            - x_i + S·(lattice vectors) for whole numbers S, which `NeighborList.shifts` returns. Particles may be 2^19 lengths
            (float64: 2^30) away from the box, or 511 vectors of a skewed one, and more where nothing is rounded; along axes that
            are not periodic it has no effect. A box per system of a `batch` is one search, in which each system pays for its own
            images.
        batch: System number of each particle, shape [n], integers, in any order; with queries a tuple of [n]
            and [m]. Only particles of one system are neighbors. Many systems cost what their particles cost, even if they overlap
            in space. If `box` holds a box per system, numbers count its boxes from 0 on, and particles of the number -1 are not
            there: they have no neighbors, and their positions may be anything.
        radius_rule: How the cutoff of a pair follows from cutoffs per particle: "gather" is that of i, the row; "scatter" that of
            j; "either" the larger, "both" the smaller, "mean" the exact mean, "sum" the exact sum, for contacts of spheres. Large
            cutoffs do not slow down particles with small ones: up to a ratio of 128, each particle searches cells of its own size.
            With a box per system, cells are as wide as the largest cutoff in their system.
        species: Row of the table `cutoff` [s, s] that belongs to each particle, shape [n], integers from 0 to s - 1; with queries a
            tuple of [n] and [m]. Particles of other species have no neighbors: outside jit, and without `active`, this raises, and
            inside a status bit says so.
        exclude: Pairs that are no neighbors, such as bonded atoms, whatever their distance: shape [e, 2], integers, numbers of two
            particles in each row, in any order; with queries those of a query and of a particle. All periodic images of a pair are
            excluded, those of particle i with itself by (i, i). With a box also shape [e, 2 + d]: rows (i, j, S) exclude one image,
            that of j at the shift S of `NeighborList.shifts`. Rows in which i or j is -1 are padding; partners of each particle are
            written as pairs by `pairs_of_rows`. `count`, `capacity` and sums know nothing of excluded pairs, and updates keep them.
            Only the number of rows is static. Traced numbers of particles that do not exist set a status bit.
        half: List each unordered pair once, in the row of its smaller index; of the images of a particle that are its own
            neighbors, those whose shift S has a positive number first. Not with the rules "gather" and "scatter".
        include_self: Make each particle its own neighbor, whatever its cutoff, 0 included.
        closed: Count pairs at exactly the cutoff (<= instead of <).
        skin: Verlet skin [length], a static number >= 0: the list holds all pairs within cutoff + skin, so that
            `NeighborList.update` need not rebuild it before something has moved skin/2. `vectors` and `distances` mask to the
            cutoff.
        active: Which particles take part, shape [n], bool; default: all. Inactive particles have no neighbors and are never listed
            as neighbors; their positions may be anything. They make room for later particles: shapes, and so the compiled program,
            stay the same.
        capacity: Slots per row, a static int. Required if positions are traced. Default: `slack` times the longest row, rounded up
            to a multiple of 8.
        slack: Factor >= 1 on the counted capacity, room for later motion.
        reverse: Keep where each pair stands the other way round, 4 B per slot (and 8 B per source of half lists, lists of queries
            and those with the rules "gather" and "scatter"), so that derivatives of `vectors`, `distances` and `edges` need not
            find it in each call. They gather and never scatter in any case. `update` keeps it up to date.
        backend: "warp" (cells, compiled kernels, on CPU and NVIDIA GPUs), "hashgrid" (Warp's own `wp.HashGrid`, likewise), "jax"
            (cells, any device), "brute" (all n·m candidates), or "auto", the fastest measured on the platform: "warp" on the CPU
            and on NVIDIA GPUs (if Warp is missing "jax", with a warning), elsewhere "jax". The platform is that of the positions,
            or of `jax.default_device` if they are traced. "hashgrid" supports neither boxes nor batches, nor exclusions, nor
            cutoffs per particle or pair of species.

    Returns:
        A `NeighborList`; `idx` has shape [m, capacity], unused slots hold n. The order within rows is unspecified, but the same
        input gives the same bits.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or `capacity` is missing under jit.
        ImportError: "warp" or "hashgrid" without the package that they need.
        RuntimeError: "warp" or "hashgrid" on a platform on which Warp cannot run.
        Overflow of a given capacity and non-finite coordinates are known only from data: see `status`, `overflow` and `check`.

    Memory: 4 B per slot for the list (8 B with `reverse`), which keeps copies of what updates need: with a skin positions and
    queries, with a batch 4 B and with cutoffs per particle one float each (with a skin two), with species 4 B each, with
    exclusions 8 B per pair (of one image, 4·d B more) and 4 B per row (with queries, also 4 B per particle). On a GPU, from
    4097 particles on, a list by "warp" without queries and with one cutoff also keeps their order in space, 4 B per particle.
    It shares no memory with the given arrays, so they, or the list, may be donated (`jax.jit(..., donate_argnums=)`). While
    searching, however large space is, "warp" takes at most 64 B and "hashgrid" 84 B per particle, "jax" and "brute" 100 B per
    particle (float64: 125 B) and, for the block being processed, at most 64 MB on a CPU, elsewhere 1 GB or an eighth of the
    device's memory, whichever is less. With a box or a batch "warp" also copies the positions, at most 20 B per particle
    (float64: 40 B); with cutoffs per particle it takes 140 B in all (float64: 180 B). See `memory_plan`.
    Differentiable: the list is topology, without gradient; see `NeighborList.vectors`. Jit: yes, with capacity. vmap: yes, with
    capacity. Arrays that are sharded over a mesh are gathered on each device, and each does the whole work; `jfrnn.distributed`
    divides the work. `jax.export`: yes, with `disabled_checks=[jax.export.DisabledSafetyCheck.custom_call("jfrnn")]`; a process
    that runs such a program imports jfrnn of the same version first. Shapes must be numbers, not symbols.
    Source: cell lists (Hockney & Eastwood 1981, ch. 8); strict cutoff (Peifle 2019, §2.2).

    Compilation: once for each number of particles, of queries and of slots, and once more for the count if `capacity` is missing;
    cutoffs and boxes are data. Structures of different sizes share a program if they are padded to common sizes, with `active=` for
    the particles that exist, one `capacity`, and `Box(..., images=)`, which fixes the number of images:

    >>> import numpy as np, jfrnn
    >>> def search_padded(x, lengths, size=8):
    ...     padded = np.zeros((size, 3), np.float32)
    ...     padded[: len(x)] = x
    ...     box = jfrnn.Box(lengths, images=1)
    ...     return jfrnn.search(padded, 1.0, active=np.arange(size) < len(x), box=box, capacity=8)
    >>> search_padded([[0.1, 0.1, 0.1], [1.9, 0.1, 0.1]], [2.0, 2.0, 2.0]).count[:2]
    Array([1, 1], dtype=int32)
    >>> search_padded([[0.1, 0.1, 0.1], [2.9, 0.1, 0.1], [1.5, 0.1, 0.1]], [3.0, 2.0, 2.0]).count[:3]
    Array([1, 1, 0], dtype=int32)
    """
    problem, inputs = check_problem(
        positions, cutoff, queries, box, batch, radius_rule, species, exclude, half, include_self, closed, backend, skin, active
    )
    slack = check_slack(slack)
    if capacity is None:
        _refuse_traced(inputs, "capacity", "capacity=int(jfrnn.count(positions, cutoff + skin).max())")
        capacity = count_capacity(inputs, problem.options, slack)
    capacity, reverse = check_capacity(capacity), check_flag("reverse", reverse)
    rows = inputs.sources.shape[0] if inputs.queries is None else inputs.queries.shape[0]
    if reverse and rows * capacity > MOST_SLOTS:
        raise ValueError(f"reverse=True numbers slots by int32, got {rows} rows of {capacity} slots: search without.")
    with own_transfers():
        fields = call_apart(lambda inputs: find_fields(inputs, problem.options, capacity, problem.skin > 0, reverse), inputs)
    return NeighborList(**fields, problem=problem)


def search_edges(
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

    These are the pairs of `search`, in memory that follows their number: a particle with 5000 neighbors among others with 30 makes
    no row longer. Neighbors are counted, the counts added up, and each pair is written to its place, in one program.

    Args:
        positions: As in `search`.
        cutoff: As in `search`.
        total: Number of edges that there is room for, a static int up to 2³¹ - 1. Required if positions are traced. Default:
            `slack` times as many as there are pairs, rounded up by 6 % at most.
        queries: As in `search`; the receivers are then queries.
        box: As in `search`. Each image of a neighbor has an edge of its own.
        batch: As in `search`.
        radius_rule: As in `search`.
        species: As in `search`.
        exclude: As in `search`; `total` knows nothing of excluded pairs.
        half: As in `search`.
        include_self: As in `search`.
        closed: As in `search`.
        skin: As in `search`: the list holds pairs within cutoff + skin, of which `EdgeList.edges` masks those beyond the cutoff.
        active: As in `search`.
        slack: Factor >= 1 on the counted total, room for later motion.
        reverse: Keep the edges in the order of their senders, 4 B each and 8 B per particle, so that derivatives need not sort them
            in each call. `update` keeps it up to date.
        backend: As in `search`.

    Returns:
        An `EdgeList`.

    Raises:
        TypeError, ValueError, ImportError, RuntimeError: as in `search`; ValueError: there are more than 2³¹ - 1 pairs.
        Overflow of a given total and non-finite coordinates are known only from data: see `status`, `overflow` and `check`.

    Memory: 8 B per edge and 4 B per receiver, with a batch, a skin or cutoffs per particle what `search` keeps for them, and the
    scratch of a search. See `memory_plan`.
    Differentiable: the list is topology, without gradient; see `EdgeList.edges`. Jit: yes, with total. vmap: yes, with total.

    >>> import jax.numpy as jnp, jfrnn
    >>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
    >>> nbrs = jfrnn.search_edges(x, 1.0, total=4)
    >>> nbrs.receivers.tolist(), nbrs.senders.tolist()
    ([0, 1, 3, 3], [1, 0, 3, 3])
    >>> nbrs.edges(x).distance.tolist()
    [0.5, 0.5, 0.0, 0.0]
    """
    problem, inputs = check_problem(
        positions, cutoff, queries, box, batch, radius_rule, species, exclude, half, include_self, closed, backend, skin, active
    )
    problem = dataclasses.replace(problem, options=problem.options._replace(ordered=False))
    slack, reverse = check_slack(slack), check_flag("reverse", reverse)
    if total is None:
        _refuse_traced(inputs, "total", "total=int(jfrnn.count(positions, cutoff + skin).sum())")
        total = count_total(inputs, problem.options, slack)
    total = check_total(total)
    with own_transfers():
        fields = call_apart(lambda inputs: find_flat_fields(inputs, problem.options, total, problem.skin > 0, reverse), inputs)
    return EdgeList(**fields, problem=problem)


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
    """
    problem, inputs = check_problem(
        positions, cutoff, queries, box, batch, radius_rule, species, exclude, half, include_self, closed, backend, 0.0, active
    )
    with own_transfers():
        counts, _, status = call_apart(lambda inputs: count_rows(inputs, problem.options), inputs)
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
