"""The engine of `wp.HashGrid`, as Warp ships it: the reference that the fused kernels are compared with."""

import ctypes
import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import absent, describe_call, huge_pages, plan_numbers
from jfrnn._engine.plans import Clear, Kept, Launch, Plan
from jfrnn._engine.problem import Features, Options, Room, Rows, Search
from jfrnn._engine.start import INSTALL, load_warp
from jfrnn._engine.warp import call_kernels, check_platform, missing
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kind, _clang, hashgrid

HashGrid = Any  # the type of Warp, which cannot be named before it is imported


@dataclasses.dataclass(frozen=True)  # all are one
class HashGridEngine:
    """`wp.HashGrid`, on the CPU and on CUDA. The grid is built from the host, which has to know the cutoff."""

    name = "hashgrid"
    static_radius = True
    translates = False
    native = False
    by_cells = True

    def refuse(self, asked: Features) -> str | None:
        """Refuse what `wp.HashGrid` has no way to say."""
        if asked.summed:
            return "cannot sum over pairs: pass 'warp', 'jax', 'brute' or 'auto'."
        if asked.excluding:
            return "cannot exclude pairs: pass backend='warp', 'jax' or 'brute'."
        if asked.radii:
            return "takes one cutoff for all particles: pass backend='warp', 'jax' or 'brute'."
        if asked.batch:
            return "knows one system at a time: pass backend='warp', 'jax' or 'brute'."
        return "knows no periodic box: pass backend='warp', 'jax' or 'brute'." if asked.periodic else None

    def missing(self, platform: str) -> str | None:
        """Say what keeps Warp from running on a JAX platform, or its hash grid from being right."""
        if reason := missing(platform):
            return reason
        version = _clang.warp_version()
        outdated = tuple(map(int, version.split(".")[:2])) < (1, 19)
        return f"the HashGrid of warp-lang {version} can list a pair twice: {INSTALL}" if outdated else None

    def rows(self, search: Search, options: Options, capacity: int | Room | None) -> Rows:
        """Search with a hash grid of the cutoff."""
        radius = options.radius
        if radius is None:
            raise TypeError("the backend 'hashgrid' needs a cutoff that is known while tracing.")

        def on(cuda: bool) -> Callable[[Search], Rows]:
            def make(kind: Kind) -> Callable[..., Any]:
                return _hashgrid_callable(kind, radius, cuda)

            return functools.partial(call_kernels, hashgrid.scratch_words, make, keep=options.filter, capacity=capacity)

        return on_platform(search._replace(checks={}), cpu=on(False), cuda=on(True))

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool, scaled: bool) -> int:
        """Return the scratch that the kernels are given, and what Warp allocates for the grid [B]."""
        check_platform(self.name, platform)
        if 0 in (n, m):
            return 0
        # warp/native/hashgrid.cpp: two ints per cell; of each point its cell and its id, room for 1.5 n, twice for the sort
        grid = 8 * math.prod(hashgrid.grid_shape(n, dim)) + 16 * (3 * n // 2)
        return 4 * hashgrid.scratch_words(n, m, dim, 2 if double else 1, own) + grid


@kernel
def _hashgrid_callable(kind: Kind, radius: float, cuda: bool) -> Call:
    """Return what searches on a platform; it knows its radius, and bears it in its name."""

    def plan(shapes: Shapes, _: int) -> Plan:
        numbers = plan_numbers(kind, shapes) | hashgrid.split_width(radius)
        numbers["drop_self"] &= kind.own
        n, m = numbers["n"], numbers["m"]
        grid = hashgrid.grid_shape(n, kind.dim)
        numbers["cells_x"], numbers["cells_y"], _ = grid
        kernels = hashgrid.search_kernels(kind, cuda)
        rows = [] if cuda else huge_pages(kind, shapes)
        pack, query = Launch(kernels.pack, n if cuda else 1), Launch(kernels.query, m if cuda else 1)
        steps = [Clear("longest", 4), Clear("bits", 4), pack, Launch(hashgrid.build_kernel(kind.double)), *rows, query]
        return Plan(steps, numbers, absent(kind), functools.partial(_keep_grid, grid, kind.double, n))

    found = describe_call("hashgrid_cuda" if cuda else "hashgrid_cpu", kind, plan)
    return found._replace(name=f"{found.name}_{radius.hex()}")


def _keep_grid(shape: tuple[int, int, int], double: bool, points: int, device: int) -> Kept:
    """Return where the grid is, and the functions of Warp by which it is built, for a number of points."""
    wp = load_warp()
    grid, core = _hash_grid(shape, double, device), wp._src.context.runtime.core
    array = wp._src.types.array_t(ndim=1, shape=(points,), strides=(24 if double else 12,))
    functions = {"update": core.wp_hash_grid_update_host if device < 0 else core.wp_hash_grid_update_device}
    functions |= {"get_stream": core.wp_cuda_context_get_stream, "set_stream": core.wp_cuda_context_set_stream}
    addresses = {name: ctypes.cast(function, ctypes.c_void_p).value or 0 for name, function in functions.items()}
    addresses |= {"grid": grid.id, "points": ctypes.addressof(array), "context": 0 if device < 0 else grid.device.context}
    return Kept(addresses, (grid, array))


@functools.cache
def _hash_grid(shape: tuple[int, int, int], double: bool, device: int) -> HashGrid:
    """Keep one grid per device, shape and dtype: calls take turns."""
    wp, name = load_warp(), "cpu" if device < 0 else f"cuda:{device}"
    made = wp.HashGrid(*shape, device=name, dtype=wp.float64 if double else wp.float32)
    if device >= 0:
        wp.synchronize_device(name)  # calls work on other streams than the one on which it was made
    return made
