"""Find every pair of particles closer than a cutoff: exact, in JAX, inside `jax.jit`, at a cost that follows the particles.

>>> import jax.numpy as jnp, jfrnn
>>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
>>> nbrs = jfrnn.search(x, 1.0)
>>> nbrs.count
Array([1, 1, 0], dtype=int32)
>>> [indices.tolist() for indices in nbrs.pairs()]
[[0, 1], [1, 0]]
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from jfrnn import ase as ase
    from jfrnn import distributed as distributed
    from jfrnn import jax_md as jax_md
    from jfrnn import matscipy as matscipy
    from jfrnn import sph as sph
    from jfrnn import vesin as vesin

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

_MODULES = ("ase", "distributed", "jax_md", "matscipy", "sph", "vesin")  # imported when they are asked for


if not TYPE_CHECKING:  # who checks types takes the names above, and finds misspelt ones

    def __getattr__(name: str) -> ModuleType:
        if name in _MODULES:
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__", *_MODULES]
