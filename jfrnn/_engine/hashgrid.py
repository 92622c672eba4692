"""The engine of `wp.HashGrid`, as Warp ships it: the reference that the fused kernels are compared with."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jax import lax

from jfrnn._engine.cores import load_on_cpu
from jfrnn._engine.launch import Kernel, kernel
from jfrnn._engine.problem import Kind, Options, Rows, Search
from jfrnn._engine.serving import on_cpu, on_stream
from jfrnn._engine.start import INSTALL, WarpArray, kernels_of, load_warp
from jfrnn._engine.warp import Arrays, Variant, array_types, call_kernels, check_platform, missing, name_arrays, name_of_call
from jfrnn._geometry import Cutoff, make_cutoff

HashGrid = Any  # wp.HashGrid, whose type cannot be named before Warp is imported


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

            return functools.partial(call_kernels, "hashgrid", make, keep=options.filter, capacity=capacity)

        return lax.platform_dependent(search._replace(checks={}), cpu=on(False), cuda=on(True))

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool) -> int:
        """Return the scratch that the kernels are given, and what Warp allocates for the grid [B]."""
        check_platform(self.name, platform)
        if 0 in (n, m):
            return 0
        hashgrid = kernels_of("hashgrid")
        # warp/native/hashgrid.cpp: two ints per cell; of each point its cell and its id, room for 1.5 n, twice for the sort
        grid = 8 * math.prod(hashgrid.grid_shape(n, dim)) + 16 * (3 * n // 2)
        return 4 * hashgrid.scratch_words(n, m, dim, 2 if double else 1, own) + grid


@kernel
def _hashgrid_callable(variant: Variant, radius: float, cuda: bool) -> Kernel:
    """Return what searches on a platform; it knows its radius, and bears it in its name."""
    bounds = make_cutoff(radius, np.dtype(np.float64 if variant.double else np.float32), variant.closed)
    types, name = array_types(variant), name_of_call("hashgrid_cuda" if cuda else "hashgrid_cpu", variant)

    def run(*arrays: WarpArray) -> None:
        _run_hashgrid(bounds, variant, name_arrays(types, arrays))

    return (on_stream if cuda else on_cpu)(f"{name}_{radius.hex()}", run, types, 3 + variant.lists)


def _run_hashgrid(bounds: Cutoff, variant: Variant, arrays: Arrays) -> None:
    wp = load_warp()
    positions, queries, cutoff, idx, count, info, scratch = arrays
    n, device = positions.shape[0], count.device
    hashgrid = kernels_of("hashgrid")
    kernels = hashgrid.hashgrid_kernels(variant.dim, variant.double, variant.scaled, variant.lists)
    shape = hashgrid.grid_shape(n, variant.dim)
    packed = wp.array(ptr=scratch.ptr, shape=n, dtype=wp.vec3d if variant.double else wp.vec3f, device=device)
    if not device.is_cuda:
        load_on_cpu(kernels.pack.module)
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
