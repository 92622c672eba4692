"""A flat list: the pairs of a search one after another, sorted by receiver, as long as all of them together."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine import Inputs, Options, count_few, count_rows
from jfrnn._geometry import Box, Status, names_of_bits, shape_of, tell
from jfrnn._search.edges import Edges, Graph, close_edges, edges_of, edges_of_rows, make_graph, no_edges
from jfrnn._search.exports import MOST_PAIRS
from jfrnn._search.kept_search import KeptSearch
from jfrnn._search.present import Present, Topology, one_each
from jfrnn._tracing import Points, Real, at_once, own_transfers, portable

_TOTAL_STEP = 16  # steps between powers of two, in which totals are rounded up


def round_total(pairs: int) -> int:
    """Round a total up, by 6 % at most, so that similar scenes share one compiled program."""
    step = max(1 << max(pairs - 1, 1).bit_length() - 1, _TOTAL_STEP) // _TOTAL_STEP
    return min(-(-max(pairs, 1) // step) * step, MOST_PAIRS)


def count_total(inputs: Inputs, options: Options, slack: Real) -> int:
    """Count the pairs at concrete positions; return a total of `slack` times as many.

    Raises:
        ValueError: they are more than int32 can number.
    """
    with at_once(), own_transfers():
        known = count_few(inputs, options)
        pairs = int(np.sum(np.asarray(count_rows(inputs, options=options)[0]) if known is None else known, dtype=np.int64))
    if pairs > MOST_PAIRS:
        raise ValueError(
            f"total must be at most {MOST_PAIRS}, as many pairs as int32 can number, and there are {pairs}: search in parts, with "
            "queries=, or sum with pair_sum, which stores no pairs."
        )
    return round_total(math.ceil(pairs * slack))


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EdgeList(KeptSearch):
    """The pairs (i, j) of m queries and n sources as edges from j to i, sorted by i; `search_edges` makes it. A pytree.

    Memory follows the number of pairs: 8 B each, and 4 B per query, however many neighbors the fullest one has.

    Attributes:
        senders: Neighbors j, shape [total], int32; n beyond the last pair.
        receivers: Particles (or queries) i in ascending order, shape [total], int32; m beyond the last pair.
        offsets: Where the edges of each receiver begin, and those of the last one end, shape [m + 1], int32, if all pairs had
            room. With a skin, edges include pairs within cutoff + skin when the list was last rebuilt.
        status: Bits of `Status`, shape [], int32.
        required: The `total` that holds all pairs, shape [], int32; like the status, over all updates.
        verlet: As in `NeighborList`, and so are box, known, radii, batch and problem.
        box: The periodic box, rounded to the dtype of the positions; None in open space.
        images: The periodic image of each edge (`ImageCodes`), 1 B each; None if the minimum image suffices.
        radii: Cutoffs per particle, or None with one cutoff.
        batch: System numbers, or None.
        exclude: Pairs that are excluded, as rows (`Exclusions`), or None; updates keep them.
        reverse: The edges of each sender (`Reverse`), if the list was made with `reverse=True`.
        problem: The options of the search (`Problem`). Static.
    """

    senders: Array
    receivers: Array
    offsets: Array
    _full = Status.TOTAL_OVERFLOW
    _harmless = Status.NONFINITE
    _room_name = "total"
    _round_room, _count_room = staticmethod(round_total), staticmethod(count_total)

    def __repr__(self) -> str:
        """Summarize the list in a line; waits for the device."""
        *batch, total = shape_of(self.senders, axes=1)
        ends = shape_of(self.offsets, axes=1)[-1]
        pairs = tell(self.offsets, lambda offsets: np.atleast_1d(offsets)[..., -1:].sum(dtype=np.int64))
        bits = names_of_bits(self.status)
        return self._describe(batch, ends and ends - 1, f"total {total}", f"{pairs} pairs, status {bits}")

    @property
    def total(self) -> int:
        """Edges that there is room for."""
        return self.senders.shape[-1]

    @property
    def pair_count(self) -> Array:
        """The true number of pairs, shape [], int32, at most 2³¹ - 1; it may exceed `total`."""
        with own_transfers():
            return self.offsets[..., -1]

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Export the pairs (i, j) to the host, without padding: receivers and senders, int32, shape [pairs] each.

        Raises:
            NeighborOverflowError, ValueError, TypeError: as `check`.
        """
        self.check()
        self._check_single()
        with own_transfers():
            held = int(self.offsets[-1])
            return np.asarray(self.receivers)[:held], np.asarray(self.senders)[:held]

    def edges(self, positions: Points, box: Box | None = None, *, queries: Points | None = None) -> Edges:
        """Return the edges with their geometry at these positions.

        `jax.ops.segment_sum(messages, edges.receivers, m, indices_are_sorted=True)` sums messages for the receivers; `messages` of
        edges outside the mask should be 0. Without a skin, edges are the pairs of the list, whose positions these should be. With
        one, those whose pair is not closer than the cutoff at these positions, exactly, are masked where they stand.

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            box: The present box; default: that of the list, as a constant in derivatives.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.

        Returns:
            An `Edges`. Inside jit, all displacements are NaN if pairs are missing, and `status` and `pair_count` say so.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError, ValueError: outside jit, pairs may be missing (`check`); inside, read `status`. Particles that
                are not finite have no pairs, which is no error here.

        Differentiable: displacements and distances, to any order in positions, queries and box; derivatives gather and do not
        scatter, in the order of senders, which is found in each call unless the list was made with `reverse=True`. Jit: yes. vmap:
        yes.
        """
        self._check_single()
        sources, rows, box = self._geometry_inputs(positions, queries, box)
        self._check_known(spared=self._harmless)
        with own_transfers():
            if 0 in (sources.shape[0], len(rows), self.total):
                return no_edges(jnp.zeros((len(rows), 1), bool), self.source_count, sources, self.status, self.total)
            return edges_of(*self._sides(sources, rows, box, decided=not self.skin), self.status, harmless=self._harmless)

    def to_jraph(self, positions: Points, box: Box | None = None) -> Graph:
        """Return the edges as a graph of jraph, as `NeighborList.to_jraph` does; jraph need not be installed.

        Raises:
            ValueError: the list has queries, which are no nodes, or a skin, whose pairs are no edges.
            NeighborOverflowError, ValueError, TypeError: as `edges`.

        Differentiable: as `edges`, also the positions of nodes. Jit: yes. vmap: yes.
        """
        if self.own_queries:
            raise ValueError("to_jraph() makes particles the nodes of a graph, and this list has queries: take `edges`.")
        if self.skin:
            raise ValueError("to_jraph() cannot leave pairs of a skin out of the midst: take `edges`, whose mask does, or no skin.")
        return make_graph(self.edges(positions, box=box), self._geometry_inputs(positions, None, box)[0])

    @property
    def _row_count(self) -> int:
        return self.offsets.shape[-1] - 1

    def _close_edges(self, sources: Array, rows: Array, box: Box | None) -> tuple[Array, Array | None]:
        """Say which edges are pairs at these positions, and return their shifts, as `close_edges` does."""
        self._check_single()
        self._check_known(spared=self._harmless)
        if 0 in (len(sources), len(rows), self.total):
            return jnp.zeros(self.total, bool), None
        return close_edges(*self._sides(sources, rows, box))

    def _sides(self, sources: Array, rows: Array, box: Box | None, decided: bool = False) -> tuple[Present, Topology]:
        """Return the list at these positions, by its senders, and its receivers; `decided` as in `_present`."""
        native = self.problem.options.engine.native
        by_sender = one_each(self.senders, self.source_count, native, self.reverse)
        by_receiver = one_each(self.receivers, self._row_count, native, edges_of_rows(self.offsets, self.total))
        return self._present(by_sender, self.offsets[-1], sources, rows, box, decided), by_receiver
