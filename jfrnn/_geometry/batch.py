"""Batches: particles of many systems in one call, told apart by the number of their system."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax


class Batch(NamedTuple):
    """To which system each particle belongs; a pytree.

    Attributes:
        sources: [n] int32, whatever the user numbers systems with; or uint32, ranked.
        queries: [m] of the queries; None where the sources are the queries.
    """

    sources: Array
    queries: Array | None

    @property
    def of_queries(self) -> Array:
        """Systems of the queries, or of the sources where those are the queries."""
        return self.sources if self.queries is None else self.queries

    @property
    def of_all(self) -> Array:
        """Systems of the sources, then those of the queries unless the sources are the queries."""
        return self.sources if self.queries is None else jnp.concatenate([self.sources, self.queries])


def rank_systems(batch: Batch) -> Batch:
    """Number systems from 0 on, as uint32, by what they are above the lowest: the range of int32 holds no surprise."""
    sources = _in_order(batch.sources)
    queries = None if batch.queries is None else _in_order(batch.queries)
    lowest = jnp.min(Batch(sources, queries).of_all, initial=np.uint32(2**32 - 1))
    return Batch(sources - lowest, None if queries is None else queries - lowest)


def _in_order(x: Array) -> Array:
    """Map int32 to uint32 of the same order."""
    return lax.bitcast_convert_type(x, jnp.uint32) ^ np.uint32(1 << 31)
