"""The exports of a neighbor list: methods of `NeighborList` that return its pairs in other forms."""

from typing import overload

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry import NeighborOverflowError, Status, known_status
from jfrnn._search.exports import DenseNeighbors, check_total, flat_pairs, pair_total
from jfrnn._search.geometry import ImageCodes
from jfrnn._search.kept_options import KeptOptions
from jfrnn._tracing import at_once, own_transfers


class ListExports(KeptOptions):
    """The rows of a neighbor list as pairs, compressed rows, graphs and lists of other libraries."""

    idx: Array
    count: Array
    status: Array
    required: Array
    images: ImageCodes | None

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.idx.shape[-1]

    @overload
    def pairs(self, total: None = None) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def pairs(self, total: int) -> tuple[Array, Array]: ...

    def pairs(self, total: int | None = None) -> tuple[Array | np.ndarray, Array | np.ndarray]:
        """Export the pairs (i, j), row by row: to the host, or inside jit into arrays of a static length.

        Args:
            total: Length of the arrays, a static int up to 2³¹ - 1; None: the number of pairs, which is known only outside jit. If
                there are more pairs than `total`, this raises outside jit. Inside jit the last pairs are missing then;
                `require(total)` sets a bit that `check` reports.

        Returns:
            Query indices i and source indices j, shape [pairs] or [total], int32 each; the padding holds m and n.

        Raises:
            NeighborOverflowError, ValueError: as `check`, outside jit; ValueError: more pairs than `total`, outside jit.
            ValueError, TypeError: total is invalid, or missing inside jit.

        Differentiable: no (integers). Jit: yes, with total. vmap: yes, with total.
        """
        if total is None:
            count, idx = self._check_rows("pairs")
            return np.repeat(np.arange(count.size, dtype=np.int32), count), idx
        rows, indices, _ = self._flat(total)
        return rows, indices

    @overload
    def csr(self, total: None = None) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def csr(self, total: int) -> tuple[Array, Array]: ...

    def csr(self, total: int | None = None) -> tuple[Array | np.ndarray, Array | np.ndarray]:
        """Export compressed rows: the neighbors of row i are indices[offsets[i]:offsets[i + 1]].

        Args:
            total: As in `pairs`; offsets[-1] is then the number of pairs in the rows, at most 2³¹ - 1, which inside jit may exceed
                `total`.

        Returns:
            Offsets, shape [m + 1], int64 on the host, int32 with `total`; and indices, shape [pairs] or [total], int32, padded with
            n.

        Raises:
            NeighborOverflowError, ValueError, TypeError: as in `pairs`.

        Differentiable: no (integers). Jit: yes, with total. vmap: yes, with total.
        """
        if total is None:
            count, idx = self._check_rows("csr")
            return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]), idx
        _, indices, offsets = self._flat(total)
        return offsets, indices

    def to_jraph(self, total: int) -> tuple[Array, Array]:
        """Return senders and receivers of a graph: an edge from each neighbor j to its particle i.

        In a periodic box the edge is to the minimum image of j. A list with several images per pair is refused, since edges cannot
        tell them apart; for such a list, `shifts` returns the image of each slot of `idx`.

        Args:
            total: Number of edges, a static int: as in `pairs`.

        Returns:
            Senders j and receivers i, shape [total], int32 each; padding edges lead from n to m, the node that
            `jraph.pad_with_graphs` adds first. Stacked, they are an edge index as other graph libraries use it.

        Raises:
            ValueError: the list has several images per pair.
            ValueError, TypeError: as in `pairs`.

        Differentiable: no (integers). Jit: yes. vmap: yes.
        """
        if self.images is not None:
            raise ValueError(
                "to_jraph() returns edges without lattice shifts, which a list with several images of a pair needs: take "
                "i, k = jnp.nonzero(nbrs.idx < nbrs.source_count, size=total, fill_value=len(nbrs.idx)), senders "
                "nbrs.idx.at[i, k].get(mode='fill', fill_value=nbrs.source_count), receivers i and shifts "
                "nbrs.shifts(positions).at[i, k].get(mode='fill', fill_value=0); or search in a box that is at least 2.05 "
                "(cutoff + skin) wide."
            )
        rows, indices, _ = self._flat(total)
        return indices, rows

    def to_jax_md(self) -> DenseNeighbors:
        """Return this list in the form that jax-md's energies take: `idx` as in its format `Dense`.

        Such an energy computes displacements itself, so it needs a full list of the particles among themselves with minimum images
        only; the box goes into its displacement function. It sees all pairs within cutoff + skin. Inside jit, the result's
        `did_buffer_overflow` says whether neighbors are missing.

        Raises:
            ValueError: the list is half, has queries, or has several images per pair.
            NeighborOverflowError, ValueError: as `check`, outside jit.
        """
        wrong = {"half=True": self.half, "queries": self.own_queries, "several images of a pair": self.images is not None}
        for what in (name for name, is_so in wrong.items() if is_so):
            raise ValueError(f"jax-md's Dense format cannot say what a list with {what} does: search without.")
        self._check_known()
        return DenseNeighbors(self.idx, self.status)

    def _flat(self, total: int) -> tuple[Array, Array, Array]:
        """Return rows and sources of the pairs, padded to a static length, and the row offsets."""
        self._check_known()
        return flat_pairs(self.idx, self.count, self.source_count, self._check_total(total))

    def _check_total(self, total: int) -> int:
        """Return a static number of pairs that holds all of them, as far as that is known."""
        total = check_total(total)
        self._check_single()
        if not isinstance(self.count, Tracer):
            with at_once():
                held = int(jax.device_get(pair_total(self.count, self.capacity)))
            if held > total:
                raise ValueError(f"total={total} is too small: the list holds {held} pairs. Pass total={held} or more.")
        return total

    def _check_rows(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        if isinstance(self.status, Tracer):
            raise TypeError(
                f"{name}() returns as many pairs as there are and cannot run inside jax.jit: write {name}(total), total being the "
                "static length of its arrays."
            )
        self._check_known()
        self._check_single()
        with own_transfers():
            idx, count = np.asarray(self.idx), np.asarray(self.count)
        return count, idx[np.arange(self.capacity) < count[:, None]]

    def _check_single(self) -> None:
        if self.idx.ndim != 2:
            raise ValueError(f"exports take one list at a time, got idx of shape {list(self.idx.shape)}: index the batch first.")

    def _check_known(self, spared: Status = Status.OK) -> None:
        """Raise what status bits report, except the spared ones; a traced list is not checked."""
        status = (known_status(self.status) or Status.OK) & ~spared
        if Status.ROW_OVERFLOW in status:
            raise NeighborOverflowError(int(np.max(jax.device_get(self.required))), self.capacity)
        if Status.TOTAL_OVERFLOW in status:
            now = int(np.sum(jax.device_get(self.count), dtype=np.int64))
            raise ValueError(f"{status.message} At present it holds {now}.")
        if status:
            raise ValueError(status.message)
