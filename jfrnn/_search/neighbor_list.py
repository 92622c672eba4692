"""The result of a search: a padded neighbor list, its checks, its geometry and its exports."""

import dataclasses
import functools
from typing import TypedDict, Unpack, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._engine import BoxNumbers, Inputs, KeptRows, can_renew, find_box_numbers, renew_list
from jfrnn._geometry import Box, Status, make_cutoff, pairs_and_status, shape_of
from jfrnn._search.edges import Edges, Graph, flat_edges, flat_pairs_of, make_graph, no_edges
from jfrnn._search.exports import DenseNeighbors, check_held, check_total, flat_pairs, pair_total
from jfrnn._search.geometry import lattice_shifts, norms, vectors_of
from jfrnn._search.kept_search import KeptSearch
from jfrnn._search.present import MOST_SLOTS, Present, Topology, make_topology
from jfrnn._search.problem import count_capacity, round_capacity
from jfrnn._tracing import Points, Size, at_once, call_apart, own_transfers, portable

_FEW_SLOTS = 1 << 18  # up to which a program takes longer to compile than its displacements to compute


class Now(TypedDict, total=False):
    """Where particles are now; without positions, exports hold all pairs of a list."""

    positions: Array
    queries: Array | None
    box: Box | None


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList(KeptSearch):
    """The neighbors of m queries among n sources, one row of `capacity` slots per query. A pytree.

    Attributes:
        idx: Source indices, shape [m, capacity], int32; the first min(count, capacity) slots of a row are used, the others hold n.
        count: True number of neighbors per row, shape [m], int32; it may exceed the capacity. With a skin, `count`, `idx`, `pairs`
            and `csr` include neighbors within cutoff + skin when the list was last rebuilt.
        status: Bits of `Status`, shape [], int32.
        required: The capacity that holds every row, shape [], int32; like the status, over all updates.
        verlet: With a skin, where the list was last rebuilt and how often (`Verlet`); None without.
        box: The periodic box, rounded to the dtype of the positions; None in open space.
        images: The periodic image of each slot (`ImageCodes`), 1 B per slot; None if the minimum image suffices.
        radii: Cutoffs per particle (`Radii`: sources [n], queries [m], the rule; of the rule "sum", twice the radii and their
            mean), or None with one cutoff.
        batch: System numbers (`Batch`: sources [n], queries [m] or None), or None; updates keep them.
        exclude: Pairs that are excluded, as rows (`Exclusions`), or None; updates keep them.
        reverse: Where pairs stand the other way round (`Reverse`), if the list was made with `reverse=True`; updates find it anew
            whenever they rebuild the list.
        known: With a skin, what was found of the box, which programs that use the list need not find (`KnownBox`); None without,
            in open space, and where each system has a box.
        box_numbers: With a skin, in a box, on CUDA: what kernels read of the box (`BoxNumbers`); None elsewhere.
        order: The particles as they followed each other in space when the list was last rebuilt, shape [n], int32, by which sums
            over a list on a GPU go; -1 where their numbers did so. None elsewhere, and for up to 4096 particles, queries, and
            cutoffs per particle.
        problem: The options of the search (`Problem`). Static.
    """

    idx: Array
    count: Array
    order: Array | None
    _round_room, _count_room = staticmethod(round_capacity), staticmethod(count_capacity)

    def __repr__(self) -> str:
        """Summarize the list in a line; waits for the device."""
        *batch, m, capacity = shape_of(self.idx)
        return self._describe(batch, m, f"capacity {capacity}", pairs_and_status(self.count, self.status))

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.idx.shape[-1]

    def require(self, total: int) -> "NeighborList":
        """Return this list with the bit `Status.TOTAL_OVERFLOW` set if it holds more than `total` pairs.

        Inside `jax.jit`, `pairs(total)` and `csr(total)` cannot raise. Updates keep this bit, so `check` can
        report it afterwards.

        Args:
            total: Number of pairs, a static int.

        Returns:
            The same list, except for its status.

        Raises:
            ValueError, TypeError: total is invalid.

        Cost: a sum over the rows. Jit: yes. vmap: yes.
        """
        self._check_single()
        with own_transfers():
            missing = pair_total(self.count, self.capacity) > check_total(total)
            status = self.status | jnp.where(missing, jnp.int32(Status.TOTAL_OVERFLOW.value), 0)
        return dataclasses.replace(self, status=status)

    def vectors(self, positions: Points, box: Box | None = None, *, queries: Points | None = None) -> tuple[Array, Array]:
        """Compute the displacements x_j - x_i to all neighbors, in a periodic box plus the lattice translation of the image.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            box: The present box; default: that of the list, as a constant in derivatives.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.

        Returns:
            Displacements [length], shape [m, capacity, d], 0 in masked slots; and the mask, shape [m, capacity], bool: the slot is
            used and its pair is closer than the cutoff at these positions, exactly. Inside jit, displacements are NaN in all slots
            if pairs may be missing.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.
            NeighborOverflowError, ValueError: outside jit, pairs may be missing: rows overflowed, or data were invalid.
                Particles that are not finite have no pairs, which is no error here.

        Differentiable: to any order in positions, queries and box; the mask is a constant. Jit: yes. vmap: yes.
        """
        vectors, mask, _ = self._geometry_of(*self._geometry_inputs(positions, queries, box), as_given=True)
        with own_transfers():
            return self._mark(vectors), mask

    def shifts(self, positions: Points, box: Box | None = None, *, queries: Points | None = None) -> Array:
        """Compute the lattice shift S of every neighbor: its displacement is x_j - x_i + S·(lattice vectors).

        Every used slot has a shift, even if its pair lies in the skin, beyond the cutoff: `nbrs.shifts(x)[nbrs.idx <
        nbrs.source_count]` has one row per pair, in the order of `pairs()`. Of pairs closer than the cutoff,
        `nbrs.shifts(x)[nbrs.distances(x)[1]]` has one row each, in the order of `pairs(positions=x)`.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            box: As in `vectors`.
            queries: As in `vectors`.

        Returns:
            Whole numbers, shape [m, capacity, d], int32; 0 in unused slots, along axes that are not periodic, and between positions
            that are now more than 1022 lattice vectors apart. Inside jit, the smallest int32 if pairs may be missing.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: no (integers). Jit: yes. vmap: yes.
        """
        sources, rows, box = self._geometry_inputs(positions, queries, box)
        self._check_known(spared=self._harmless)
        with own_transfers():
            if box is None or self.box_kind is None or 0 in (sources.shape[0], *self.idx.shape):
                return self._mark(jnp.zeros((*self.idx.shape, sources.shape[1]), jnp.int32))
            present = self._at(sources, rows, box)
            # few slots take the program of `vectors`, called in the same way, so that they share one
            found = vectors_of(present, True)[2] if self.idx.size <= _FEW_SLOTS else lattice_shifts(present)
            assert found is not None
            return self._mark(found)

    def distances(self, positions: Points, box: Box | None = None, *, queries: Points | None = None) -> tuple[Array, Array]:
        """Compute the distance to every neighbor.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            box: As in `vectors`.
            queries: As in `vectors`.

        Returns:
            Distances [length], shape [m, capacity], 0 in masked slots; and the mask as `vectors` gives it.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: to any order; the gradient of a distance of 0 is 0. Jit: yes. vmap: yes.
        """
        topology = self._topology()
        kind, measured = self.problem.options.images, topology.native and topology.mutual and self.idx.size <= MOST_SLOTS
        if 0 in self.idx.shape or not measured or (kind is not None and kind.per_system):
            vectors, mask = self.vectors(positions, queries=queries, box=box)
            return norms(vectors), mask
        sources, _, box = self._geometry_inputs(positions, queries, box)
        self._check_known(spared=self._harmless)
        from jfrnn._search.lengths import lengths

        with own_transfers():
            made, mask = lengths(self._present(topology, self.count, sources, sources, box))
            return self._mark(made), mask

    def edges(
        self, positions: Points, total: Size | None = None, box: Box | None = None, *, queries: Points | None = None
    ) -> Edges:
        """Return the pairs as edges of a graph, with their geometry, for graph networks inside jit.

        Edges lead from neighbors j to particles i and are sorted by i, so `jax.ops.segment_sum(messages, edges.receivers, m,
        indices_are_sorted=True)` sorts nothing; `messages` of edges outside the mask should be 0. Pairs of the skin, beyond the
        cutoff at these positions, have no edges. In a periodic box each image of a neighbor has an edge of its own.

        Args:
            positions: As in `vectors`.
            total: Number of edges, a static int up to 2³¹ - 1; outside jit as many as the list holds pairs by default. If there are
                more pairs, this raises outside jit. Inside jit, all displacements are NaN then, and `status` and `pair_count` say
                so; `require(total)` makes the list keep such a bit, of all pairs that it holds, those of the skin included.
            box: As in `vectors`.
            queries: As in `vectors`.

        Returns:
            An `Edges`: senders [total], receivers [total], displacement [total, d], shift [total, d], mask [total], status [],
            distance [total], pair_count [].

        Raises:
            ValueError, TypeError: as in `vectors` and `pairs`; or the list has more than 2³¹ - 1 slots.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: displacements and distances, to any order in positions, queries and box; derivatives gather, as those of
        `vectors`. Jit: yes. vmap: yes.
        """
        self._check_slots("edges")
        if total is None:
            if isinstance(self.count, Tracer):
                raise TypeError(
                    "edges() makes arrays of a static length inside jax.jit: write edges(positions, total), total being it."
                )
            self._check_known()
            total = self._pairs_held()
        total = check_total(total)
        self._check_single()
        sources, rows, box = self._geometry_inputs(positions, queries, box)
        mask = self._geometry_of(*lax.stop_gradient((sources, rows, box)))[1]
        with own_transfers():
            if 0 in (sources.shape[0], *self.idx.shape, total):
                made = no_edges(mask, self.source_count, sources, self.status, total)
            else:
                made = flat_edges(self._at(sources, rows, box), self.status, mask, total)
        check_held(made.pair_count, total)
        return made

    def to_jraph(self, positions: Points, total: Size | None = None, box: Box | None = None) -> Graph:
        """Return the edges as a graph of jraph, with displacements, distances and lattice shifts; jraph need not be installed.

        Args:
            positions: Particles [length], shape [n, d], where they are now.
            total: Number of edges, a static int, as in `edges`; by default as there.
            box: As in `vectors`.

        Returns:
            A `Graph`, a pytree with the fields of `jraph.GraphsTuple`, padded by a second graph of one node and the unused edges:
            nodes {"positions": [n + 1, d]}, edges {"displacement": [total, d], "distance": [total], "shift": [total, d]}, receivers
            and senders [total] int32, n_node [2], n_edge [2]. Positions of nodes are lengths, of fractional coordinates too.

        Raises:
            ValueError: the list has queries, which are no nodes.
            NeighborOverflowError, ValueError, TypeError: as `edges`.

        Differentiable: as `edges`, also the positions of nodes. Jit: yes. vmap: yes.
        """
        if self.own_queries:
            raise ValueError("to_jraph() makes particles the nodes of a graph, and this list has queries: take `edges`.")
        return make_graph(self.edges(positions, total, box=box), self._geometry_inputs(positions, None, box)[0])

    @overload
    def pairs(self, total: None = None, **at: Unpack[Now]) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def pairs(self, total: int, **at: Unpack[Now]) -> tuple[Array, Array]: ...

    def pairs(self, total: int | None = None, **at: Unpack[Now]) -> tuple[Array | np.ndarray, Array | np.ndarray]:
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
    def csr(self, total: None = None, **at: Unpack[Now]) -> tuple[np.ndarray, np.ndarray]: ...

    @overload
    def csr(self, total: int, **at: Unpack[Now]) -> tuple[Array, Array]: ...

    def csr(self, total: int | None = None, **at: Unpack[Now]) -> tuple[Array | np.ndarray, Array | np.ndarray]:
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

    @property
    def _row_count(self) -> int:
        return self.idx.shape[0]

    def _may_renew(self, inputs: Inputs) -> bool:
        plain = self.reverse is None and self.images is None
        return plain and can_renew(inputs, self.problem.options, self.skin, self.capacity)

    def _find_box_numbers(self, inputs: Inputs) -> BoxNumbers | None:
        there = self.box_numbers is not None  # then they stay, wherever the list has gone since
        if self.verlet is None or inputs.box is None or self.cutoff is None or not (there or self._may_renew(inputs)):
            return None
        radius = make_cutoff(self.cutoff, self.dtype, self.closed).radius
        return call_apart(functools.partial(find_box_numbers, options=self.problem.options), inputs, radius)

    def _renew(self, inputs: Inputs) -> "NeighborList":
        verlet, limit = self.verlet, self._motion_limit()
        assert verlet is not None
        of_time = verlet.rebuild_count, verlet.positions, verlet.box
        kept = lax.stop_gradient(KeptRows(self.idx, self.count, self.status, self.required, *of_time, self.order))
        new = renew_list(inputs, self.problem.options, kept, limit, self.box_numbers)
        verlet = dataclasses.replace(verlet, positions=new.reference, box=new.box, rebuild_count=new.rebuild_count)
        found = {"idx": new.idx, "count": new.counts, "status": new.status, "required": new.required, "order": new.order}
        return dataclasses.replace(self, **found, verlet=verlet)

    def _geometry_of(
        self, sources: Array, rows: Array, box: Box | None, as_given: bool = False
    ) -> tuple[Array, Array, Array | None]:
        """Return displacements, mask and shifts of sources and rows that are lengths, in the present box.

        Shifts are those of `vectors_of`: between near points, or as they are given.
        """
        self._check_known(spared=self._harmless)
        with own_transfers():
            if 0 in (sources.shape[0], *self.idx.shape):
                return jnp.zeros((*self.idx.shape, sources.shape[1]), sources.dtype), jnp.zeros(self.idx.shape, bool), None
            return vectors_of(self._at(sources, rows, box), as_given and box is not None)

    def _at(self, sources: Array, rows: Array, box: Box | None) -> Present:
        return self._present(self._topology(), self.count, sources, rows, box)

    def _topology(self) -> Topology:
        problem, codes = self.problem, None if self.images is None else self.images.codes
        kind = problem.options, problem.source_count, problem.own_queries, self.radii
        return make_topology(*kind, self.idx, codes, self.reverse, self.order)

    def _flat(self, name: str, total: int, at: Now) -> tuple[Array, Array, Array]:
        """Return rows and sources of the pairs, padded to a static length, and the row offsets."""
        total, near = check_total(total), self._near_now(name, at)
        self._check_single()
        if near is None:
            if not isinstance(self.count, Tracer):
                with at_once():
                    check_held(pair_total(self.count, self.capacity), total)
            return flat_pairs(self.idx, self.count, self.source_count, total)
        self._check_slots(name)
        with own_transfers():
            *made, held = flat_pairs_of(self.idx, near, self.source_count, total, self.problem.options.engine.native)
        check_held(held, total)
        return made[0], made[1], made[2]

    def _check_slots(self, name: str) -> None:
        if self.idx.size > MOST_SLOTS:
            raise ValueError(
                f"{name}() numbers slots by int32, and this list has {self.idx.size}: take `vectors`, or fewer queries."
            )

    def _near_now(self, name: str, at: Now) -> Array | None:
        """Return which slots hold a pair now; without positions None, of a list that lacks no pairs as far as is known."""
        for unknown in set(at) - set(Now.__annotations__):
            raise TypeError(f"NeighborList.{name}() got an unexpected keyword argument {unknown!r}")
        if "positions" in at:
            return self.vectors(at["positions"], at.get("box"), queries=at.get("queries"))[1]
        if at:
            raise TypeError(
                f"{', '.join(at)} tell where pairs are now, with positions: pass positions=, or leave {next(iter(at))} out."
            )
        self._check_known()
        return None

    def _check_rows(self, name: str, at: Now) -> tuple[np.ndarray, np.ndarray]:
        if any(isinstance(x, Tracer) for x in (self.status, *at.values())):
            raise TypeError(
                f"{name}() returns as many pairs as there are and cannot run inside jax.jit: write {name}(total), total being the "
                "static length of its arrays."
            )
        near = self._near_now(name, at)
        self._check_single()
        with own_transfers():
            idx, count = np.asarray(self.idx), np.asarray(self.count)
            used = np.arange(self.capacity) < count[:, None] if near is None else np.asarray(near)
        return used.sum(1), idx[used]

    def _pairs_held(self) -> int:
        return int(np.sum(jax.device_get(self.count), dtype=np.int64))
