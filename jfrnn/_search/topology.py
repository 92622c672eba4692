"""Which sources the slots of a list hold, and where the slots of each source are."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine import Options
from jfrnn._geometry import EXCHANGED, Radii
from jfrnn._search.reverse import MOST_SLOTS, Reverse, find_reverse


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

    @property
    def measured(self) -> bool:
        """Whether kernels measure its distances (`jfrnn._search.lengths`)."""
        return self.native and self.mutual and self.idx.size <= MOST_SLOTS

    def with_reverse(self) -> Reverse:
        """Return the slots of each source, found anew unless they are kept."""
        if self.reverse is not None:
            return self.reverse
        return find_reverse(self.idx, self.codes, self.images, self.sources, self.mutual, self.native)

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


def is_mutual(options: Options, own_queries: bool, radii: Radii | None) -> bool:
    """Say whether lists of such a search are their own mirror images."""
    return not (own_queries or options.filter.later_only or (radii is not None and radii.rule in EXCHANGED))


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
    mutual = is_mutual(options, own_queries, radii)
    return Topology(idx, codes, reverse, order, sources, images, mutual, options.engine.native)
