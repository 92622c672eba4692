"""What a list is at present positions: one value, of which its geometry is computed.

It says which sources the slots hold, and where pairs stand the other way round, so that what belongs to pairs is summed for their
sources by gathers. A slot is numbered row * capacity + its place in the row. In a list that is its own mirror image, the slot of
(i, j, S) has one reverse slot: that of (j, i, -S). In other lists (half lists, lists of queries, those with the cutoff of one side)
the slots are sorted by source.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine import Options, reverse_slots, slots_by_source
from jfrnn._geometry import EXCHANGED, Batch, Box, Cutoff, Cutoffs, Images, Radii, make_cutoffs
from jfrnn._tracing import on_platform, portable

MOST_SLOTS = 2**31 - 1  # that int32 can number
_BLOCK = 1 << 22  # ids that are compared at a time by array programming: 16 MB


@portable
class Reverse(NamedTuple):
    """The slots of each source.

    Attributes:
        slots: In a list that is its own mirror image: the reverse slot of each slot, shape [n, capacity], int32; n * capacity where
            there is none. In other lists: the used slots in the order of their sources, shape [m * capacity], int32, padded with
            m * capacity.
        starts: Where the slots of each source begin among these, shape [n], int32; None in a list that is its own mirror image.
        lengths: How many slots each source has, shape [n], int32; likewise.
    """

    slots: Array
    starts: Array | None = None
    lengths: Array | None = None


def _find_reverse(topology: "Topology") -> Reverse:
    """Find the slots of each source of a list."""
    idx, codes, order, sources, images = topology.idx, topology.codes, topology.order, topology.sources, topology.images
    mutual, native = topology.mutual, topology.native
    if 0 in (*idx.shape, sources):
        none = jnp.zeros(sources, jnp.int32)
        return Reverse(jnp.zeros(idx.shape, jnp.int32)) if mutual else Reverse(jnp.zeros(idx.size, jnp.int32), none, none)
    if mutual and not native:
        return Reverse(_reverse_by_comparing(idx, codes, images))
    if mutual:
        on_cpu, on_cuda = (functools.partial(reverse_slots, images=images, cuda=cuda) for cuda in (False, True))
        return Reverse(on_platform(idx, codes, order, cpu=on_cpu, cuda=on_cuda))
    sort = functools.partial(_sort_slots, sources=sources)
    if not native:
        return Reverse(*sort(idx))
    return Reverse(*on_platform(idx, cpu=functools.partial(slots_by_source, sources=sources), cuda=sort))


def _reverse_by_comparing(idx: Array, codes: Array | None, images: int) -> Array:
    """Compare all ids of the rows of all neighbors, a block of rows at a time: capacity² comparisons per row."""
    n, capacity = idx.shape
    none = n * capacity
    rows = min(max(_BLOCK // capacity**2, 1), n)

    def find_block(b: Array, slots: Array) -> Array:
        first = jnp.minimum(b * rows, n - rows)
        here = lax.dynamic_slice_in_dim(idx, first, rows)
        neighbor = jnp.where(here < n, here, 0)
        same = idx[neighbor] == (first + lax.iota(jnp.int32, rows))[:, None, None]
        if codes is not None:
            opposite = images - 1 - lax.dynamic_slice_in_dim(codes, first, rows).astype(jnp.int32)
            same = same & (codes[neighbor].astype(jnp.int32) == opposite[..., None])
        place = jnp.min(jnp.where(same, lax.broadcasted_iota(jnp.int32, same.shape, 2), capacity), axis=2)
        found = jnp.where((here < n) & (place < capacity), neighbor * capacity + place, none)
        return lax.dynamic_update_slice_in_dim(slots, found, first, axis=0)

    return lax.fori_loop(0, -(-n // rows), find_block, jnp.full(idx.shape, none, jnp.int32))


def _sort_slots(idx: Array, sources: int) -> tuple[Array, Array, Array]:
    """Sort the slots by source; those of one source stay in order."""
    flat = idx.reshape(-1)
    by_source, slots = lax.sort((flat.astype(jnp.uint32), lax.iota(jnp.int32, flat.size)), num_keys=1, is_stable=True)
    lengths = jnp.zeros(sources, jnp.int32).at[flat].add(1, mode="drop")
    starts = jnp.cumsum(lengths, dtype=jnp.int32) - lengths
    return jnp.where(by_source < sources, slots, flat.size), starts, lengths


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Topology:
    """Which sources the slots of a list hold.

    Attributes:
        idx: [m, capacity] int32 source indices; unused slots hold the number of sources.
        codes: Image codes of the slots, or None if a pair has one image.
        reverse: The slots of each source, or None: they are found when they are needed.
        order: The sources as they follow each other in space [n] int32, or None.
        sources: Number of sources. Static.
        images: Number of image codes. Static.
        mutual: Whether the list is its own mirror image. Static.
        native: Whether Warp's kernels run where the list is. Static.
    """

    idx: Array
    codes: Array | None
    reverse: Reverse | None
    order: Array | None
    sources: int = dataclasses.field(metadata={"static": True})
    images: int = dataclasses.field(metadata={"static": True})
    mutual: bool = dataclasses.field(metadata={"static": True})
    native: bool = dataclasses.field(metadata={"static": True})

    def with_reverse(self) -> Reverse:
        """Return the slots of each source, found anew unless they are kept."""
        return _find_reverse(self) if self.reverse is None else self.reverse

    def merge(self) -> "Topology":
        """Return the lists of a batch, along the first axis of all arrays, as one list of all their rows and sources."""
        size, m, capacity = self.idx.shape
        n = self.sources

        def number(x: Array, most: int) -> Array:
            first = lax.broadcasted_iota(jnp.int32, x.shape, 0)
            return jnp.where(x < most, x + first * most, size * most).reshape(-1, *x.shape[2:])

        idx, reverse = number(self.idx, n), self.reverse
        codes = None if self.codes is None else self.codes.reshape(-1, capacity)
        if reverse is not None:
            starts = reverse.starts
            starts = None if starts is None else number(starts, m * capacity)
            lengths = None if reverse.lengths is None else reverse.lengths.reshape(-1)
            reverse = Reverse(number(reverse.slots, m * capacity), starts, lengths)
        return dataclasses.replace(self, idx=idx, codes=codes, reverse=reverse, order=None, sources=size * n)


def one_each(named: Array, sources: int, native: bool, reverse: Reverse | None = None) -> Topology:
    """Return the list whose rows have one slot, which holds the source that is named [m]."""
    mutual = reverse is not None and reverse.starts is None
    return Topology(named[:, None], None, reverse, None, sources, 1, mutual, native)


def make_topology(
    options: Options,
    sources: int,
    own_queries: bool,
    radii: Radii | None,
    idx: Array,
    codes: Array | None,
    reverse: Reverse | None,
    order: Array | None,
) -> Topology:
    """Return which sources the slots of a list of a search with these options hold."""
    images = 1 if options.images is None else options.images.total
    mutual = not (own_queries or options.filter.later_only or (radii is not None and radii.rule in EXCHANGED))
    return Topology(idx, codes, reverse, order, sources, images, mutual, options.engine.native)


@portable
class ImageCodes(NamedTuple):
    """The periodic image that each slot refers to, for lists with more than the minimum image.

    Attributes:
        codes: Index among the shifts within reach, for wrapped positions, shape [m, capacity]: uint8 for up to 256 images, int16
            for up to 32 768, else int32. Shifts and turns count the vectors of `Images.basis`, or of `Box.numbers`.
        turns: How many lattice vectors each source was from the box when the list was made, packed, shape [n], int32.
        query_turns: Likewise for queries, shape [m], int32; None if the sources are the queries.
    """

    codes: Array
    turns: Array
    query_turns: Array | None


ImagesMade = tuple[ImageCodes | None, tuple[Array, Array | None] | None]  # and the positions at which a list with a skin was made


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Present:
    """A list at present positions; a pytree. An edge of a flat list is a row of one slot.

    Attributes:
        topology: Which sources the slots hold, or the senders of the edges.
        count: True number of neighbors of each row, [m]; of a flat list, that of its pairs, [].
        images: The images of the slots, and where points were when the list was made; (None, None) if a pair has one image.
        sources: Positions of the sources [n, d].
        queries: Positions of the rows [m, d]; None: they are the sources.
        box: The present box, or None.
        batch: The systems of the particles, of which each may have a box; None in open space.
        cutoff: That of the pairs; None: all pairs of the list are.
        kind: Which images are considered; None in open space. Static.
        closed: Whether a pair may be as far apart as the cutoff. Static.
        forward: Whether of a particle's two opposite images the forward one stands in the list. Static.
    """

    topology: Topology
    count: Array
    images: ImagesMade
    sources: Array
    queries: Array | None
    box: Box | None
    batch: Batch | None
    cutoff: Cutoff | Radii | None
    kind: Images | None = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    forward: bool = dataclasses.field(metadata={"static": True})

    @property
    def rows(self) -> Array:
        """Positions of the rows [m, d]."""
        return self.sources if self.queries is None else self.queries

    @property
    def native(self) -> bool:
        """Whether Warp's kernels decide which slots hold a pair: not where JAX chooses images that stand in the list."""
        return self.topology.native and not self.forward

    @property
    def cutoffs(self) -> Cutoff | Cutoffs:
        """The cutoff of pairs, with the constants of its test."""
        if isinstance(self.cutoff, Cutoff):
            return self.cutoff
        assert self.cutoff is not None  # who takes all pairs does not ask
        return make_cutoffs(lax.stop_gradient(self.cutoff), self.closed)
