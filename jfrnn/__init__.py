"""Find every pair of particles closer than a cutoff: exact, in JAX, inside `jax.jit`, at a cost that follows the particles.

>>> import jax.numpy as jnp, jfrnn
>>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
>>> nbrs = jfrnn.search(x, 1.0)
>>> nbrs.count
Array([1, 1, 0], dtype=int32)
>>> [indices.tolist() for indices in nbrs.pairs()]
[[0, 1], [1, 0]]
"""

from jfrnn._geometry import (
    Box,
    NeighborOverflowError,
    Status,
    hilbert_decode,
    hilbert_encode,
    merge_vertices,
    morton_decode,
    morton_encode,
    pairs_of_rows,
    sort_order,
)
from jfrnn._memory import MemoryPlan, memory_plan
from jfrnn._search import EdgeList, NeighborList, count, run_chunk, search, search_edges
from jfrnn._sums import pair_sum
from jfrnn._triangles import TriangleList, search_triangles

__version__ = "0.2.0"

__all__ = [
    "Box",
    "EdgeList",
    "MemoryPlan",
    "NeighborList",
    "NeighborOverflowError",
    "Status",
    "TriangleList",
    "count",
    "hilbert_decode",
    "hilbert_encode",
    "memory_plan",
    "merge_vertices",
    "morton_decode",
    "morton_encode",
    "pair_sum",
    "pairs_of_rows",
    "run_chunk",
    "search",
    "search_edges",
    "search_triangles",
    "sort_order",
]
