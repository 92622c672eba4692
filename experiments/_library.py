"""The one place where experiments take what is private to the library. All else they ask by its public names, as users do.

- `load_warp`: Warp as the library starts it, quietly and once, so that kernels of both share its settings.
- `round_capacity`: how the library rounds the slots of a row, so that lists here are as long as those that it makes itself.
- `triangle_query`: the kernels of a search for triangles one by one, with what they are given: a call of the library runs them all.
- `taylor_green_velocity`, `lattice`, `free`, `LAYERS`: parts of scenes of `jfrnn.cases`, for answers and scenes beside them.
"""

from typing import Any, NamedTuple

import numpy as np
from jfrnn.cases import _fluid, _fluid_flows, _fluid_free  # pyright: ignore[reportMissingImports]

from jfrnn._engine import kernels_of, load_warp
from jfrnn._geometry import make_cutoff
from jfrnn._search import round_capacity
from jfrnn._triangles import warp as _triangles_warp
from jfrnn._triangles.cells import gather_corners

lattice, taylor_green_velocity, free, LAYERS = (
    _fluid.lattice,
    _fluid_flows.taylor_green_velocity,
    _fluid_free.free,
    _fluid_free.LAYERS,
)


class TriangleQuery(NamedTuple):
    """Commands of a query (kernel, arguments, threads, threads of a block, ...), and the arrays that they write on a device."""

    commands: list[Any]
    idx: Any
    count: Any
    scratch: Any


def triangle_query(tri: Any, x: Any, device: str) -> TriangleQuery:  # noqa: ANN401
    """Return what a query runs with the cells or the tree of a list of triangles, for particles x [n, d] on a device."""
    wp = load_warp()
    n, dim = x.shape
    variant = _triangles_warp._Variant(dim, x.dtype == np.float64, lists=True, tree=tri.backend == "bvh")
    corners, _, _ = gather_corners(tri.vertices, tri.faces)
    inputs = _triangles_warp.query_inputs(x, corners, tri.cells, make_cutoff(tri.cutoff, np.dtype(x.dtype), closed=False))
    sizes = _triangles_warp.sizes_on_cuda(variant, inputs)
    words = kernels_of("triangles_cuda").scratch_words(n, *sizes, dim, variant.double)
    arrays = [wp.array(np.asarray(given), device=device) for given in inputs]
    arrays[1] = wp.array(np.asarray(corners), dtype=arrays[0].dtype, ndim=3, device=device)
    arrays += [wp.empty(shape, dtype=wp.int32, device=device) for shape in ((n, tri.capacity), n, words)]
    if device != "cpu":
        _triangles_warp._cuda_kernels(variant).load(device)
    return TriangleQuery(_triangles_warp._commands(variant, *arrays), *arrays[-3:])
