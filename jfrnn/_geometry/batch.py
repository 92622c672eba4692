"""Batches: particles of many independent systems in one call. A system number per particle keeps the systems apart."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._tracing import portable


@portable
class Batch(NamedTuple):
    """The system number of each particle; only particles of one system can be neighbors. A pytree.

    Attributes:
        sources: [n] system of each source: int32 as the user numbers systems, or uint32 after `rank_systems`.
        queries: [m] system of each query; None if the sources are the queries.
        fit: Which sources and which queries have a number that int32 holds, [n] and [m] bool; None if all are known to. Others take
            no part.
    """

    sources: Array
    queries: Array | None
    fit: tuple[Array, Array | None] | None = None

    @property
    def of_queries(self) -> Array:
        """System numbers of the queries, which are those of the sources if the sources are the queries."""
        return self.sources if self.queries is None else self.queries

    @property
    def of_all(self) -> Array:
        """System numbers of the sources, followed by those of the queries if these are separate."""
        return self.sources if self.queries is None else jnp.concatenate([self.sources, self.queries])

    def reverse(self) -> "Batch":
        """Return the same numbers with queries and sources exchanged."""
        turned = None if self.fit is None else (self.fit[0] if self.fit[1] is None else self.fit[1], self.fit[0])
        return Batch(self.of_queries, self.sources, turned)


def has_box(systems: Array, boxes: int) -> Array:
    """Say which particles belong to one of so many systems, each of which has a box of its own; [n] bool."""
    return (systems >= 0) & (systems < boxes)


def rank_systems(batch: Batch) -> Batch:
    """Replace system numbers by their differences to the smallest one, as uint32, which holds every difference of two int32."""
    sources = _in_order(batch.sources)
    queries = None if batch.queries is None else _in_order(batch.queries)
    lowest = jnp.min(Batch(sources, queries).of_all, initial=np.uint32(2**32 - 1))
    return Batch(sources - lowest, None if queries is None else queries - lowest)


def _in_order(x: Array) -> Array:
    """Map int32 to uint32 so that the order of numbers is kept."""
    return lax.bitcast_convert_type(x, jnp.uint32) ^ np.uint32(1 << 31)
