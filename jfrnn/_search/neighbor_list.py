"""The result of a search: a padded neighbor list, its checks and its geometry.

The methods of a public class stand here with whole docstrings; those that export it are in `list_exports`.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._engine import Inputs, hide_inactive, take_present
from jfrnn._geometry import (
    Batch,
    Box,
    Cutoff,
    Images,
    Radii,
    Status,
    check_active,
    check_again,
    check_box,
    check_devices,
    check_radii,
    check_slack,
    grow_images,
    make_cutoff,
    pairs_and_status,
    round_box,
    shape_of,
)
from jfrnn._search.edges import Edges, Graph, flat_edges, make_graph, no_edges
from jfrnn._search.exports import check_held, check_total, pair_total
from jfrnn._search.geometry import ImageCodes, ImagesMade, lattice_shifts, norms, open_vectors, periodic_vectors
from jfrnn._search.list_exports import ListExports
from jfrnn._search.making import count_capacity, find_fields, round_capacity
from jfrnn._search.problem import Problem
from jfrnn._search.reverse import MOST_SLOTS, Reverse
from jfrnn._search.topology import Topology, make_topology
from jfrnn._search.verlet import Verlet, has_moved_too_far
from jfrnn._tracing import Given, call_apart, compile_program, own_transfers

ROWS_ARE_WHOLE = Status.NONFINITE | Status.TOTAL_OVERFLOW  # bits that do not mean missing neighbors in rows


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList(ListExports):
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
        reverse: Where pairs stand the other way round (`Reverse`), if the list was made with `reverse=True`; updates find it anew
            whenever they rebuild the list.
        order: The particles as they followed each other in space when the list was last rebuilt, shape [n], int32, by which sums
            over a list on a GPU go; -1 where their numbers did so. None elsewhere, and for up to 4096 particles, queries, and
            cutoffs per particle.
        problem: The options of the search (`Problem`). Static.
    """

    idx: Array
    count: Array
    status: Array
    required: Array
    verlet: Verlet | None
    box: Box | None
    images: ImageCodes | None
    radii: Radii | None
    batch: Batch | None
    reverse: Reverse | None
    order: Array | None
    problem: Problem = dataclasses.field(metadata={"static": True})

    def __repr__(self) -> str:
        """Summarize the list in a line; waits for the device."""
        *batch, m, capacity = shape_of(self.idx)
        rows = f"{m} queries of {self.source_count} particles" if self.own_queries else f"{self.source_count} particles"
        rows = f"batch of {batch}, {rows}" if batch else rows
        reach = "per particle" if self.cutoff is None else f"{self.cutoff:.6g}"
        skin = f", skin {self.skin:.6g}" if self.skin else ""
        rest = pairs_and_status(self.count, self.status)
        return f"NeighborList({rows}, capacity {capacity}, cutoff {reach}{skin}, engine {self.backend!r}, {rest})"

    @property
    def overflow(self) -> Array:
        """Whether pairs may be missing because a row has too few slots or a box needs more images, [] bool; `grow` fixes both."""
        with own_transfers():
            return (self.status & (Status.ROW_OVERFLOW | Status.BOX_TOO_SMALL).value) != 0

    def update(
        self,
        positions: Array,
        *,
        cutoff: Array | tuple[Array, Array] | None = None,
        queries: Array | None = None,
        active: Array | None = None,
        box: Box | None = None,
    ) -> "NeighborList":
        """Rebuild the list if anything has moved skin/2 since the last time, or may have by rounding; without a skin, always.

        The returned list holds every pair within the cutoff at these positions, in the same shapes, so it can be a simulation step
        inside `jax.jit`, `lax.scan` or `lax.fori_loop`. Lattice translations do not count as motion: positions may be wrapped in
        every step. Status bits and `required` are kept over all updates; read `overflow` after a chunk of steps, then `grow` and
        run the chunk again (`run_chunk` does that).

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            cutoff: Present cutoffs per particle, as `search` takes them, if the list was made with such; default: those of the
                list. The list keeps them. The growth of the largest one is subtracted from the skin.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.
            active: Which particles take part now, shape [n], bool, exactly if the list was made with `active`; a change causes a
                rebuild.
            box: The present box, of the same kind; default: that of the list. The list keeps it. A change that may bring a new pair
                within the cutoff causes a rebuild.

        Returns:
            A `NeighborList` of the same shapes and options.

        Raises:
            ValueError, TypeError: an argument does not fit the list.

        Cost: one pass over the positions, or a search. Differentiable: no gradient flows through. Jit: yes. vmap: yes; if any list
        of the batch is stale, all are rebuilt.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        rows = rows if self.own_queries else None
        radii = self._radii_now(cutoff, sources, rows)
        active, box = self._check_active(active, sources), self._box_now(box, sources)
        with own_transfers():
            return call_apart(_update, self, sources, rows, active, box, radii)

    def grow(
        self,
        positions: Array,
        *,
        cutoff: Array | tuple[Array, Array] | None = None,
        queries: Array | None = None,
        active: Array | None = None,
        box: Box | None = None,
        slack: float = 1.25,
    ) -> "NeighborList":
        """Make a list with larger capacity at these positions, where it overflowed. Not inside jit: the capacity is a shape.

        The capacity is the number of slots per row and, in a periodic box, of images: those that the cutoff needs in this box and
        in that of the list, or twice as many if updates met a smaller box in between.

        Args:
            positions: Sources [length], shape [n, d].
            cutoff: As in `update`.
            queries: As in `update`.
            active: As in `update`.
            box: The box at these positions; default: that of the list, which after a chunk is the last one.
            slack: Factor >= 1 on the longest row so far, including updates of this list.

        Returns:
            A `NeighborList` with the same options, a capacity not smaller than before, status bits cleared, and nothing to `check`.

        Raises:
            TypeError: positions or the list are traced.
            ValueError, TypeError: an argument does not fit the list, or the new list reports invalid data (`check`), which no
                capacity can fix: non-finite positions, or a degenerate box.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        queries, active, slack = rows if self.own_queries else None, self._check_active(active, sources), check_slack(slack)
        box, radii = self._box_now(box, sources), self._radii_now(cutoff, sources, queries)
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((sources, queries, active, box, radii, self.required))):
            raise TypeError("grow() changes the shape of the list and cannot run inside jax.jit: call it on what jit returns.")
        wider = dataclasses.replace(self, problem=self.problem.with_images(self._grow_images(box, radii)))
        inputs, options = self.problem.inputs(sources, queries, active, box, radii, self.batch), wider.problem.options
        with own_transfers():
            met = round_capacity(math.ceil(slack * int(np.max(np.asarray(self.required)))))
            made = _remake(wider, inputs, max(self.capacity, met, count_capacity(inputs, options, slack)))
        made.check()
        return made

    @property
    def rebuild_count(self) -> Array:
        """How often updates rebuilt the list, shape [], int32; only for a list with a skin."""
        if self.verlet is None:
            raise ValueError("this list was made without a skin: every update makes it anew, and nothing counts them.")
        return self.verlet.rebuild_count

    def check(self) -> None:
        """Raise what the status bits report; wait for the device. Not inside jit: there, read `status` and `overflow`.

        Raises:
            NeighborOverflowError: a row holds more neighbors than `capacity`; `.required` is the capacity needed.
            ValueError: positions or queries hold NaN or infinity, or do not fit the box; or there were more pairs than `require`
                allows.
            TypeError: called on a list that is being traced.
        """
        if isinstance(self.status, Tracer):
            raise TypeError("check() reads values and cannot run inside jax.jit: call it on the list that jit returns.")
        self._check_known()

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

    def vectors(self, positions: Array, *, queries: Array | None = None, box: Box | None = None) -> tuple[Array, Array]:
        """Compute the displacements x_j - x_i to all neighbors, in a periodic box plus the lattice translation of the image.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.
            box: The present box; default: that of the list, as a constant in derivatives.

        Returns:
            Displacements [length], shape [m, capacity, d], 0 in masked slots; and the mask, shape [m, capacity], bool: the slot is
            used and its pair is closer than the cutoff at these positions, exactly.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.
            NeighborOverflowError, ValueError: outside jit, pairs may be missing: rows overflowed, or data were invalid; inside,
                read `status`. Particles that are not finite have no pairs, which is no error here.

        Differentiable: to any order in positions, queries and box; the mask is a constant. Jit: yes. vmap: yes.
        """
        vectors, mask, _ = self._geometry(positions, queries, box)
        return vectors, mask

    def shifts(self, positions: Array, *, queries: Array | None = None, box: Box | None = None) -> Array:
        """Compute the lattice shift S of every neighbor: its displacement is x_j - x_i + S·(lattice vectors).

        Every used slot has a shift, even if its pair lies in the skin, beyond the cutoff: `nbrs.shifts(x)[nbrs.idx <
        nbrs.source_count]` has one row per pair, in the order of `pairs()`. Of pairs closer than the cutoff,
        `nbrs.shifts(x)[nbrs.distances(x)[1]]` has one row each, in the order of `pairs(positions=x)`.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: As in `vectors`.
            box: As in `vectors`.

        Returns:
            Whole numbers, shape [m, capacity, d], int32; 0 in unused slots, along axes that are not periodic, and between positions
            that are now more than 1022 lattice vectors apart.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: no (integers). Jit: yes. vmap: yes.
        """
        sources, rows = self._geometry_inputs(positions, queries)
        self._check_known(spared=ROWS_ARE_WHOLE)
        box = self._box_now(box, sources)
        with own_transfers():
            if box is None or self.box_kind is None or 0 in (sources.shape[0], *self.idx.shape):
                return jnp.zeros((*self.idx.shape, sources.shape[1]), jnp.int32)
            where = sources, rows, box, self.batch
            return lattice_shifts(self._topology(), self.count, self._images_made(), *where, self.box_kind, self.half)

    def distances(self, positions: Array, *, queries: Array | None = None, box: Box | None = None) -> tuple[Array, Array]:
        """Compute the distance to every neighbor.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            queries: As in `vectors`.
            box: As in `vectors`.

        Returns:
            Distances [length], shape [m, capacity], 0 in masked slots; and the mask as `vectors` gives it.

        Raises:
            ValueError, TypeError: positions or queries do not fit the list.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: to any order; the gradient of a distance of 0 is 0. Jit: yes. vmap: yes.
        """
        topology = self._topology()
        if 0 in self.idx.shape or not topology.measured or (self.box_kind is not None and self.box_kind.per_system):
            vectors, mask = self.vectors(positions, queries=queries, box=box)
            return norms(vectors), mask
        sources, _ = self._geometry_inputs(positions, queries)
        self._check_known(spared=ROWS_ARE_WHOLE)
        box, cutoff = self._box_now(box, sources), self._cutoff_of_pairs()
        from jfrnn._search.lengths import lengths

        with own_transfers():
            return lengths(topology, self.count, self._images_made(), sources, box, self.box_kind, cutoff, self.closed)

    def edges(self, positions: Array, total: int, *, queries: Array | None = None, box: Box | None = None) -> Edges:
        """Return the pairs as edges of a graph, with their geometry, for graph networks inside jit.

        Edges lead from neighbors j to particles i and are sorted by i, so `jax.ops.segment_sum(messages, edges.receivers, m,
        indices_are_sorted=True)` sorts nothing; `messages` of edges outside the mask should be 0. Pairs of the skin, beyond the
        cutoff at these positions, have no edges. In a periodic box each image of a neighbor has an edge of its own.

        Args:
            positions: As in `vectors`.
            total: Number of edges, a static int up to 2³¹ - 1. If there are more pairs, this raises outside jit. Inside jit, all
                displacements are NaN then, and `status` and `pair_count` say so; `require(total)` makes the list keep such a bit,
                of all pairs that it holds, those of the skin included.
            queries: As in `vectors`.
            box: As in `vectors`.

        Returns:
            An `Edges`: senders [total], receivers [total], displacement [total, d], shift [total, d], mask [total], status [],
            distance [total], pair_count [].

        Raises:
            ValueError, TypeError: as in `vectors` and `pairs`; or the list has more than 2³¹ - 1 slots.
            NeighborOverflowError, ValueError: as `vectors`.

        Differentiable: displacements and distances, to any order in positions, queries and box; derivatives gather, as those of
        `vectors`. Jit: yes. vmap: yes.
        """
        if self.idx.size > MOST_SLOTS:
            raise ValueError(
                f"edges() numbers slots by int32, and this list has {self.idx.size}: take `vectors`, or fewer queries."
            )
        total = check_total(total)
        self._check_single()
        _, mask, shifts = self._geometry(*lax.stop_gradient((positions, queries, box)))
        sources, rows = self._geometry_inputs(positions, queries)
        box = self._box_now(box, sources)
        with own_transfers():
            if 0 in (sources.shape[0], *self.idx.shape, total):
                made = no_edges(mask, self.source_count, sources, self.status, total)
            else:
                given = self._topology(), self.status, mask, shifts, sources, rows, box, self.batch
                made = flat_edges(*given, self.box_kind if box is not None else None, total)
        check_held(made.pair_count, total)
        return made

    def to_jraph(self, positions: Array, total: int, *, box: Box | None = None) -> Graph:
        """Return the edges as a graph of jraph, with displacements, distances and lattice shifts; jraph need not be installed.

        Args:
            positions: Particles [length], shape [n, d], where they are now.
            total: Number of edges, a static int, as in `edges`.
            box: As in `vectors`.

        Returns:
            A `Graph`, a pytree with the fields of `jraph.GraphsTuple`, padded by a second graph of one node and the unused edges:
            nodes {"positions": [n + 1, d]}, edges {"displacement": [total, d], "distance": [total], "shift": [total, d]}, receivers
            and senders [total] int32, n_node [2], n_edge [2].

        Raises:
            ValueError: the list has queries, which are no nodes.
            NeighborOverflowError, ValueError, TypeError: as `edges`.

        Differentiable: as `edges`, also the positions of nodes. Jit: yes. vmap: yes.
        """
        if self.own_queries:
            raise ValueError("to_jraph() makes particles the nodes of a graph, and this list has queries: take `edges`.")
        return make_graph(self.edges(positions, total, box=box), self._geometry_inputs(positions, None)[0])

    def _near(self, positions: Array, queries: Array | None, box: Box | None) -> Array:
        return self._geometry(positions, queries, box)[1]

    def _check_active(self, active: Array | None, sources: Array) -> Array | None:
        if self.masked != (active is not None):
            state = "with active: pass active=" if self.masked else "without active: leave active out"
            raise ValueError(f"this list was made {state}.")
        return None if active is None else check_active(active, sources)

    def _radii_now(self, cutoff: Given, sources: Array, queries: Array | None) -> Radii | None:
        if cutoff is None:
            return self.radii
        if self.radii is None:
            raise ValueError("this list was made with one cutoff for all particles: leave cutoff out.")
        radii = check_radii(cutoff, self.radii.asked, sources, queries)
        if radii is None:
            raise ValueError("this list was made with a cutoff for each particle: pass such an array, or leave cutoff out.")
        return radii

    def _box_now(self, box: Box | None, sources: Array) -> Box | None:
        if box is None:
            return self.box
        if self.box is None:
            raise ValueError("this list was made without a periodic box: leave box out.")
        checked = check_box(box, sources, like=self.box)
        return None if checked is None else round_box(checked.counted_as(self.box), np.dtype(sources.dtype))

    def _grow_images(self, box: Box | None, radii: Radii | None) -> Images | None:
        if self.box_kind is None or self.box is None or box is None:
            return self.box_kind
        short = bool(np.any(np.asarray(jax.device_get(self.status)) & Status.BOX_TOO_SMALL.value))
        reach = self.problem.reach(radii)
        return grow_images(self.box_kind, (box, self.box), reach, self.dtype, self.source_count, short)

    def _geometry(self, positions: Array, queries: Array | None, box: Box | None) -> tuple[Array, Array, Array | None]:
        sources, rows = self._geometry_inputs(positions, queries)
        self._check_known(spared=ROWS_ARE_WHOLE)
        box = self._box_now(box, sources)
        if 0 in (sources.shape[0], *self.idx.shape):
            with own_transfers():
                return jnp.zeros((*self.idx.shape, sources.shape[1]), sources.dtype), jnp.zeros(self.idx.shape, bool), None
        cutoff = self._cutoff_of_pairs()
        with own_transfers():
            if box is None or self.box_kind is None:
                return *open_vectors(self._topology(), self.count, sources, rows, cutoff, self.closed), None
            given = (self.box_kind, cutoff, self.closed, self.half)
            return periodic_vectors(self._topology(), self.count, self._images_made(), sources, rows, box, self.batch, *given)

    def _cutoff_of_pairs(self) -> Cutoff | Radii | None:
        return self.radii if self.cutoff is None else make_cutoff(self.cutoff, self.dtype, self.closed)

    def _topology(self) -> Topology:
        problem, codes = self.problem, None if self.images is None else self.images.codes
        kind = problem.options, problem.source_count, problem.own_queries, self.radii
        return make_topology(*kind, self.idx, codes, self.reverse, self.order)

    def _images_made(self) -> ImagesMade:
        made = None if self.images is None or self.verlet is None else (self.verlet.positions, self.verlet.queries)
        return self.images, made

    def _geometry_inputs(self, positions: Array, queries: Array | None) -> tuple[Array, Array]:
        sources = check_again("positions", positions, self.dtype, self.dim, self.source_count)
        check_devices("positions", sources, self.idx)
        if self.own_queries != (queries is not None):
            state = "with queries: pass queries=" if self.own_queries else "without queries: leave queries out"
            raise ValueError(f"this list was made {state}.")
        if queries is None:
            return sources, sources
        rows = check_again("queries", queries, self.dtype, self.dim, self.idx.shape[0])
        check_devices("queries", rows, self.idx)
        return sources, rows


@compile_program
def _update(
    nbrs: NeighborList, sources: Array, queries: Array | None, active: Array | None, box: Box | None, radii: Radii | None
) -> NeighborList:
    sources, queries, box, radii = lax.stop_gradient((sources, queries, box, radii))
    inputs = nbrs.problem.inputs(sources, queries, active, box, radii, nbrs.batch)

    def remake(nbrs: NeighborList) -> NeighborList:
        made, verlet = _remake(nbrs, inputs, nbrs.capacity), nbrs.verlet
        if made.verlet is not None and verlet is not None:
            made = dataclasses.replace(made, verlet=dataclasses.replace(made.verlet, rebuild_count=verlet.rebuild_count + 1))
        return dataclasses.replace(made, status=made.status | nbrs.status, required=jnp.maximum(made.required, nbrs.required))

    if nbrs.verlet is None:
        return remake(nbrs)
    now = hide_inactive(sources, take_present(inputs).active)
    moved = has_moved_too_far(nbrs.verlet, now, queries, box, nbrs.box_kind, radii, nbrs.skin, nbrs.batch)
    fixed = {"box": box, "radii": radii, "batch": nbrs.batch}
    nobody = dict.fromkeys(fixed)  # what stays is no state of the loop, so that XLA derives from it once what steps of a scan need
    state = moved, dataclasses.replace(nbrs, **nobody)

    def body(state: tuple[Array, NeighborList]) -> tuple[Array, NeighborList]:
        return jnp.zeros_like(state[0]), dataclasses.replace(remake(state[1]), **nobody)

    # a loop of at most one iteration: XLA updates a loop's carry in place, but copies the results of a branch
    return dataclasses.replace(lax.while_loop(lambda state: state[0], body, state)[1], **fixed)


def _remake(nbrs: NeighborList, inputs: Inputs, capacity: int) -> NeighborList:
    """Make a new list with the options of this one."""
    return dataclasses.replace(nbrs, **find_fields(inputs, nbrs.problem.options, capacity, nbrs.skin > 0, nbrs.reverse is not None))
