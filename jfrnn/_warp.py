"""Warp inside JAX: the one module that imports Warp, registers its kernels with XLA and launches them.

Each combination of static options is a callable of its own, named after them, so that the compiled program says all that it
depends on (JAX's persistent compilation cache sees no more than that name).
"""

import ctypes
import functools
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jfrnn._exact import Cutoff
from jfrnn._runs import Filter

if TYPE_CHECKING:
    import warp

INSTALL = 'pip install "jfrnn[warp]"'
_PLACES_PER_THREAD = 2048  # below, a second thread costs more than it saves
_HUGE = 1 << 22  # bytes from which a buffer is worth a request for huge pages


class Variant(NamedTuple):
    """All that is static about an engine call, apart from shapes."""

    dim: int
    double: bool
    scaled: bool
    lists: bool
    own: bool
    closed: bool
    keep: Filter


class Result(NamedTuple):
    """What an engine returns: rows (None where only counted), counts, the longest row and the bits of `Status`."""

    idx: Array | None
    count: Array
    required: Array
    status: Array


@functools.cache
def load_warp() -> Any:  # noqa: ANN401
    """Import Warp, quietly if nobody did before, or say what to install."""
    fresh = "warp" not in sys.modules
    try:
        import warp
    except ImportError as error:
        raise ImportError(f"the backends 'warp' and 'hashgrid' need the package warp-lang (1.18 or 1.19): {INSTALL}") from error
    if fresh:
        warp.config.log_level = warp.LOG_WARNING
    if not hasattr(warp, "jax_callable"):
        raise ImportError(f"the backends 'warp' and 'hashgrid' need warp-lang 1.18 or 1.19, found {warp.__version__}: {INSTALL}")
    return warp


def missing(platform: str) -> str | None:
    """Say what keeps Warp from running on a JAX platform; None: nothing does."""
    try:
        warp = load_warp()
    except ImportError as error:
        return str(error)
    warp.init()
    if platform == "cpu":
        return None if warp.is_cpu_available() else "this Warp was built without its CPU compiler"
    if platform in ("gpu", "cuda"):
        return None if warp.is_cuda_available() else "Warp found no CUDA driver"
    return f"Warp has no engine for the JAX platform {platform!r}"


def neighbors(sources: Array, queries: Array | None, cutoff: Cutoff, keep: Filter, capacity: int | None) -> Result:
    """Search among cells with the Warp kernels; capacity=None only counts."""
    return _call(_cells_callable, sources, queries, cutoff, keep, capacity, _scratch_words)


def _call(
    make: Callable[[Variant], Any],
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff,
    keep: Filter,
    capacity: int | None,
    scratch_words: Callable[..., int],
) -> Result:
    own, lists = queries is None, capacity is not None
    rows = sources if queries is None else queries
    (n, dim), m = sources.shape, rows.shape[0]
    double = sources.dtype == jnp.float64
    variant = Variant(dim, double, cutoff.scaled, lists, own, cutoff.closed, keep)
    words = scratch_words(n, m, dim, 2 if double else 1, own)
    dims: dict[str, Any] = {"count": m, "info": 2, "scratch": max(words, 1)}
    if lists:
        dims["idx"] = (m, capacity)
    radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)
    *idx, count, info, _ = make(variant)(sources, rows, radius, output_dims=dims)
    return Result(idx[0] if lists else None, count, info[0], info[1])


def _scratch_words(n: int, m: int, dim: int, width: int, own: bool) -> int:
    load_warp()
    from jfrnn.kernels import cells_cpu

    return cells_cpu.scratch_words(n, m, dim, width, own)


# --- cells ------------------------------------------------------------------------------------------------------------


@functools.cache
def _cells_callable(variant: Variant) -> Any:  # noqa: ANN401
    return _register("cells", variant, _run_cells)


def _register(name: str, variant: Variant, run: Callable[..., None]) -> Any:  # noqa: ANN401
    """Make a function that XLA calls: positions, queries and cutoff in; [rows,] counts, info and scratch out."""
    wp = load_warp()
    scalar = wp.float64 if variant.double else wp.float32
    points, reals = wp.array2d(dtype=scalar), wp.array(dtype=scalar)
    ints, rows = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def list_rows(positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints) -> None:
        run(variant, positions, queries, cutoff, idx, count, info, scratch)

    def count_rows(positions: points, queries: points, cutoff: reals, count: ints, info: ints, scratch: ints) -> None:
        run(variant, positions, queries, cutoff, None, count, info, scratch)

    func = list_rows if variant.lists else count_rows
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "list": variant.lists}
    flags |= {"own": variant.own, "closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only}
    func.__name__ = "_".join(["jfrnn", name, f"{variant.dim}d", *(flag for flag, on in flags.items() if on)])
    func.__qualname__ = func.__name__
    return wp.jax_callable(func, num_outputs=4 if variant.lists else 3, vmap_method="sequential")


def _run_cells(
    variant: Variant,
    positions: "warp.array",
    queries: "warp.array",
    cutoff: "warp.array",
    idx: "warp.array | None",
    count: "warp.array",
    info: "warp.array",
    scratch: "warp.array",
) -> None:
    from jfrnn.kernels import cells_cpu
    from jfrnn.kernels._native import table_cells

    wp = load_warp()
    kernels = cells_cpu.cell_kernels(variant.dim, variant.double, variant.scaled, variant.lists)
    n, m = positions.shape[0], queries.shape[0]
    sizes = [n, m, int(variant.own), table_cells(n)]
    wp.launch(kernels.build, dim=1, inputs=[positions, queries, cutoff, info, scratch, *sizes], device="cpu")
    if idx is None:
        idx, capacity = wp.array(ptr=count.ptr, shape=(0, 0), dtype=wp.int32, device="cpu"), 0
    else:
        capacity = idx.shape[1]
        _ask_for_huge_pages(idx.ptr, 4 * m * capacity)
    flags = [int(variant.closed), int(variant.keep.drop_self), int(variant.keep.later_only)]
    arguments = [positions, queries, cutoff, idx, count, info, scratch, *sizes, capacity, *flags]
    _on_every_core(lambda: wp.launch(kernels.query, dim=1, inputs=arguments, device="cpu"), -(-m // _PLACES_PER_THREAD))


def _on_every_core(launch: Callable[[], None], most: int) -> None:
    """Launch once per core, at most `most` times; a launch releases the interpreter's lock while it runs."""
    others: list[Future[None]] = [_pool().submit(launch) for _ in range(min(_cores(), most) - 1)]
    launch()
    wait(others)
    for other in others:
        other.result()


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(_cores() - 1, 1), thread_name_prefix="jfrnn")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _ask_for_huge_pages(address: int, size: int) -> None:
    """Let Linux back a large output with huge pages: its first touch then costs a few faults instead of one per 4 KiB."""
    if size < _HUGE or not sys.platform.startswith("linux"):
        return
    page = 4096
    start = -(-address // page) * page
    _libc().madvise(ctypes.c_void_p(start), ctypes.c_size_t((address + size - start) // page * page), 14)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)
