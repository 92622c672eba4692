"""The result of a search: a padded neighbor list, its checks, its geometry and its exports."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._exact import Cutoff, is_pair_of, make_cutoff
from jfrnn._inputs import checked_positions
from jfrnn._status import NeighborOverflowError, Status


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList:
    """Hold the neighbors of m queries among n sources, one row of `capacity` slots per query. A pytree.

    Attributes:
        idx: Source indices, shape [m, capacity], int32; the first min(count, capacity) slots of a row are used, the others hold n.
        count: True number of neighbors per row, shape [m], int32; it may exceed the capacity.
        status: Bits of `Status`, shape [], int32.
        required: The capacity that holds every row, shape [], int32.
        cutoff: Interaction radius [length], rounded to the dtype of the positions. Static.
        half: Each unordered pair stands once, in the row of its smaller index. Static.
        include_self: Each particle is its own neighbor. Static.
        closed: Pairs at exactly the cutoff count. Static.
        own_queries: The rows belong to `queries`, not to the positions themselves. Static.
        source_count: n, the fill value of unused slots. Static.
        backend: The engine that made the list. Static.
    """

    idx: Array
    count: Array
    status: Array
    required: Array
    cutoff: float = dataclasses.field(metadata={"static": True})
    half: bool = dataclasses.field(metadata={"static": True})
    include_self: bool = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    own_queries: bool = dataclasses.field(metadata={"static": True})
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
