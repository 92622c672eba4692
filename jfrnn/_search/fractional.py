"""Fractional coordinates: where positions that count lattice vectors become lengths, in one place."""

import functools

import jax.numpy as jnp
from jax import Array

from jfrnn._geometry import Batch, Box, rounded_product, rounded_scaled
from jfrnn._search.topology import Topology
from jfrnn._tracing import compile_program, own_transfers


def real_points(
    sources: Array, queries: Array | None, box: Box | None, batch: Batch | None, native: bool
) -> tuple[Array, Array | None]:
    """Return sources and queries as lengths: unchanged, or with `Box.fractional` coordinates @ vectors of the box.

    Each component is computed in twice the precision and rounded once, the same on every device; all that follows, such as the
    exact decision about pairs, is about these numbers. Differentiable in coordinates and vectors, by gathers. `native`: Warp's
    kernels run where the points are.
    """
    if box is None or not box.fractional:
        return sources, queries
    with own_transfers():
        return _multiply(sources, queries, box.vectors, batch, box.orthogonal, box.per_system, native)


@functools.partial(compile_program, static_argnames=("orthogonal", "per_system", "native"))
def _multiply(
    sources: Array, queries: Array | None, vectors: Array, batch: Batch | None, orthogonal: bool, per_system: bool, native: bool
) -> tuple[Array, Array | None]:
    vectors = jnp.asarray(vectors).astype(sources.dtype)

    def real(points: Array, systems: Array | None) -> Array:
        rows = _of_rows(vectors, systems, native) if per_system and systems is not None else vectors
        return rounded_scaled(points, rows) if orthogonal else rounded_product(points, rows)

    of_sources, of_queries = (None, None) if batch is None else (batch.sources, batch.of_queries)
    return real(sources, of_sources), None if queries is None else real(queries, of_queries)


def _of_rows(vectors: Array, systems: Array, native: bool) -> Array:
    """Return the vectors of the box of each row; rows without a box get any."""
    from jfrnn._search.gathers import gather

    boxes, nearest = len(vectors), jnp.clip(systems, 0, len(vectors) - 1)
    topology = Topology(nearest[:, None], None, None, None, boxes, 1, False, native)
    return gather(vectors.reshape(boxes, -1), topology).reshape(-1, *vectors.shape[1:])
