"""The engine of Warp's fused kernels: what static options they are made of, what they are given, and which are launched.

Each combination of static options is a kernel of its own, named after them, so that the compiled program says all that it
depends on (JAX's persistent compilation cache sees no more than that).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, TypeVar

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine.boxes_warp import box_neighbors
from jfrnn._engine.launch import Call, Shapes, kernel, open_native
from jfrnn._engine.operands import (
    MOST_IN_BOX,
    absent,
    cutoffs_of_particles,
    describe_call,
    excluded_rows,
    huge_pages,
    kind_of_search,
    names_of_particles,
    names_of_tree,
    orders_for_tree,
    pack_particles,
    periodic_kind,
    plan_numbers,
    row_dims,
    sort_on_cpu,
    split_rows,
)
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Engine, Features, Filter, Options, Room, Rows, Search, largest_radius
from jfrnn._engine.start import check_warp
from jfrnn._geometry import Cutoffs
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kernel, Kind, _driver, cells_cpu, cells_cuda, few_cuda, tree_cpu, tree_cuda

PLATFORMS = {"cpu": "cpu", "gpu": "cuda", "cuda": "cuda"}  # names in JAX, names of branches
_CELLS = {"cpu": cells_cpu, "cuda": cells_cuda}
_COPIED_FROM = {"cpu": 10_000, "cuda": few_cuda.MOST + 1}  # rows of flat lists: slower among 5000 on two cores, faster among 20 000
QUERIES_PER_THREAD = 1024  # on the CPU, at least: among 1000, to wake a second thread takes as long as it saves

# On CUDA, cutoffs that differ are searched in a tree if queries meet more sources than these within the largest cutoff: so many
# each, and so many more for each source that is near. SAMPLED queries and sources tell. The first two were measured on an H200 for
# a walker that trees have replaced, and that was slower: where a tree begins to be faster has not been measured.
MOST_MET, MOST_MORE, SAMPLED = 2000, 8, (1024, 4096)
OUTLYING = 3  # times the geometric mean of cutoffs: cells need not be as wide as few that are longer
Given = Callable[[Search], dict[str, Array]]  # makes what kernels are given besides, by its names
Found = TypeVar("Found")  # what a search or a sum returns


@dataclasses.dataclass(frozen=True)  # all are one
class WarpEngine:
    """Cells, met by compiled kernels, on the CPU and on CUDA."""

    name = "warp"
    static_radius = False
    translates = True
    native = True
    by_cells = True

    def refuse(self, asked: Features) -> str | None:
        """Refuse nothing."""
        return None

    def missing(self, platform: str) -> str | None:
        """Say what keeps Warp from running on a JAX platform."""
        return missing(platform)

    def rows(self, search: Search, options: Options, capacity: int | Room | None) -> Rows:
        """Search among cells, or in a tree: where cutoffs differ on the CPU, where they differ widely on CUDA."""
        if search.per_system:
            return box_neighbors(search._replace(checks={}), options.filter, capacity)
        if isinstance(search.cutoff, Cutoffs):
            return self._rows_of_cutoffs(search._replace(checks={}), options.filter, capacity)

        def on(module: ModuleType, make: Callable[[Kind], Any]) -> Callable[[Search], Rows]:
            order = functools.partial(_order_in, module, search) if options.ordered and isinstance(capacity, int) else None
            return functools.partial(call_kernels, module.scratch_words, make, keep=options.filter, capacity=capacity, order=order)

        few = are_few(search)
        cpu, cuda = on(cells_cpu, _cpu_callable), on(few_cuda, _few_callable) if few else on(cells_cuda, _cuda_callable)
        return on_platform(search._replace(checks={}), cpu=cpu, cuda=cuda)

    def _rows_of_cutoffs(self, search: Search, keep: Filter, capacity: int | Room | None) -> Rows:
        starts = (capacity.starts,) if isinstance(capacity, Room) else ()

        def by(make: Callable[[Kind], Any], module: ModuleType, given: Given | None = None) -> Callable[..., Rows]:
            def call(search: Search, *starts: Array) -> Rows:
                room = capacity._replace(starts=starts[0]) if isinstance(capacity, Room) else capacity
                return call_kernels(module.scratch_words, make, search, keep=keep, capacity=room, given=given)

            return call

        cuda = functools.partial(by_cells_or_tree, by(_cuda_callable, cells_cuda), by(_tree_on_cuda, tree_cuda, orders_for_tree))
        return on_platform(search, *starts, late=True, cpu=by(_tree_callable, tree_cpu), cuda=cuda)

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool, scaled: bool) -> int:
        """Return the scratch that the kernels are given [B]."""
        check_platform(self.name, platform)
        cells = _CELLS[PLATFORMS[platform]]
        if 0 in (n, m) or (cells is cells_cuda and all_meet((n, m), scaled)):
            return 0
        return 4 * cells.scratch_words(n, m, dim, 2 if double else 1, own)


def has_order(engine: Engine, platform: str, n: int, plain: bool) -> bool:
    """Say whether lists keep the order in which n sources follow each other in space, by which kernels of CUDA take rows.

    `plain`: without queries, and with one cutoff.
    """
    return engine.native and PLATFORMS.get(platform) == "cuda" and n > few_cuda.MOST and plain


def copies_rows(engine: Engine, platform: str, queries: int) -> bool:
    """Say whether rows of a common length are written and copied sooner than those of a flat list are counted and written."""
    branch = PLATFORMS.get(platform)
    return engine.native and branch is not None and queries >= _COPIED_FROM[branch]


def by_cells_or_tree(cells: Callable[..., Found], tree: Callable[..., Found], search: Search, *more: tuple[Array, ...]) -> Found:
    """Search on CUDA by cells as wide as the largest cutoff if cutoffs are alike, but for few, else in a tree."""
    long = kind_of_search(search, Filter(drop_self=False, later_only=False)).long
    of_cells = search._replace(cutoff=cutoffs_of_most(search)) if long else search

    def by_cells(search: Search, largest: Array, longer: Array | None, *more: tuple[Array, ...]) -> Found:
        return cells(search._replace(cutoff=dataclasses.replace(search.cutoffs, largest=largest, longer=longer)), *more)

    def by_tree(search: Search, largest: Array, longer: Array | None, *more: tuple[Array, ...]) -> Found:
        return tree(search, *more)

    cutoffs = of_cells.cutoffs
    if cutoffs.alike and (kinds := cutoffs.kinds) is not None and len(kinds[0]) <= cells_cuda.MOST_KINDS:
        return by_cells(search, cutoffs.largest, cutoffs.longer, *more)
    return lax.cond(cutoffs_are_alike(of_cells), by_cells, by_tree, search, cutoffs.largest, cutoffs.longer, *more)


def cutoffs_of_most(search: Search) -> Cutoffs:
    """Return the cutoffs with the largest one that is no outlier, if at most so many are that cells can serve these.

    An outlier is OUTLYING times as long as the geometric mean of a sample, in which few outliers do not count for much.
    """
    cutoffs, radii = search.cutoffs, search.cutoffs.queries
    assert radii is not None
    sample = radii[:: -(-len(radii) // SAMPLED[0])]
    most = OUTLYING * jnp.exp(jnp.mean(jnp.log(sample)))
    longer = jnp.sum(radii > most, dtype=jnp.int32)
    largest = jnp.max(jnp.where(radii > most, 0, radii), initial=0)
    few = (longer <= cells_cuda.MOST_LONG) & (largest > 0)
    largest, longer = jnp.where(few, largest, cutoffs.largest), jnp.where(few, longer, 0)
    return dataclasses.replace(cutoffs, largest=largest, longer=longer)


def cutoffs_are_alike(search: Search) -> Array:
    """Say whether the largest cutoff is not much longer than the others are where most particles are, as far as a sample tells."""
    cutoffs, (n, m), dim = search.cutoffs, search.sizes, search.sources.shape[1]
    of_queries, of_sources = (slice(None, None, -(-size // most)) for size, most in zip((m, n), SAMPLED, strict=True))
    sources = search.sources[of_sources]
    queries = (search.sources if search.queries is None else search.queries)[of_queries]
    if cutoffs.kinds is not None and len(cutoffs.kinds[0]) > cells_cuda.MOST_KINDS:
        return jnp.asarray(False)
    if 0 in (len(sources), len(queries)):
        return jnp.asarray(True)
    met = jnp.sum(((queries[:, None] - sources) / cutoffs.largest) ** 2, axis=-1) <= 1
    if search.batch is not None:
        met &= search.batch.of_queries[of_queries][:, None] == search.batch.sources[of_sources]
    if cutoffs.queries is None:
        radii = None if cutoffs.sources is None else cutoffs.sources[of_sources]
    else:
        radii = cutoffs.queries[of_queries][:, None]
    volumes = (cutoffs.largest if radii is None else jnp.minimum(radii, cutoffs.largest)) / cutoffs.largest
    each = n / len(sources) / len(queries)
    found = jnp.sum(jnp.where(met, 1 - MOST_MORE * volumes**dim, 0))
    return (found * each <= MOST_MET) & (cutoffs.largest > 0)


def _order_in(module: ModuleType, search: Search, scratch: Array) -> Array:
    """Return the order of the sources from the scratch of a search, or -1 where most are near the one before them.

    Rows of such sources share more than those of a cell do, and take no order. That of a CPU is not asked for.
    """
    sources, n = search.sources, search.sizes[0]
    if module is not cells_cuda:
        return jnp.full(n, -1, jnp.int32)
    first, words, word = cells_cuda.place_words(2 if sources.dtype == jnp.float64 else 1)
    found = scratch[first : first + words * n].reshape(n, words)[:, word]
    steps = jnp.abs(sources[1:] - sources[:-1]) <= largest_radius(search.cutoff)
    near = jnp.sum(functools.reduce(jnp.logical_and, steps.T), dtype=jnp.int32)
    return jnp.where(near > n // 2, -1, found)


def are_few(search: Search) -> bool:
    """Say whether particles are so few that on CUDA all of them meet, in one launch."""
    return periodic_kind(search.lattice) <= 1 and all_meet(search.sizes, search.cutoff.scaled)


def all_meet(sizes: tuple[int, int], scaled: bool) -> bool:
    """Say whether on CUDA all sources and queries meet, of so many."""
    return not scaled and max(sizes) <= few_cuda.MOST


def missing(platform: str) -> str | None:
    """Say what keeps Warp from running on a JAX platform; None: nothing does."""
    try:
        check_warp()
        if platform in PLATFORMS:
            open_native()
        if platform in ("gpu", "cuda"):
            return None if _driver.device_count() else "there is no CUDA device"
    except (ImportError, RuntimeError) as error:
        return str(error).rstrip(".")
    if platform == "cpu":
        return None
    return f"Warp has no engine for the JAX platform {platform!r}"


def check_platform(name: str, platform: str) -> None:
    """Raise where Warp is not installed, or a platform is none of its own."""
    check_warp()
    if platform not in PLATFORMS:
        raise RuntimeError(f"backend={name!r} runs on the platforms {', '.join(map(repr, PLATFORMS))}, got {platform!r}.")


def call_kernels(
    scratch_words: Callable[..., int],
    make: Callable[[Kind], Any],
    search: Search,
    *,
    keep: Filter,
    capacity: int | Room | None,
    order: Callable[[Array], Array] | None = None,
    given: Given | None = None,
) -> Rows:
    """Let XLA call what `make` returns, with the scratch that its kernels ask for.

    `order` finds the order of the sources in that scratch, `given` what kernels are given besides.
    """
    kind, (n, m) = kind_of_search(search, keep, capacity), search.sizes
    of_particles = cutoffs_of_particles(search.cutoff) if isinstance(search.cutoff, Cutoffs) else {}
    if kind.periodic in (1, 3) and n >= MOST_IN_BOX:
        raise ValueError(
            f"backend='warp' numbers at most {MOST_IN_BOX - 1} positions in a periodic box, got {n}: pass backend='jax'."
        )
    words = scratch_words(n, m, kind.dim, 2 if kind.double else 1, kind.own)
    dims = {**row_dims(m, capacity), "count": m, "longest": (), "bits": (), "scratch": max(words, 1)}
    more = {} if given is None else given(search)
    operands = [*pack_particles(search), *excluded_rows(search), *of_particles.values(), *more.values()]
    if isinstance(capacity, Room):
        operands.append(capacity.starts)
    *written, count, longest, bits, scratch = make(kind)(*operands, output_dims=dims)
    order_found = None if order is None else order(scratch)
    return Rows(**split_rows(written), counts=count, required=longest, status=bits, order=order_found)


@kernel
def _cpu_callable(kind: Kind) -> Call:
    return describe_call("cells_cpu", kind, functools.partial(_plan_on_cpu, kind))


@kernel
def _tree_callable(kind: Kind) -> Call:
    return describe_call("tree_cpu", kind, functools.partial(_plan_on_cpu, kind), cutoffs=names_of_particles)


@kernel
def _cuda_callable(kind: Kind) -> Call:
    return describe_call("cells_cuda", kind, functools.partial(plan_on_cuda, kind), cutoffs=names_of_particles)


@kernel
def _tree_on_cuda(kind: Kind) -> Call:
    return describe_call("tree_cuda", kind, functools.partial(_plan_tree_on_cuda, kind), cutoffs=names_of_tree)


@kernel
def _few_callable(kind: Kind) -> Call:
    return describe_call("few_cuda", kind, functools.partial(plan_few, kind))


def plan_on_cuda(kind: Kind, shapes: Shapes, multiprocessors: int) -> Plan:
    """Return what is launched for a search among cells."""
    numbers = plan_numbers(kind, shapes)
    m = numbers["m"]
    kernels = cells_cuda.cell_kernels(kind, cells_cuda.lanes_of_query(m), cells_cuda.has_parts(m, kind.own))
    launches = kernels.launches(numbers["n"], m, kind.own, multiprocessors)
    return Plan(place_launches(launches), numbers, absent(kind))


def _plan_tree_on_cuda(kind: Kind, shapes: Shapes, _: int) -> Plan:
    numbers = plan_numbers(kind, shapes)
    query = tree_cuda.query_kernel(kind, cells_cuda.lanes_of_query(numbers["m"]))
    walk = Launch(query, tree_cuda.walk_threads(numbers["m"]), {"of_queries": 0})
    return Plan([Clear("longest", 4), *fit_tree(tree_cuda.fit_kernel(kind), numbers), walk], numbers, absent(kind))


def fit_tree(fit: Kernel, numbers: Mapping[str, int]) -> list[Clear | Launch]:
    """Return what fits a tree on CUDA to the sources, level by level, of numbers of a plan."""
    threads = tree_cuda.fit_threads(numbers["n"], numbers["m"], bool(numbers["own"]))
    clear = [Clear("bits", 4), Clear("scratch", tree_cuda.HEADER_BYTES)]
    return [*clear, *(Launch(fit, each, {"level": level}) for level, each in enumerate(threads))]


def plan_few(kind: Kind, shapes: Shapes, _: int) -> Plan:
    """Return what is launched for a search in which all particles meet."""
    numbers = plan_numbers(kind, shapes)
    numbers["drop_self"] &= kind.own
    query = few_cuda.rows_kernel(kind, few_cuda.warps(numbers["m"]))
    return Plan([Clear("longest", 4), Clear("bits", 4), Launch(query, few_cuda.threads(numbers["m"]))], numbers, absent(kind))


def place_launches(launches: Sequence[cells_cuda.Launch]) -> list[Launch]:
    """Return launches of kernels of cells, each told whether it works on the queries."""
    return [Launch(x.kernel, x.threads, {"of_queries": int(x.of_queries)}, x.beside) for x in launches]


def _plan_on_cpu(kind: Kind, shapes: Shapes, _: int) -> Plan:
    """Return what is launched on the CPU: among cells or, where cutoffs differ, in a tree."""
    numbers, query = plan_numbers(kind, shapes), (tree_cpu if kind.rule else cells_cpu).query_kernel(kind)
    steps = [*sort_on_cpu(kind, shapes, numbers), *huge_pages(kind, shapes), share(query, numbers["m"], QUERIES_PER_THREAD)]
    return Plan(steps, numbers, absent(kind))
