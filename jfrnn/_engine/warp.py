"""Warp inside JAX: what its kernels are given, and how they are launched.

Each combination of static options is a kernel of its own, named after them, so that the compiled program says all that it
depends on (JAX's persistent compilation cache sees no more than that).
"""

import contextlib
import ctypes
import functools
import math
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.cuda import Command
from jfrnn._engine.cuda import serve as serve_on_cuda
from jfrnn._engine.ffi import CallFrame
from jfrnn._engine.launch import Kernel, kernel, open_relay
from jfrnn._engine.runs import Filter
from jfrnn._engine.start import INSTALL, apart, kernels_of, load_warp
from jfrnn._geometry import Batch, Cutoff, Lattice, Wrapped, compensated_sum, make_cutoff, rounded_sum

PLACES_PER_THREAD = 2048  # below, a second thread costs more than it saves
MOST_IN_BOX = 1 << 27  # an id shares its bits with the code of an image
_HUGE = 1 << 22  # bytes from which a buffer is worth a request for huge pages
PLATFORMS = {"cpu": "cpu", "gpu": "cuda", "cuda": "cuda"}  # names in JAX, names in lax.platform_dependent


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


class Rows(NamedTuple):
    """Neighbors of m queries: [m, capacity] int32 source indices, unused slots n (None: only counted), and [m] int32 true counts.

    `required` [] int32 is the longest row, `status` [] int32 the bits of `Status`.
    """

    idx: Array | None
    counts: Array
    required: Array
    status: Array


class _Arrays(NamedTuple):
    """What a call gets from XLA, as `warp.array`s; without rows `idx` is None."""

    positions: Any
    queries: Any
    cutoff: Any
    idx: Any
    count: Any
    info: Any
    scratch: Any


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


def neighbors(
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff,
    keep: Filter,
    capacity: int | None,
    batch: Batch | None = None,
    torus: tuple[Lattice, Wrapped] | None = None,
) -> Rows:
    """Search among cells with the Warp kernels; capacity=None only counts."""

    def on(module: str, make: Callable[[Variant], Any]) -> Callable[..., Rows]:
        def call(
            sources: Array,
            queries: Array | None,
            cutoff: Cutoff,
            batch: Batch | None,
            torus: tuple[Lattice, Wrapped] | None,
        ) -> Rows:
            return _call(module, make, sources, queries, cutoff, batch, torus, keep, capacity)

        return call

    cpu, cuda = on("cells_cpu", _cpu_callable), on("cells_cuda", _cuda_callable)
    return lax.platform_dependent(sources, queries, cutoff, batch, torus, cpu=cpu, cuda=cuda)


def periodic_kind(torus: tuple[Lattice, Wrapped] | None) -> int:
    """Return the PERIODIC of `jfrnn.kernels._native.snippet`."""
    if torus is None:
        return 0
    images = torus[0].images
    return (1 if images.nearest else 2) + (0 if images.orthogonal else 2)


def space_flags(periodic: int) -> dict[str, bool]:
    return {"nearest": periodic in (1, 3), "images": periodic in (2, 4), "skewed": periodic > 2}


def particle_rows(points: Array, turns: Array | None, systems: Array | None) -> Array:
    """Return rows of positions as the kernels read them: coordinates, packed turns, the number of the system."""
    columns, dim = [as_float(x, points.dtype) for x in (turns, systems) if x is not None], points.shape[1]
    rows = jnp.pad(points, ((0, 0), (0, len(columns))))
    for k, column in enumerate(columns):  # on a GPU, XLA takes twice as long to concatenate them
        rows = jnp.where(np.arange(rows.shape[1]) == dim + k, column[:, None], rows)
    return rows


def as_float(x: Array, dtype: np.dtype) -> Array:
    """Let values travel among floats: integers of the same width as their bits, what is smaller as a value."""
    if x.dtype == dtype:
        return x
    same_width = jnp.issubdtype(x.dtype, jnp.integer) and x.dtype.itemsize == dtype.itemsize
    return lax.bitcast_convert_type(x, dtype) if same_width else x.astype(dtype)


def as_integer(x: Array) -> Array:
    """Return int32 that traveled among floats."""
    return lax.bitcast_convert_type(x, jnp.int32) if x.dtype == jnp.float32 else x.astype(jnp.int32)


def lattice_numbers(lattice: Lattice, wrapped: Wrapped) -> Array:
    """Return what the kernels know of a lattice, in the order that `jfrnn.kernels._native` states."""
    more = 3 - lattice.dim
    square, line = ((0, more), (0, more)), (0, more)
    images = jnp.asarray(lattice.images.reach).astype(lattice.matrix.dtype)
    parts = [jnp.pad(lattice.matrix, square), jnp.pad(lattice.transform, square), jnp.pad(lattice.origin, line)]
    parts += [jnp.pad(wrapped.reach, line, constant_values=1), jnp.pad(images, line), wrapped.slack]
    if not lattice.images.orthogonal:
        parts += [jnp.pad(lattice.given, square), jnp.pad(lattice.images.numbers.astype(images.dtype), square)]
    return jnp.concatenate([part.reshape(-1) for part in parts])


def _call(
    module: str,
    make: Callable[[Variant], Any],
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff,
    batch: Batch | None,
    torus: tuple[Lattice, Wrapped] | None,
    keep: Filter,
    capacity: int | None,
) -> Rows:
    """Let XLA call what `make` returns, with the scratch that the module of kernels asks for."""
    own, lists = queries is None, capacity is not None
    (n, dim), m = sources.shape, (sources if queries is None else queries).shape[0]
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
    *idx, count, info, _ = make(variant)(*_packed(sources, queries, cutoff, batch, torus), output_dims=dims)
    return Rows(idx[0] if lists else None, count, info[0], info[1])


def _packed(
    sources: Array, queries: Array | None, cutoff: Cutoff, batch: Batch | None, torus: tuple[Lattice, Wrapped] | None
) -> tuple[Array, Array, Array]:
    """Return rows of positions, those of the queries, and the numbers that all share, as the kernels of cells read them."""
    numbers = [jnp.reshape(jnp.asarray(cutoff.radius), 1)]
    turns = query_turns = None
    if torus is not None:
        turns, query_turns = torus[1].turns, torus[1].query_turns
        numbers.append(lattice_numbers(*torus))
    if batch is not None:
        numbers.append(as_float(jnp.max(batch.of_all)[None], sources.dtype))
    sources = particle_rows(sources, turns, None if batch is None else batch.sources)
    rows = sources if queries is None else particle_rows(queries, query_turns, None if batch is None else batch.queries)
    return sources, rows, jnp.concatenate(numbers)


def scratch_bytes(engine: str, platform: str, n: int, m: int, dim: int, double: bool, own: bool) -> int:
    """Return what "warp" or "hashgrid" takes beside its list [B]: the scratch it is given, and what Warp allocates for itself."""
    load_warp()
    if platform not in PLATFORMS:
        raise RuntimeError(f"backend={engine!r} runs on the platforms {', '.join(map(repr, PLATFORMS))}, got {platform!r}.")
    if 0 in (n, m):
        return 0
    width = 2 if double else 1
    if engine == "warp":
        return 4 * kernels_of(f"cells_{PLATFORMS[platform]}").scratch_words(n, m, dim, width, own)
    hashgrid = kernels_of("hashgrid")
    # warp/native/hashgrid.cpp: two ints per cell; of each point its cell and its id, room for 1.5 n, twice for the sort
    grid = 8 * math.prod(hashgrid.grid_shape(n, dim)) + 16 * (3 * n // 2)
    return 4 * hashgrid.scratch_words(n, m, dim, width, own) + grid


# --- cells ------------------------------------------------------------------------------------------------------------


@kernel
def _cpu_callable(variant: Variant) -> Kernel:
    types = _types(variant)

    def run(*arrays: Any) -> None:  # noqa: ANN401
        _run_cells_on_cpu(variant, _named(types, arrays))

    return on_cpu(_name("cells_cpu", variant), run, types, 3 + variant.lists)


@kernel
def _cuda_callable(variant: Variant) -> Kernel:
    wp = load_warp()
    if wp.is_cuda_available():
        _cuda_kernels(variant).load(wp.get_cuda_device())
    return on_cuda(_name("cells_cuda", variant), _types(variant), 3 + variant.lists, functools.partial(_commands, variant))


def on_cuda(name: str, types: dict[str, Any], outputs: int, commands: Callable[..., list[Command]]) -> Kernel:
    """Return what runs commands on CUDA when XLA calls."""
    return Kernel(name, types, outputs, serve_on_cuda(load_warp(), [kind.dtype for kind in types.values()], commands))


_one_at_a_time = threading.Lock()  # is served: on the CPU it takes all cores, and a hash grid is kept for all


def on_cpu(name: str, run: Callable[..., None], types: dict[str, Any], outputs: int) -> Kernel:
    """Return what calls `run` with a `warp.array` for each buffer when XLA calls on the CPU."""
    wp, dtypes = load_warp(), [kind.dtype for kind in types.values()]

    def serve(frame: CallFrame) -> None:
        arrays = _arrays(wp, frame, dtypes, wp.get_device("cpu"))
        with _one_at_a_time:
            run(*arrays)

    return Kernel(name, types, outputs, serve)


def _on_stream(name: str, run: Callable[..., None], types: dict[str, Any], outputs: int) -> Kernel:
    """Return what calls `run` as `on_cpu` does, on CUDA, where it launches on the stream of the call."""
    wp, dtypes = load_warp(), [kind.dtype for kind in types.values()]
    streams: dict[int, Any] = {}  # Warp forgets one that is gone

    def serve(frame: CallFrame) -> None:
        device, address = wp.get_cuda_device(frame.device()), frame.stream()
        with _one_at_a_time:
            if address not in streams:
                streams[address] = wp.Stream(device, cuda_stream=address)
            with wp.ScopedStream(streams[address], sync_enter=False):
                run(*_arrays(wp, frame, dtypes, device))

    return Kernel(name, types, outputs, serve)


def _arrays(wp: Any, frame: CallFrame, dtypes: Sequence[Any], device: Any) -> list[Any]:  # noqa: ANN401
    buffers = zip(frame.buffers(), dtypes, strict=True)
    return [wp.array(ptr=x.data, shape=x.shape, dtype=dtype, device=device) for x, dtype in buffers]


def _types(variant: Variant) -> dict[str, Any]:
    """Return Warp's types of what a call gets."""
    wp = load_warp()
    scalar = wp.float64 if variant.double else wp.float32
    points, ints = wp.array2d(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": points, "queries": points, "cutoff": wp.array(dtype=scalar)}
    types |= {"idx": wp.array2d(dtype=wp.int32)} if variant.lists else {}
    return types | {"count": ints, "info": ints, "scratch": ints}


def _named(types: dict[str, Any], arrays: Sequence[Any]) -> _Arrays:
    return _Arrays(**{"idx": None, **dict(zip(types, arrays, strict=True))})


def _name(name: str, variant: Variant) -> str:
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "list": variant.lists}
    flags |= {**space_flags(variant.periodic), "batched": variant.batched}
    flags |= {"own": variant.own, "closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only}
    return "_".join(["jfrnn", name, f"{variant.dim}d", *(flag for flag, on in flags.items() if on)])


def _cuda_kernels(variant: Variant) -> Any:  # noqa: ANN401
    make = kernels_of("cells_cuda").cell_kernels
    keep = variant.keep
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    return make(variant.dim, variant.double, variant.scaled, variant.lists, keep.later_only, **kind)


def _commands(variant: Variant, *buffers: Any) -> list[Command]:  # noqa: ANN401
    arrays, sizes, capacity = _launchable(variant, _named(_types(variant), buffers))
    arguments = [*arrays, *sizes, capacity, int(variant.closed), int(variant.keep.drop_self)]
    launches = _cuda_kernels(variant).launches(*sizes[:2], variant.own)
    return [Command(x.kernel, [*arguments, int(x.of_queries)], x.threads, x.block, x.beside) for x in launches]


def _run_cells_on_cpu(variant: Variant, arrays: _Arrays) -> None:
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    kernels = kernels_of("cells_cpu").cell_kernels(variant.dim, variant.double, variant.scaled, variant.lists, **kind)
    arrays, sizes, capacity = _launchable(variant, arrays)
    positions, queries, cutoff, idx, _, info, scratch = arrays
    _sort_on_cpu(kernels, positions, queries, cutoff, info, scratch, sizes)
    ask_for_huge_pages(idx.ptr, 4 * len(queries) * capacity)
    flags = [int(variant.closed), int(variant.keep.drop_self), int(variant.keep.later_only)]
    arguments = [*arrays, *sizes, capacity, *flags]
    on_every_core(kernels.query, arguments, -(-len(queries) // PLACES_PER_THREAD))


def _sort_on_cpu(
    kernels: Any,  # noqa: ANN401
    positions: Any,  # noqa: ANN401
    queries: Any,  # noqa: ANN401
    cutoff: Any,  # noqa: ANN401
    info: Any,  # noqa: ANN401
    scratch: Any,  # noqa: ANN401
    sizes: list[int],
) -> None:
    n = sizes[0]
    on_one_core(kernels.build, [positions, queries, cutoff, info, scratch, *sizes])
    if n >= kernels_of("cells_cpu").MANY:
        arguments = [positions, cutoff, scratch, *sizes]
        on_every_core(kernels.gather, arguments, -(-n // PLACES_PER_THREAD))


def _launchable(variant: Variant, arrays: _Arrays) -> tuple[_Arrays, list[int], int]:
    """Return the arrays, the sizes n, m, own and cells of the table, and the capacity, as the cell kernels take them.

    Without rows, something of their kind that nobody writes to stands in their place, and the capacity is 0.
    """
    n, m, count = arrays.positions.shape[0], arrays.queries.shape[0], arrays.count
    sizes = [n, m, int(variant.own), kernels_of("_native").table_cells(n)]
    if arrays.idx is not None:
        return arrays, sizes, arrays.idx.shape[1]
    unused = load_warp().array(ptr=count.ptr, shape=(m, 1), dtype=count.dtype, device=count.device)
    return arrays._replace(idx=unused), sizes, 0


def on_one_core(kernel: Any, inputs: list[Any]) -> None:  # noqa: ANN401
    """Launch a kernel once on the CPU."""
    _load_on_cpu(kernel.module)
    load_warp().launch(kernel, dim=1, inputs=inputs, device="cpu")


def on_every_core(kernel: Any, inputs: list[Any], most: int) -> None:  # noqa: ANN401
    """Launch a kernel once per core, at most `most` times; a launch releases the interpreter's lock while it runs."""
    launch = functools.partial(on_one_core, kernel, inputs)
    if most <= 1:
        launch()
        return
    _load_on_cpu(kernel.module)
    others: list[Future[None]] = []
    try:
        with contextlib.suppress(RuntimeError):  # while the interpreter exits, nothing can be submitted: this core does the rest
            for _ in range(min(_cores(), most) - 1):
                others.append(_pool().submit(launch))
        launch()
    finally:  # they write to memory that XLA takes back when the call ends, however it ends
        wait(others)
    for other in others:
        other.result()


@functools.cache
def _load_on_cpu(module: Any) -> None:  # noqa: ANN401
    """Compile a module before several threads launch from it, and always in the same one: each has its own precompiled headers."""
    load = functools.partial(kernels_of("_load").load_module, module, "cpu")
    try:
        compiled = _compiler().submit(load)
    except RuntimeError:  # while the interpreter exits
        load()
    else:
        compiled.result()


@functools.cache
def _compiler() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="jfrnn-compiler")


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(_cores() - 1, 1), thread_name_prefix="jfrnn")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ask_for_huge_pages(address: int, size: int) -> None:
    """Let Linux back a large output with huge pages: its first touch then costs a few faults instead of one per 4 KiB."""
    if size < _HUGE or not sys.platform.startswith("linux"):
        return
    page = 4096
    start = -(-address // page) * page
    _libc().madvise(ctypes.c_void_p(start), ctypes.c_size_t((address + size - start) // page * page), 14)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)


# --- sums over pairs --------------------------------------------------------------------------------------------------


class SumsOf(NamedTuple):
    """The results of a kernel that sums a term: for each of `rows` queries, and over all pairs in `slots` parts."""

    term: Any
    rows: int
    slots: int
    compensated: bool
    extremes: bool

    def dims(self) -> dict[str, Any]:
        """Return the shapes of the arrays that the kernel writes."""
        return {
            "sums": (self.rows, max(self._width, 1)),
            "totals": max(2 * self.slots * self._totals, 1),
            "errors": max(self.rows * self._width * (2 * self.extremes + self.compensated), 1),
        }

    def unpacked(self, sums: Array, parts: Array, rest: Array) -> tuple[Array, Array, Array]:
        """Return what `pair_sums` returns: parts of sums over all pairs are added, with what rounding took of them."""
        width, totals = self._width, self._totals
        which = as_integer(rest).reshape(self.rows, width, 2) if self.extremes else jnp.zeros((self.rows, width, 0), jnp.int32)
        return sums, _added(parts[: 2 * self.slots * totals].reshape(self.slots, 2, totals)), which

    @property
    def _totals(self) -> int:
        return sum(part.total for part in self.term.sums)

    @property
    def _width(self) -> int:
        return len(self.term.sums) - self._totals


class _SumVariant(NamedTuple):
    """All that is static about a pair sum, apart from shapes; `key` names the text."""

    dim: int
    double: bool
    scaled: bool
    own: bool
    closed: bool
    drop_self: bool
    periodic: int
    batched: bool
    compensated: bool
    extremes: bool
    key: str
    cuda: bool


def pair_sums(
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff,
    keep: Filter,
    batch: Batch | None,
    torus: tuple[Lattice, Wrapped] | None,
    term: Any,  # noqa: ANN401
    key: str,
    values: tuple[Array, Array, Array],
    compensated: bool,
    extremes: bool = False,
) -> tuple[Array, Array, Array]:
    """Sum a term (`jfrnn.kernels.pair_sum_cpu.TermText`, named by its key) with the columns that it reads.

    Returns:
        The sums of each query [m, width]; the sums over all pairs [totals]; and for `extremes`, where sums are the largest
        summands, their sources and the codes of their images, int32 [m, width, 2].
    """

    def on(cuda: bool) -> Callable[..., tuple[Array, Array, Array]]:
        def call(
            sources: Array,
            queries: Array | None,
            cutoff: Cutoff,
            batch: Batch | None,
            torus: tuple[Lattice, Wrapped] | None,
            values: tuple[Array, Array, Array],
        ) -> tuple[Array, Array, Array]:
            flags = (queries is None, cutoff.closed, keep.drop_self, periodic_kind(torus), batch is not None)
            double, kind = sources.dtype == jnp.float64, (compensated, extremes, key, cuda)
            variant = _SumVariant(sources.shape[1], double, cutoff.scaled, *flags, *kind)
            return _call_sums(variant, term, _packed(sources, queries, cutoff, batch, torus), values)

        return call

    return lax.platform_dependent(sources, queries, cutoff, batch, torus, values, cpu=on(False), cuda=on(True))


def _call_sums(
    variant: _SumVariant,
    term: Any,  # noqa: ANN401
    particles: tuple[Array, Array, Array],
    values: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """Let XLA call the kernels."""
    n, m, engine = len(particles[0]), len(particles[1]), kernels_of(_module_of(variant))
    results = SumsOf(term, m, engine.slots(m), variant.compensated, variant.extremes)
    dims = results.dims()
    dims |= {"columns": max(engine.sorted_numbers(term, n, variant.dim, variant.double), 1)}
    cells = kernels_of(f"cells_{'cuda' if variant.cuda else 'cpu'}")
    of_search = {"info": 2, "scratch": cells.scratch_words(n, m, variant.dim, 2 if variant.double else 1, variant.own)}
    if (
        variant.cuda
    ):  # a call of its own sorts particles, which XLA leaves out where it was made before: for a sum and its derivative
        values = (*values, *_sorting_callable(_sorting(variant))(*particles, output_dims=of_search))
    else:
        dims |= of_search
    sums, parts, rest, *_ = _sum_callable(variant, term)(*particles, *values, output_dims=dims)
    return results.unpacked(sums, parts, rest)


def _added(parts: Array) -> Array:
    """Add parts [slots, 2, width], sums and their errors, in twice the precision."""
    zero = jnp.zeros((), parts.dtype)
    return rounded_sum(*lax.reduce((parts[:, 0], parts[:, 1]), (zero, zero), compensated_sum, (0,)))


def _module_of(variant: _SumVariant) -> str:
    return f"pair_sum_{'cuda' if variant.cuda else 'cpu'}"


@kernel
def _sum_callable(variant: _SumVariant, term: Any) -> Kernel:  # noqa: ANN401
    wp = load_warp()
    scalar = wp.float64 if variant.double else wp.float32
    rows, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": rows, "queries": rows, "cutoff": reals, "shared_values": reals, "own_values": rows, "others": rows}
    of_search, results = {"info": ints, "scratch": ints}, {"sums": rows, "totals": reals, "errors": reals, "columns": reals}
    name = _name_of_sum(_module_of(variant), variant)
    if not variant.cuda:
        return on_cpu(name, functools.partial(_run_sums_on_cpu, variant, term), types | results | of_search, 6)
    if wp.is_cuda_available():
        _sum_kernels_on_cuda(variant, term).load(wp.get_cuda_device())
    return on_cuda(name, types | of_search | results, 4, functools.partial(_sum_commands, variant, term))


def _name_of_sum(name: str, variant: _SumVariant) -> str:
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "own": variant.own}
    flags |= {"closed": variant.closed, "dropself": variant.drop_self, "batched": variant.batched}
    flags |= space_flags(variant.periodic)
    flags |= {"compensated": variant.compensated, "extremes": variant.extremes, variant.key: bool(variant.key)}
    return "_".join([f"jfrnn_{name}_{variant.dim}d", *(flag for flag, on in flags.items() if on)])


def _sorting(variant: _SumVariant) -> _SumVariant:
    """Return on what of a variant it depends how particles are sorted."""
    return variant._replace(closed=False, drop_self=False, compensated=False, extremes=False, key="")


@kernel
def _sorting_callable(variant: _SumVariant) -> Kernel:
    """Make a function that XLA calls to sort particles on CUDA: positions, queries and cutoff in; info and scratch out."""
    wp = load_warp()
    if wp.is_cuda_available():
        _stages_on_cuda(variant).load_stages(wp.get_cuda_device())
    scalar = wp.float64 if variant.double else wp.float32
    rows, ints = wp.array2d(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": rows, "queries": rows, "cutoff": wp.array(dtype=scalar), "info": ints, "scratch": ints}
    return on_cuda(_name_of_sum("sorting_cuda", variant), types, 2, functools.partial(_sorting_commands, variant))


def _stages_on_cuda(variant: _SumVariant) -> Any:  # noqa: ANN401
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    return kernels_of("cells_cuda").cell_kernels(variant.dim, variant.double, variant.scaled, False, **kind)


def _sorting_commands(variant: _SumVariant, *arrays: Any) -> list[Command]:  # noqa: ANN401
    positions, queries, cutoff, info, scratch = arrays
    n, m = positions.shape[0], queries.shape[0]
    # what sorts particles takes the arguments of a search that only counts
    unused = load_warp().array(ptr=info.ptr, shape=(1, 1), dtype=info.dtype, device=info.device)
    sizes = [n, m, int(variant.own), kernels_of("_native").table_cells(n)]
    arguments = [positions, queries, cutoff, unused, info, info, scratch, *sizes, 0, 0, 0]
    stages = _stages_on_cuda(variant).stages(n, m, variant.own)
    return [Command(x.kernel, [*arguments, int(x.of_queries)], x.threads, x.block) for x in stages]


@functools.cache
def _sum_kernels_on_cpu(variant: _SumVariant, term: Any) -> tuple[Any, Any, Any]:  # noqa: ANN401
    """Return the kernels that sort particles, sort values, and sum."""
    sums = kernels_of("pair_sum_cpu")
    dim, double, scaled = variant[:3]
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    cells = kernels_of("cells_cpu").cell_kernels(dim, double, scaled, False, **kind)
    query = sums.query_kernel(term, variant.key, dim, double, scaled, variant.compensated, **kind, extremes=variant.extremes)
    return cells, sums.sort_kernel(dim, double), query


def _run_sums_on_cpu(variant: _SumVariant, term: Any, *arrays: Any) -> None:  # noqa: ANN401
    cells, sort_values, query = _sum_kernels_on_cpu(variant, term)
    positions, queries, cutoff, shared, own, others, sums, totals, errors, columns, info, scratch = arrays
    n, m = positions.shape[0], queries.shape[0]
    sizes = [n, m, int(variant.own), kernels_of("_native").table_cells(n)]
    _sort_on_cpu(cells, positions, queries, cutoff, info, scratch, sizes)
    if term.source_columns:
        sorting = [others, cutoff, columns, scratch, *sizes]
        on_every_core(sort_values, sorting, -(-n // PLACES_PER_THREAD))
    arguments = [positions, queries, cutoff, shared, own, columns, sums, totals, errors, scratch, *sizes]
    arguments += [int(variant.closed), int(variant.drop_self)]
    on_every_core(query, arguments, -(-m // PLACES_PER_THREAD))


def _sum_kernels_on_cuda(variant: _SumVariant, term: Any) -> Any:  # noqa: ANN401
    dim, double, scaled = variant[:3]
    make = kernels_of("pair_sum_cuda").sum_kernels
    kind = {"periodic": variant.periodic, "batched": variant.batched, "extremes": variant.extremes}
    return make(term, variant.key, dim, double, scaled, variant.compensated, **kind)


def _sum_commands(variant: _SumVariant, term: Any, *arrays: Any) -> list[Command]:  # noqa: ANN401
    *given, info, scratch, sums, totals, errors, columns = arrays
    n, m = given[0].shape[0], given[1].shape[0]
    sizes = [n, m, int(variant.own), kernels_of("_native").table_cells(n)]
    arguments = [*given, sums, totals, errors, columns, info, scratch, *sizes, int(variant.closed), int(variant.drop_self)]
    launches = _sum_kernels_on_cuda(variant, term).launches(n, m)
    return [Command(x.kernel, arguments, x.threads, x.block, x.beside) for x in launches]


# --- hash grid --------------------------------------------------------------------------------------------------------


def hashgrid_neighbors(
    sources: Array, queries: Array | None, cutoff: Cutoff, radius: float, keep: Filter, capacity: int | None
) -> Rows:
    """Search with `wp.HashGrid`; capacity=None only counts. `radius` is the cutoff's, static: the grid is built from the host."""
    version = load_warp().__version__
    if tuple(map(int, version.split(".")[:2])) < (1, 19):
        raise ImportError(
            f"the backend 'hashgrid' needs warp-lang 1.19: the HashGrid of {version} can list a pair twice. {INSTALL}"
        )

    def on(cuda: bool) -> Callable[..., Rows]:
        def make(variant: Variant) -> Any:  # noqa: ANN401
            return _hashgrid_callable(variant, radius, cuda)

        def call(sources: Array, queries: Array | None, cutoff: Cutoff) -> Rows:
            return _call("hashgrid", make, sources, queries, cutoff, None, None, keep, capacity)

        return call

    return lax.platform_dependent(sources, queries, cutoff, cpu=on(False), cuda=on(True))


@kernel
def _hashgrid_callable(variant: Variant, radius: float, cuda: bool) -> Kernel:
    """Return what searches on a platform; it knows its radius, and bears it in its name."""
    bounds = make_cutoff(radius, np.dtype(np.float64 if variant.double else np.float32), variant.closed)
    types, name = _types(variant), _name("hashgrid_cuda" if cuda else "hashgrid_cpu", variant)

    def run(*arrays: Any) -> None:  # noqa: ANN401
        _run_hashgrid(bounds, variant, _named(types, arrays))

    return (_on_stream if cuda else on_cpu)(f"{name}_{radius.hex()}", run, types, 3 + variant.lists)


def _run_hashgrid(bounds: Cutoff, variant: Variant, arrays: _Arrays) -> None:
    wp = load_warp()
    positions, queries, cutoff, idx, count, info, scratch = arrays
    n, device = positions.shape[0], count.device
    hashgrid = kernels_of("hashgrid")
    kernels = hashgrid.hashgrid_kernels(variant.dim, variant.double, variant.scaled, variant.lists)
    shape = hashgrid.grid_shape(n, variant.dim)
    packed = wp.array(ptr=scratch.ptr, shape=n, dtype=wp.vec3d if variant.double else wp.vec3f, device=device)
    if not device.is_cuda:
        _load_on_cpu(kernels.pack.module)
    info.zero_()
    wp.launch(kernels.pack, dim=n, inputs=[positions, cutoff, wp.vec3i(*shape)], outputs=[packed, info], device=device)
    grid = _hash_grid(str(device), shape, variant.double)
    grid.build(packed, float(bounds.radius))
    scalars = [float(x) for x in (bounds.inside, bounds.outside, bounds.unit_scale)]
    flags = [int(x) for x in (variant.own, variant.closed, variant.keep.drop_self, variant.keep.later_only)]
    arguments = [grid.id, positions, queries, cutoff, *scalars, *flags]
    wp.launch(kernels.query, dim=queries.shape[0], inputs=arguments, outputs=[idx, count, info], device=device)


@functools.cache
def _hash_grid(device: str, shape: tuple[int, int, int], double: bool) -> Any:  # noqa: ANN401
    """Keep one grid per device and shape: launches on a device run one after the other."""
    wp = load_warp()
    return wp.HashGrid(*shape, device=device, dtype=wp.float64 if double else wp.float32)
