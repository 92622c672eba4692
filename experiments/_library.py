"""The one place where experiments take what is private to the library. All else they ask by its public names, as users do.

- `load_warp`: Warp as the library starts it, quietly and once, so that kernels of both share its settings.
- `round_capacity`: how the library rounds the slots of a row, so that lists here are as long as those that it makes itself.
- `triangle_query`: the kernels of a search for triangles one by one, with what they are given: a call of the library runs them all.
- `taylor_green_velocity`, `free`, `LAYERS`: parts of scenes of `jfrnn.cases`, for answers and scenes beside them.
"""

import ctypes
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jfrnn._engine import Plan
from jfrnn._engine.start import compiler, load_warp
from jfrnn._geometry import make_cutoff
from jfrnn._search import round_capacity
from jfrnn._triangles import warp as _triangles_warp
from jfrnn._triangles.cells import gather_corners
from jfrnn.cases import _fluid_flows, _fluid_free
from jfrnn.kernels import _driver, triangles_cuda

Name = Any  # one of a few words, such as a backend, as a config or a command line gives it

taylor_green_velocity, free, LAYERS = _fluid_flows.taylor_green_velocity, _fluid_free.free, _fluid_free.LAYERS


class TriangleQuery(NamedTuple):
    """What launches each kernel of a query on CUDA, by name and in order, and the scratch that they write."""

    launches: dict[str, Callable[[], None]]
    scratch: Any


def triangle_query(tri: Any, x: Any, device: str) -> TriangleQuery:  # noqa: ANN401
    """Return what a query runs with the cells or the tree of a list of triangles, for particles x [n, d] on a device."""
    wp = load_warp()
    n, dim = x.shape
    variant = _triangles_warp._Variant(dim, x.dtype == np.float64, lists=True, tree=tri.backend == "bvh")
    corners, _, _ = gather_corners(tri.vertices, tri.faces)
    inputs = _triangles_warp.query_inputs(x, corners, tri.cells, make_cutoff(tri.cutoff, np.dtype(x.dtype), closed=False))
    given = dict(zip(_triangles_warp._GIVEN, map(np.asarray, inputs), strict=True))
    sizes = _triangles_warp.sizes_on_cuda(variant, *(given[name].shape for name in ("corners", "boxes", "start", "triangles")))
    words = triangles_cuda.scratch_words(n, *sizes, dim, variant.double)
    given |= {"idx": np.empty((n, tri.capacity), np.int32), "count": np.empty(n, np.int32), "scratch": np.empty(words, np.int32)}
    arrays = {name: wp.array(array.reshape(-1), device=device) for name, array in given.items()}
    multiprocessors = wp.get_device(device).sm_count
    plan = _triangles_warp.plan_on_cuda(variant, {name: array.shape for name, array in given.items()}, multiprocessors)
    steps = dict(zip(triangles_cuda.Kernels._fields, plan.steps, strict=True))
    launches = {name: functools.partial(_launch_alone, step, plan, arrays, device) for name, step in steps.items()}
    return TriangleQuery(launches, arrays["scratch"])


def _launch_alone(step: Any, plan: Plan, arrays: dict[str, Any], device: str) -> None:  # noqa: ANN401
    """Launch a kernel on the current stream of a CUDA device."""
    packed = step.kernel.pack({**plan.numbers, **step.numbers, **{name: array.ptr for name, array in arrays.items()}})
    given = (ctypes.c_ubyte * len(packed)).from_buffer(packed)
    function = ctypes.c_void_p(compiler().load(step.kernel.program, device).address_of(step.kernel.name))
    grid = -(-step.threads // step.kernel.block), 1, 1, step.kernel.block, 1, 1, 0
    stream = ctypes.c_void_p(load_warp().get_stream(device).cuda_stream)
    wrong = _driver.driver().cuLaunchKernel(function, *grid, stream, (ctypes.c_void_p * 1)(ctypes.addressof(given)), None)
    if wrong:
        raise RuntimeError(f"{step.kernel.name}: a launch failed with CUDA's error {wrong}")
