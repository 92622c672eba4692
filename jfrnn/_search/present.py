"""What a list is at present positions: one value, of which its geometry is computed."""

import dataclasses
from typing import NamedTuple

import jax
from jax import Array, lax

from jfrnn._geometry import Batch, Box, Cutoff, Cutoffs, Images, Radii, make_cutoffs
from jfrnn._search.topology import Topology


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
        rows: Positions of the rows [m, d].
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
    rows: Array
    box: Box | None
    batch: Batch | None
    cutoff: Cutoff | Radii | None
    kind: Images | None = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    forward: bool = dataclasses.field(metadata={"static": True})

    @property
    def native(self) -> bool:
        """Whether Warp's kernels decide which slots hold a pair: not where JAX chooses images that stand in the list."""
        return self.topology.native and not self.forward

    @property
    def cutoffs(self) -> Cutoff | Cutoffs:
        """The cutoff of pairs, with the constants of its test."""
        if isinstance(self.cutoff, Cutoff):
            return self.cutoff
        if self.cutoff is None:
            raise TypeError("a list has a cutoff or radii.")
        return make_cutoffs(lax.stop_gradient(self.cutoff), self.closed)
