"""Find every pair of particles closer than a cutoff: exact, in JAX, inside `jax.jit`, at a cost that follows the particles.

>>> import jax.numpy as jnp, jfrnn
>>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
>>> nbrs = jfrnn.search(x, 1.0)
>>> nbrs.count
Array([1, 1, 0], dtype=int32)
>>> [indices.tolist() for indices in nbrs.pairs()]
[[0, 1], [1, 0]]
"""

from jfrnn._box import Box
from jfrnn._chunks import run_chunk
from jfrnn._memory import MemoryPlan, memory_plan
from jfrnn._meshes import merge_vertices
from jfrnn._neighbors import NeighborList
from jfrnn._order import hilbert_decode, hilbert_encode, morton_decode, morton_encode, sort_order
from jfrnn._pair_sum import pair_sum
from jfrnn._search import count, search
from jfrnn._status import NeighborOverflowError, Status
from jfrnn._triangles import search_triangles
from jfrnn._triangles_list import TriangleList

__all__ = [
    "Box",
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
    "run_chunk",
    "search",
    "search_triangles",
    "sort_order",
]
