"""Octaves of cutoffs: cells as wide as a cutoff serve all that are at least half as long; shorter ones get cells of their own.

Where each particle has its own cutoff, pairs are found part by part. Octave k holds the particles whose cutoffs are at least
2^-(k+1) and less than 2^-k of the largest one, but for a little; a pair belongs to the octave of the cutoff that decides about it.
For each octave, the sources that such pairs may have are sorted into cells of its width (`jfrnn._geometry.cell_line`), and the
queries that such pairs may have look around. So the number of candidates follows the number of particles within the cutoffs of an
octave, whatever others are. What an octave costs besides is a sort, and octaves without particles cost nothing. Krijgsman, Ogarko
& Luding (2014, doi:10.1007/s40571-014-0020-9) divide grains by size likewise.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.cutoffs import Cutoffs

OCTAVES = 24  # the last one holds all shorter cutoffs
_LITTLE = 1 - 2.0**-10
# rules by which no cutoff of a pair is longer than the longer of both; by others, than the shorter one
_LONGER = ("either", "mean")


class Part(NamedTuple):
    """Pairs that are found together.

    Attributes:
        sources: [n] bool, which sources they may have.
        queries: [m] bool, which queries.
        scale: [] a power of two; times the largest cutoff, it is at least as long as the cutoff of any of these pairs.
    """

    sources: Array
    queries: Array
    scale: Array


class Parts(NamedTuple):
    """The parts of all pairs, one or two for each octave; each pair belongs to one.

    Attributes:
        sources: [n] int32, the octaves of the sources; None if the rule does not use their cutoffs.
        queries: [m] int32, likewise.
        there: Which sources and which queries have a place, [n] and [m] bool.
        used: [parts] bool, which parts may have pairs.
        longer: Whether the longer cutoff of two decides. Static.
    """

    sources: Array | None
    queries: Array | None
    there: tuple[Array, Array]
    used: Array
    longer: bool

    @property
    def end(self) -> int:
        """What stands for the number of a part where none is left."""
        return self.used.size

    def after(self, number: Array | int) -> Array:
        """Return the number of the next part that may have pairs, [] int32."""
        ahead = self.used & (lax.iota(jnp.int32, self.end) > number)
        return jnp.min(jnp.where(ahead, lax.iota(jnp.int32, self.end), self.end))

    def part(self, number: Array, dtype: np.dtype) -> Part:
        """Return a part; its scale has this dtype."""
        steps = self.end // OCTAVES
        octave, step = lax.div(number, np.int32(steps)), lax.rem(number, np.int32(steps))
        scale = jnp.asarray(2.0 ** -np.arange(OCTAVES), dtype)[octave]
        sources, queries = self.there
        if self.sources is None or self.queries is None:
            sources = sources if self.sources is None else sources & (self.sources == octave)
            queries = queries if self.queries is None else queries & (self.queries == octave)
            return Part(sources, queries, scale)
        # first queries of this octave, with sources of it or of those that leave the decision to it; then the other way round
        way = 1 if self.longer else -1
        of_sources, of_queries = way * (self.sources - octave), way * (self.queries - octave)
        sources &= jnp.where(step == 0, of_sources >= 0, of_sources == 0)
        queries &= jnp.where(step == 0, of_queries == 0, of_queries > 0)
        return Part(sources, queries, scale)


def parts_of(cutoffs: Cutoffs, sources: Array, queries: Array) -> Parts:
    """Divide pairs by the cutoffs of a rule of two particles; `sources` [n] and `queries` [m] say which of them have a place."""
    of_sources, of_queries = (
        None if radii is None else octaves_of(radii, cutoffs.largest, OCTAVES) for radii in (cutoffs.sources, cutoffs.queries)
    )
    longer = cutoffs.rule in _LONGER
    held = [
        None if octaves is None else ((octaves[:, None] == np.arange(OCTAVES, dtype=np.int32)) & there[:, None]).any(axis=0)
        for octaves, there in ((of_sources, sources), (of_queries, queries))
    ]
    if held[0] is None or held[1] is None:
        used = next(each for each in held if each is not None)
    else:
        among = np.tril(np.ones((OCTAVES, OCTAVES), bool), -1)  # [k, l]: octave l is longer than k
        others = (held[1] & (among.T if longer else among)).any(axis=1)
        used = jnp.stack([held[1], held[0] & others], axis=1).reshape(-1)
    return Parts(of_sources, of_queries, (sources, queries), used, longer)


def octaves_of(radii: Array, largest: Array, count: int) -> Array:
    """Return the octave of each cutoff [k] among so many, int32: how often the largest one can be halved and is still longer.

    Cutoffs that are a little shorter count as if they were not, so that rounding moves none out of an octave of whole factors.
    """
    bounds = largest * jnp.asarray(_LITTLE * 2.0 ** -np.arange(1, count), radii.dtype)
    return jnp.sum(radii[:, None] < bounds, axis=1, dtype=jnp.int32)
