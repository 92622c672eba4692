"""The engine of Warp's fused kernels: what static options they are made of, what they are given, and which are launched.

Each combination of static options is a kernel of its own, named after them, so that the compiled program says all that it
depends on (JAX's persistent compilation cache sees no more than that).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from jfrnn._engine.arrays import levels_of
from jfrnn._engine.cores import PLACES_PER_THREAD, ask_for_huge_pages, on_every_core, on_one_core
from jfrnn._engine.cuda import Command, multiprocessors_of
from jfrnn._engine.launch import Kernel, kernel, open_relay
from jfrnn._engine.levels_warp import level_neighbors
from jfrnn._engine.operands import MOST_IN_BOX, pack_particles, periodic_kind, space_flags
from jfrnn._engine.problem import Filter, Kind, Options, Rows, Search
from jfrnn._engine.serving import on_cpu, on_cuda, stand_in
from jfrnn._engine.start import WarpArray, apart, kernels_of, load_warp
from jfrnn._geometry import Cutoffs

PLATFORMS = {"cpu": "cpu", "gpu": "cuda", "cuda": "cuda"}  # names in JAX, names in lax.platform_dependent

CellKernels = Any  # the kernels of a variant, of jfrnn.kernels


@dataclasses.dataclass(frozen=True)  # all are one
class WarpEngine:
    """Cells, met by compiled kernels, on the CPU and on CUDA."""

    name = "warp"
    static_radius = False
    translates = True
    by_cells = True

    def refuse(self, kind: Kind) -> str | None:
        """Refuse nothing."""
        return None

    def missing(self, platform: str) -> str | None:
        """Say what keeps Warp from running on a JAX platform."""
        return missing(platform)

    def rows(self, search: Search, options: Options, capacity: int | None) -> Rows:
        """Search among cells, or where cutoffs differ from particle to particle, among cells of many sizes."""
        if isinstance(search.cutoff, Cutoffs):
            return level_neighbors(search, levels_of(search), options.filter, capacity)

        def on(module: str, make: Callable[[Variant], Any]) -> Callable[[Search], Rows]:
            return functools.partial(call_kernels, module, make, keep=options.filter, capacity=capacity)

        cpu, cuda = on("cells_cpu", _cpu_callable), on("cells_cuda", _cuda_callable)
        return lax.platform_dependent(search._replace(checks={}), cpu=cpu, cuda=cuda)

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool) -> int:
        """Return the scratch that the kernels are given [B]."""
        check_platform(self.name, platform)
        module = kernels_of(f"cells_{PLATFORMS[platform]}")
        return 4 * module.scratch_words(n, m, dim, 2 if double else 1, own) if n and m else 0


class Variant(NamedTuple):
    """All that is static about an engine call, apart from shapes."""

    dim: int
    double: bool
    scaled: bool
    lists: bool
    own: bool
    closed: bool
    keep: Filter
    periodic: int = 0  # 1: nearest images, 2: images are told apart; two more where the lattice is skewed
    batched: bool = False


class Arrays(NamedTuple):
    """What a call gets from XLA, as `warp.array`s; without rows `idx` is None."""

    positions: WarpArray
    queries: WarpArray
    cutoff: WarpArray
    idx: WarpArray
    count: WarpArray
    info: WarpArray
    scratch: WarpArray


def missing(platform: str) -> str | None:
    """Say what keeps Warp from running on a JAX platform; None: nothing does."""
    try:
        warp = load_warp()
        if platform in PLATFORMS:
            apart(open_relay)
    except (ImportError, RuntimeError) as error:
        return str(error).rstrip(".")
    if platform == "cpu":
        return None if warp.is_cpu_available() else "this Warp was built without its CPU compiler"
    if platform in ("gpu", "cuda"):
        return None if warp.is_cuda_available() else "Warp found no CUDA driver"
    return f"Warp has no engine for the JAX platform {platform!r}"


def check_platform(name: str, platform: str) -> None:
    """Raise where Warp is not installed, or a platform is none of its own."""
    load_warp()
    if platform not in PLATFORMS:
        raise RuntimeError(f"backend={name!r} runs on the platforms {', '.join(map(repr, PLATFORMS))}, got {platform!r}.")


def call_kernels(module: str, make: Callable[[Variant], Any], search: Search, *, keep: Filter, capacity: int | None) -> Rows:
    """Let XLA call what `make` returns, with the scratch that the module of kernels asks for."""
    sources, queries, cutoff, batch, torus, _ = search
    own, lists = queries is None, capacity is not None
    (n, m), dim = search.sizes, sources.shape[1]
    double = sources.dtype == jnp.float64
    periodic = periodic_kind(torus)
    variant = Variant(dim, double, cutoff.scaled, lists, own, cutoff.closed, keep, periodic, batch is not None)
    if periodic in (1, 3) and n >= MOST_IN_BOX:
        raise ValueError(
            f"backend='warp' numbers at most {MOST_IN_BOX - 1} positions in a periodic box, got {n}: pass backend='jax'."
        )
    words = kernels_of(module).scratch_words(n, m, dim, 2 if double else 1, own)
    dims: dict[str, Any] = {"count": m, "info": 2, "scratch": max(words, 1)}
    if lists:
        dims["idx"] = (m, capacity)
    *idx, count, info, _ = make(variant)(*pack_particles(search), output_dims=dims)
    return Rows(idx[0] if lists else None, count, info[0], info[1])


@kernel
def _cpu_callable(variant: Variant) -> Kernel:
    types = array_types(variant)

    def run(*arrays: WarpArray) -> None:
        _run_cells_on_cpu(variant, name_arrays(types, arrays))

    return on_cpu(name_of_call("cells_cpu", variant), run, types, 3 + variant.lists)


@kernel
def _cuda_callable(variant: Variant) -> Kernel:
    wp = load_warp()
    if wp.is_cuda_available():
        _cuda_kernels(variant).load(wp.get_cuda_device())
    return on_cuda(
        name_of_call("cells_cuda", variant), array_types(variant), 3 + variant.lists, functools.partial(_commands, variant)
    )


def array_types(variant: Variant) -> dict[str, Any]:
    """Return Warp's types of what a call gets."""
    wp = load_warp()
    scalar = wp.float64 if variant.double else wp.float32
    points, ints = wp.array2d(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": points, "queries": points, "cutoff": wp.array(dtype=scalar)}
    types |= {"idx": wp.array2d(dtype=wp.int32)} if variant.lists else {}
    return types | {"count": ints, "info": ints, "scratch": ints}


def name_arrays(types: dict[str, Any], arrays: Sequence[WarpArray]) -> Arrays:
    """Return the arrays of a call by their names."""
    return Arrays(**{"idx": None, **dict(zip(types, arrays, strict=True))})


def name_of_call(name: str, variant: Variant) -> str:
    """Return the name of what XLA calls: of the kernels, and of all that is static."""
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "list": variant.lists}
    flags |= {**space_flags(variant.periodic), "batched": variant.batched}
    flags |= {"own": variant.own, "closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only}
    return "_".join(["jfrnn", name, f"{variant.dim}d", *(flag for flag, on in flags.items() if on)])


def _cuda_kernels(variant: Variant) -> CellKernels:
    make = kernels_of("cells_cuda").cell_kernels
    keep = variant.keep
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    return make(variant.dim, variant.double, variant.scaled, variant.lists, keep.later_only, **kind)


def _commands(variant: Variant, *buffers: WarpArray) -> list[Command]:
    arrays, sizes, capacity = _launchable(variant, name_arrays(array_types(variant), buffers))
    arguments = [*arrays, *sizes, capacity, int(variant.closed), int(variant.keep.drop_self)]
    launches = _cuda_kernels(variant).launches(*sizes[:2], variant.own, multiprocessors_of(arrays.positions))
    return [Command(x.kernel, [*arguments, int(x.of_queries)], x.threads, x.block, x.beside) for x in launches]


def _run_cells_on_cpu(variant: Variant, arrays: Arrays) -> None:
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    kernels = kernels_of("cells_cpu").cell_kernels(variant.dim, variant.double, variant.scaled, variant.lists, **kind)
    arrays, sizes, capacity = _launchable(variant, arrays)
    positions, queries, cutoff, idx, _, info, scratch = arrays
    sort_on_cpu(kernels, positions, queries, cutoff, info, scratch, sizes)
    ask_for_huge_pages(idx.ptr, 4 * len(queries) * capacity)
    flags = [int(variant.closed), int(variant.keep.drop_self), int(variant.keep.later_only)]
    arguments = [*arrays, *sizes, capacity, *flags]
    on_every_core(kernels.query, arguments, -(-len(queries) // PLACES_PER_THREAD))


def sort_on_cpu(
    kernels: CellKernels,
    positions: WarpArray,
    queries: WarpArray,
    cutoff: WarpArray,
    info: WarpArray,
    scratch: WarpArray,
    sizes: list[int],
) -> None:
    """Sort sources and queries by cell; several cores put the coordinates of many sources in order."""
    n = sizes[0]
    on_one_core(kernels.build, [positions, queries, cutoff, info, scratch, *sizes])
    if n >= kernels_of("cells_cpu").MANY:
        arguments = [positions, cutoff, scratch, *sizes]
        on_every_core(kernels.gather, arguments, -(-n // PLACES_PER_THREAD))


def cell_sizes(n: int, m: int, own: bool) -> list[int]:
    """Return n, m, own and the cells of the table, as all kernels of cells take them."""
    return [n, m, int(own), kernels_of("_native").table_cells(n)]


def _launchable(variant: Variant, arrays: Arrays) -> tuple[Arrays, list[int], int]:
    """Return the arrays, the sizes (`cell_sizes`) and the capacity, as the cell kernels take them; without rows it is 0."""
    n, m, count = arrays.positions.shape[0], arrays.queries.shape[0], arrays.count
    sizes = cell_sizes(n, m, variant.own)
    if arrays.idx is not None:
        return arrays, sizes, arrays.idx.shape[1]
    return arrays._replace(idx=stand_in(count, m)), sizes, 0
