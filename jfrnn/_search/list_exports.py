"""The exports of a neighbor list: methods of `NeighborList` that return its pairs in other forms."""

import dataclasses
from typing import TypedDict, Unpack, overload

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry import Box
from jfrnn._search.edges import flat_pairs_of
from jfrnn._search.exports import DenseNeighbors, check_held, check_total, flat_pairs, pair_total
from jfrnn._search.kept_search import KeptSearch
from jfrnn._tracing import at_once, own_transfers


class Present(TypedDict, total=False):
    """Where particles are now; without positions, exports hold all pairs of a list."""

    positions: Array
    queries: Array | None
    box: Box | None


@dataclasses.dataclass(frozen=True, repr=False)
class ListExports(KeptSearch):
    """The rows of a neighbor list as pairs, compressed rows, graphs and lists of other libraries."""

    idx: Array
    count: Array

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.idx.shape[-1]

    def _near(self, positions: Array, queries: Array | None, box: Box | None) -> Array:
        """Return which slots hold a pair that is closer than the cutoff at these positions, [m, capacity] bool."""
        raise NotImplementedError

    @overload
    def pairs(self, total: None = None, **at: Unpack[Present]) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def pairs(self, total: int, **at: Unpack[Present]) -> tuple[Array, Array]: ...

    def pairs(self, total: int | None = None, **at: Unpack[Present]) -> tuple[Array | np.ndarray, Array | np.ndarray]:
        """Export the pairs (i, j), row by row: to the host, or inside jit into arrays of a static length.

        Without positions these are all pairs of the list: with a skin, those within cutoff + skin when it was last rebuilt. With
        `positions` they are those within the cutoff there, exactly, in the order of `nbrs.shifts(x)[nbrs.distances(x)[1]]`.

        Args:
            total: Length of the arrays, a static int up to 2³¹ - 1; None: the number of pairs, which is known only outside jit. If
                there are more pairs than `total`, this raises outside jit. Inside jit the last pairs are missing then;
                `require(total)` sets a bit that `check` reports.
            **at: `positions` [length], shape [n, d], where the sources are now, with `queries` and `box` as in `vectors`.

        Returns:
            Query indices i and source indices j, shape [pairs] or [total], int32 each; the padding holds m and n.

        Raises:
            NeighborOverflowError, ValueError: as `check`, outside jit; ValueError: more pairs than `total`, outside jit.
            ValueError, TypeError: total is invalid, or missing inside jit; or positions do not fit the list.

        Differentiable: no (integers). Jit: yes, with total. vmap: yes, with total.
        """
        if total is None:
            count, idx = self._check_rows("pairs", at)
            return np.repeat(np.arange(count.size, dtype=np.int32), count), idx
        rows, indices, _ = self._flat("pairs", total, at)
        return rows, indices

    @overload
    def csr(self, total: None = None, **at: Unpack[Present]) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def csr(self, total: int, **at: Unpack[Present]) -> tuple[Array, Array]: ...

    def csr(self, total: int | None = None, **at: Unpack[Present]) -> tuple[Array | np.ndarray, Array | np.ndarray]:
        """Export compressed rows: the neighbors of row i are indices[offsets[i]:offsets[i + 1]].

        Args:
            total: As in `pairs`; offsets[-1] is then the number of pairs in the rows, at most 2³¹ - 1, which inside jit may exceed
                `total`.
            **at: As in `pairs`.

        Returns:
            Offsets, shape [m + 1], int64 on the host, int32 with `total`; and indices, shape [pairs] or [total], int32, padded with
            n.

        Raises:
            NeighborOverflowError, ValueError, TypeError: as in `pairs`.

        Differentiable: no (integers). Jit: yes, with total. vmap: yes, with total.
        """
        if total is None:
            count, idx = self._check_rows("csr", at)
            return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]), idx
        _, indices, offsets = self._flat("csr", total, at)
        return offsets, indices

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

    def _flat(self, name: str, total: int, at: Present) -> tuple[Array, Array, Array]:
        """Return rows and sources of the pairs, padded to a static length, and the row offsets."""
        total, near = check_total(total), self._near_now(name, at)
        self._check_single()
        if near is None:
            self._check_known()
            if not isinstance(self.count, Tracer):
                with at_once():
                    check_held(pair_total(self.count, self.capacity), total)
            return flat_pairs(self.idx, self.count, self.source_count, total)
        with own_transfers():
            *made, held = flat_pairs_of(self.idx, near, self.source_count, total, self.problem.options.engine.native)
        check_held(held, total)
        return made[0], made[1], made[2]

    def _count_pairs(self, name: str) -> int:
        """Return how many pairs the list holds, those of the skin included.

        Raises:
            TypeError: The list is traced.
        """
        if isinstance(self.count, Tracer):
            raise TypeError(
                f"{name}() makes arrays of a static length inside jax.jit: write {name}(positions, total), total being it."
            )
        self._check_known()
        return int(np.asarray(self.count).sum(dtype=np.int64))

    def _near_now(self, name: str, at: Present) -> Array | None:
        for unknown in set(at) - set(Present.__annotations__):
            raise TypeError(f"NeighborList.{name}() got an unexpected keyword argument {unknown!r}")
        if "positions" in at:
            return self._near(at["positions"], at.get("queries"), at.get("box"))
        if at:
            raise TypeError(
                f"{', '.join(at)} tell where pairs are now, with positions: pass positions=, or leave {next(iter(at))} out."
            )
        return None

    def _check_rows(self, name: str, at: Present) -> tuple[np.ndarray, np.ndarray]:
        if any(isinstance(x, Tracer) for x in (self.status, *at.values())):
            raise TypeError(
                f"{name}() returns as many pairs as there are and cannot run inside jax.jit: write {name}(total), total being the "
                "static length of its arrays."
            )
        near = self._near_now(name, at)
        if near is None:
            self._check_known()
        self._check_single()
        with own_transfers():
            idx, count = np.asarray(self.idx), np.asarray(self.count)
            used = np.arange(self.capacity) < count[:, None] if near is None else np.asarray(near)
        return used.sum(1), idx[used]

    def _check_single(self) -> None:
        if self.idx.ndim != 2:
            raise ValueError(f"exports take one list at a time, got idx of shape {list(self.idx.shape)}: index the batch first.")

    def _pairs_held(self) -> int:
        return int(np.sum(jax.device_get(self.count), dtype=np.int64))
