"""The engine of `wp.HashGrid`, as Warp ships it: the reference that the fused kernels are compared with."""

import dataclasses
import functools
import importlib
import math
import threading
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import numpy as np
from jax import lax

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.plans import Plan
from jfrnn._engine.problem import Kind, Options, Rows, Search
from jfrnn._engine.start import INSTALL, apart, load_warp
from jfrnn._engine.warp import Variant, call_kernels, check_platform, describe_call, missing
from jfrnn._geometry import Cutoff, make_cutoff

HashGrid = Any  # types of Warp, which cannot be named before it is imported
WarpArray = Any


@dataclasses.dataclass(frozen=True)  # all are one
class HashGridEngine:
    """`wp.HashGrid`, on the CPU and on CUDA. The grid is built from the host, which has to know the cutoff."""

    name = "hashgrid"
    static_radius = True
    translates = False
    by_cells = True

    def refuse(self, kind: Kind) -> str | None:
        """Refuse what `wp.HashGrid` has no way to say."""
        if kind.radii:
            return "takes one cutoff for all particles: pass backend='warp', 'jax' or 'brute'."
        if kind.batch:
            return "knows one system at a time: pass backend='warp', 'jax' or 'brute'."
        return "knows no periodic box: pass backend='warp', 'jax' or 'brute'." if kind.periodic else None

    def missing(self, platform: str) -> str | None:
        """Say what keeps Warp from running on a JAX platform."""
        return missing(platform)

    def rows(self, search: Search, options: Options, capacity: int | None) -> Rows:
        """Search with a hash grid of the cutoff."""
        version = load_warp().__version__
        if tuple(map(int, version.split(".")[:2])) < (1, 19):
            raise ImportError(
                f"the backend 'hashgrid' needs warp-lang 1.19: the HashGrid of {version} can list a pair twice. {INSTALL}"
            )
        radius = options.radius
        if radius is None:
            raise TypeError("the backend 'hashgrid' needs a cutoff that is known while tracing.")

        def on(cuda: bool) -> Callable[[Search], Rows]:
            def make(variant: Variant) -> Callable[..., Any]:
                return _hashgrid_callable(variant, radius, cuda)

            return functools.partial(call_kernels, _kernels().scratch_words, make, keep=options.filter, capacity=capacity)

        return lax.platform_dependent(search._replace(checks={}), cpu=on(False), cuda=on(True))

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool) -> int:
        """Return the scratch that the kernels are given, and what Warp allocates for the grid [B]."""
        check_platform(self.name, platform)
        if 0 in (n, m):
            return 0
        hashgrid = _kernels()
        # warp/native/hashgrid.cpp: two ints per cell; of each point its cell and its id, room for 1.5 n, twice for the sort
        grid = 8 * math.prod(hashgrid.grid_shape(n, dim)) + 16 * (3 * n // 2)
        return 4 * hashgrid.scratch_words(n, m, dim, 2 if double else 1, own) + grid


@functools.cache
def _kernels() -> ModuleType:
    """Return the module of kernels, which imports Warp."""
    load_warp()
    return apart(functools.partial(importlib.import_module, "jfrnn.kernels.hashgrid"))


@kernel
def _hashgrid_callable(variant: Variant, radius: float, cuda: bool) -> Call:
    """Return what searches on a platform; it knows its radius, and bears it in its name."""
    bounds = make_cutoff(radius, np.dtype(np.float64 if variant.double else np.float32), variant.closed)
    found = describe_call("hashgrid_cuda" if cuda else "hashgrid_cpu", variant, lambda *_: Plan([], {}))
    return found._replace(name=f"{found.name}_{radius.hex()}", serve=functools.partial(_serve, bounds, variant))


_one_at_a_time = threading.Lock()  # is served: a hash grid is kept for all
_streams: dict[int, Any] = {}  # Warp forgets one that is gone


def _serve(bounds: Cutoff, variant: Variant, shapes: Shapes, addresses: Mapping[str, int], device: int, stream: int) -> None:
    wp = load_warp()
    where = wp.get_device("cpu" if device < 0 else f"cuda:{device}")

    def array_of(name: str) -> WarpArray:
        is_real = name in ("positions", "queries", "cutoff")
        dtype = wp.int32 if not is_real else wp.float64 if variant.double else wp.float32
        shape = shapes.get(name, (shapes["queries"][0], 1))
        return wp.array(ptr=addresses.get(name, addresses["count"]), shape=shape, dtype=dtype, device=where)

    names = "positions", "queries", "cutoff", "idx", "count", "info", "scratch"
    with _one_at_a_time:
        if device < 0:
            _run_hashgrid(bounds, variant, *map(array_of, names))
            return
        if stream not in _streams:
            _streams[stream] = wp.Stream(where, cuda_stream=stream)
        with wp.ScopedStream(_streams[stream], sync_enter=False):
            _run_hashgrid(bounds, variant, *map(array_of, names))


def _run_hashgrid(bounds: Cutoff, variant: Variant, *arrays: WarpArray) -> None:
    wp, hashgrid = load_warp(), _kernels()
    positions, queries, cutoff, idx, count, info, scratch = arrays
    n, device = positions.shape[0], count.device
    kernels = hashgrid.hashgrid_kernels(variant.dim, variant.double, variant.scaled, variant.lists)
    shape = hashgrid.grid_shape(n, variant.dim)
    packed = wp.array(ptr=scratch.ptr, shape=n, dtype=wp.vec3d if variant.double else wp.vec3f, device=device)
    info.zero_()
    wp.launch(kernels.pack, dim=n, inputs=[positions, cutoff, wp.vec3i(*shape)], outputs=[packed, info], device=device)
    grid = _hash_grid(str(device), shape, variant.double)
    grid.build(packed, float(bounds.radius))
    scalars = [float(x) for x in (bounds.inside, bounds.outside, bounds.unit_scale)]
    flags = [int(x) for x in (variant.own, variant.closed, variant.keep.drop_self, variant.keep.later_only)]
    arguments = [grid.id, positions, queries, cutoff, *scalars, *flags]
    wp.launch(kernels.query, dim=queries.shape[0], inputs=arguments, outputs=[idx, count, info], device=device)


@functools.cache
def _hash_grid(device: str, shape: tuple[int, int, int], double: bool) -> HashGrid:
    """Keep one grid per device and shape: launches on a device run one after the other."""
    wp = load_warp()
    return wp.HashGrid(*shape, device=device, dtype=wp.float64 if double else wp.float32)
