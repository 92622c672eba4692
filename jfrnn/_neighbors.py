"""The result of a search: a padded neighbor list, its checks, its geometry and its exports."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._backends import Options, count_rows, list_rows, without_inactive
from jfrnn._exact import Cutoff, is_pair_of, make_cutoff
from jfrnn._inputs import checked_active, checked_positions, checked_slack
from jfrnn._runs import Filter
from jfrnn._status import NeighborOverflowError, Status
from jfrnn._verlet import Verlet, first_verlet, list_radius, moved_too_far

_CAPACITY_STEP = 8  # eager capacities are rounded up to a multiple, so that similar scenes share one compiled program


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList:
    """Hold the neighbors of m queries among n sources, one row of `capacity` slots per query. A pytree.

    Attributes:
        idx: Source indices, shape [m, capacity], int32; the first min(count, capacity) slots of a row are used, the others hold n.
        count: True number of neighbors per row, shape [m], int32; it may exceed the capacity. With a skin, of those within
            cutoff + skin when the list was last made, and so are `idx`, `pairs` and `csr`.
        status: Bits of `Status`, shape [], int32.
        required: The capacity that holds every row, shape [], int32; like the status, over all updates.
        verlet: With a skin, where the list was made and how often anew (`Verlet`); None without.
        cutoff: Interaction radius [length], rounded to the dtype of the positions. Static.
        skin: Extra shell [length]. Static.
        half: Each unordered pair stands once, in the row of its smaller index. Static.
        include_self: Each particle is its own neighbor. Static.
        closed: Pairs at exactly the cutoff count. Static.
        own_queries: The rows belong to `queries`, not to the positions themselves. Static.
        masked: Particles may be inactive. Static.
        source_count: n, the fill value of unused slots. Static.
        backend: The engine that made the list. Static.
    """

    idx: Array
    count: Array
    status: Array
    required: Array
    verlet: Verlet | None
    cutoff: float = dataclasses.field(metadata={"static": True})
    skin: float = dataclasses.field(metadata={"static": True})
    half: bool = dataclasses.field(metadata={"static": True})
    include_self: bool = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    own_queries: bool = dataclasses.field(metadata={"static": True})
    masked: bool = dataclasses.field(metadata={"static": True})
    source_count: int = dataclasses.field(metadata={"static": True})
    backend: str = dataclasses.field(metadata={"static": True})

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.idx.shape[-1]

    @property
    def overflow(self) -> Array:
        """Say whether a row lost neighbors, shape [], bool."""
        return (self.status & Status.ROW_OVERFLOW.value) != 0

    def update(self, positions: Array, *, queries: Array | None = None, active: Array | None = None) -> "NeighborList":
        """Make the list anew if something has moved skin/2 since it was made, or may have by rounding; without a skin, always.

        The list that comes back holds every pair within the cutoff at these positions, in the same shapes: a step of a simulation
        inside `jax.jit`, `lax.scan` or `lax.fori_loop`. Status bits and `required` are kept over all updates; look at `overflow`
        after a chunk of steps, then `grow` and run the chunk again (`run_chunk` does that).

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.
            active: Which particles take part now, shape [n], bool, exactly if the list was made with `active`; one that comes or
                goes makes the list anew.

        Returns:
            A `NeighborList` of the same shapes and options.

        Raises:
            ValueError, TypeError: an argument does not fit the list.

        Cost: one pass over the positions, or a search. Differentiable: no gradient flows through. Jit: yes. vmap: yes, each list
        being made anew where any of the batch is.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        return _update(self, sources, rows if self.own_queries else None, self._checked_active(active, sources))

    def grow(
        self, positions: Array, *, queries: Array | None = None, active: Array | None = None, slack: float = 1.25
    ) -> "NeighborList":
        """Make a list with room for what overflowed, at these positions. Not inside jit: the capacity is a shape.

        Args:
            positions: Sources [length], shape [n, d].
            queries: As in `update`.
            active: As in `update`.
            slack: Factor >= 1 on the longest row that was ever met, here or by updates of this list.

        Returns:
            A `NeighborList` with the same options, a capacity not smaller than before, and no bits from the past.

        Raises:
            TypeError: positions or the list are traced.
            ValueError, TypeError: an argument does not fit the list.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        queries, active, slack = rows if self.own_queries else None, self._checked_active(active, sources), checked_slack(slack)
        if any(isinstance(x, Tracer) for x in (sources, queries, active, self.required)):
            raise TypeError("grow() changes the shape of the list and cannot run inside jax.jit: call it on what jit returns.")
        met = math.ceil(slack * int(np.max(self.required)))
        most = max(self.capacity, -(-met // _CAPACITY_STEP) * _CAPACITY_STEP)
        list_cutoff, options = _cutoff_and_options(self, np.dtype(sources.dtype))
        capacity = max(most, counted_capacity(sources, queries, active, list_cutoff, options, slack))
        return _remade(self, sources, queries, active, capacity)

    @property
    def rebuild_count(self) -> Array:
        """How often updates made the list anew, shape [], int32; known for a list with a skin."""
        if self.verlet is None:
            raise ValueError("this list was made without a skin: every update makes it anew, and nothing counts them.")
        return self.verlet.rebuild_count

    def check(self) -> None:
        """Raise what the status bits report; wait for the device. Not inside jit: there, read `status` and `overflow`.

        Raises:
            NeighborOverflowError: a row holds more neighbors than `capacity`; `.required` is the capacity needed.
            ValueError: positions or queries hold NaN or infinity.
            TypeError: called on a list that is being traced.
        """
        if isinstance(self.status, Tracer):
            raise TypeError("check() reads values and cannot run inside jax.jit: call it on the list that jit returns.")
        status = Status(int(np.bitwise_or.reduce(np.asarray(self.status), axis=None)))
        if Status.ROW_OVERFLOW in status:
            raise NeighborOverflowError(int(np.max(self.required)), self.capacity)
        if Status.NONFINITE in status:
            raise ValueError(Status.NONFINITE.message)

    def vectors(self, positions: Array, *, queries: Array | None = None) -> tuple[Array, Array]:
        """Compute the displacement to every neighbor, r_ij = x_j - x_i.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.

        Returns:
            Displacements [length], shape [m, capacity, d], 0 in masked slots; and the mask, shape [m, capacity], bool: the slot is
            used and its pair is, at these positions and exactly, closer than the cutoff.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.

        Differentiable: to any order in positions and queries; the mask is a constant. Jit: yes. vmap: yes.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        if 0 in (sources.shape[0], *self.idx.shape):
            return jnp.zeros((*self.idx.shape, sources.shape[1]), sources.dtype), jnp.zeros(self.idx.shape, bool)
        cutoff = make_cutoff(self.cutoff, np.dtype(sources.dtype), self.closed)
        return _vectors(self.idx, self.count, sources, rows, cutoff)

    def distances(self, positions: Array, *, queries: Array | None = None) -> tuple[Array, Array]:
        """Compute the distance to every neighbor.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.

        Returns:
            Distances [length], shape [m, capacity], 0 in masked slots; and the mask as `vectors` gives it.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.

        Differentiable: to any order; the gradient of a distance of 0 is 0. Jit: yes. vmap: yes.
        """
        vectors, mask = self.vectors(positions, queries=queries)
        return _norms(vectors), mask

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Export the pairs (i, j), row by row, to the host.

        Returns:
            Query indices i and source indices j, shape [pairs], int32 each.

        Raises:
            NeighborOverflowError, ValueError, TypeError: as `check`.
        """
        count, idx = self._checked_rows()
        return np.repeat(np.arange(count.size, dtype=np.int32), count), idx

    def csr(self) -> tuple[np.ndarray, np.ndarray]:
        """Export compressed rows to the host: the neighbors of row i are indices[offsets[i]:offsets[i + 1]].

        Returns:
            Offsets, shape [m + 1], int64, and indices, shape [pairs], int32.

        Raises:
            NeighborOverflowError, ValueError, TypeError: as `check`.
        """
        count, idx = self._checked_rows()
        return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]), idx

    def _checked_rows(self) -> tuple[np.ndarray, np.ndarray]:
        self.check()
        if self.idx.ndim != 2:
            raise ValueError(f"exports take one list at a time, got idx of shape {list(self.idx.shape)}: index the batch first.")
        idx, count = np.asarray(self.idx), np.asarray(self.count)
        return count, idx[np.arange(self.capacity) < count[:, None]]

    def _checked_active(self, active: Array | None, sources: Array) -> Array | None:
        if self.masked != (active is not None):
            state = "with active: pass active=" if self.masked else "without active: leave active out"
            raise ValueError(f"this list was made {state}.")
        return None if active is None else checked_active(active, sources)

    def _geometry_inputs(self, positions: Array, queries: Array | None) -> tuple[Array, Array]:
        sources = checked_positions("positions", positions)
        if sources.shape[0] != self.source_count:
            raise ValueError(f"positions hold {sources.shape[0]} particles, but the list was made for {self.source_count}.")
        if self.own_queries != (queries is not None):
            state = "with queries: pass queries=" if self.own_queries else "without queries: leave queries out"
            raise ValueError(f"this list was made {state}.")
        rows = sources if queries is None else checked_positions("queries", queries, like=sources)
        if rows.shape[0] != self.idx.shape[0]:
            raise ValueError(f"queries hold {rows.shape[0]} points, but the list has {self.idx.shape[0]} rows.")
        return sources, rows


def counted_capacity(
    sources: Array, queries: Array | None, active: Array | None, cutoff: Cutoff, options: Options, slack: float
) -> int:
    """Count the neighbors of concrete positions and return a capacity that holds `slack` times the longest row."""
    with jax.ensure_compile_time_eval():
        longest = int(np.max(count_rows(sources, queries, active, cutoff, options), initial=0))
    wanted = math.ceil(max(longest, 1) * slack)
    rounded = -(-wanted // _CAPACITY_STEP) * _CAPACITY_STEP
    return min(rounded, max(wanted, sources.shape[0]))


def _cutoff_and_options(nbrs: NeighborList, dtype: np.dtype) -> tuple[Cutoff, Options]:
    """Return the cutoff of the list, with the skin, and the static options with which it was made."""
    radius = list_radius(nbrs.cutoff, nbrs.skin, dtype)
    keep = Filter(drop_self=not (nbrs.own_queries or nbrs.include_self), later_only=nbrs.half)
    return make_cutoff(radius, dtype, nbrs.closed), Options(keep, nbrs.backend, radius if nbrs.backend == "hashgrid" else None)


@jax.jit
def _update(nbrs: NeighborList, sources: Array, queries: Array | None, active: Array | None) -> NeighborList:
    def remake(nbrs: NeighborList) -> NeighborList:
        made, verlet = _remade(nbrs, sources, queries, active, nbrs.capacity), nbrs.verlet
        if made.verlet is not None and verlet is not None:
            made = dataclasses.replace(made, verlet=dataclasses.replace(made.verlet, rebuild_count=verlet.rebuild_count + 1))
        return dataclasses.replace(made, status=made.status | nbrs.status, required=jnp.maximum(made.required, nbrs.required))

    if nbrs.verlet is None:
        return remake(nbrs)
    now = lax.stop_gradient(without_inactive(sources, active))
    moved = moved_too_far(nbrs.verlet, now, None if queries is None else lax.stop_gradient(queries), nbrs.skin)
    # a loop of at most one round: XLA keeps what a loop carries in place, but copies what a branch returns
    return lax.while_loop(lambda state: state[0], lambda state: (jnp.zeros_like(state[0]), remake(state[1])), (moved, nbrs))[1]


def _remade(nbrs: NeighborList, sources: Array, queries: Array | None, active: Array | None, capacity: int) -> NeighborList:
    """Make a list with the options of this one, and nothing of its past."""
    cutoff, options = _cutoff_and_options(nbrs, np.dtype(sources.dtype))
    rows = list_rows(sources, queries, active, cutoff, options, capacity)
    verlet = first_verlet(without_inactive(sources, active), queries) if nbrs.skin else None
    return dataclasses.replace(nbrs, idx=rows.idx, count=rows.counts, status=rows.status, required=rows.required, verlet=verlet)


@jax.jit
def _vectors(idx: Array, count: Array, sources: Array, rows: Array, cutoff: Cutoff) -> tuple[Array, Array]:
    used = lax.broadcasted_iota(jnp.int32, idx.shape, 1) < count[:, None]
    neighbor = jnp.where(used, idx, 0)
    mask = used & is_pair_of(lax.stop_gradient(rows), lax.stop_gradient(sources), neighbor, cutoff)
    return jnp.where(mask[..., None], sources[neighbor] - rows[:, None, :], 0), mask


@jax.jit
def _norms(vectors: Array) -> Array:
    largest = lax.stop_gradient(jnp.max(jnp.abs(vectors), axis=-1, initial=0))
    apart = largest > 0
    unit = jnp.where(apart, largest, 1)  # squares of very small or large lengths would leave the float range
    square = jnp.sum((vectors / unit[..., None]) ** 2, axis=-1)
    return jnp.where(apart, unit * jnp.sqrt(jnp.where(apart, square, 1)), 0)
