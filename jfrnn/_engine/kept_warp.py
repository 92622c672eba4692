"""Lists that are kept, by Warp's kernels: which slots hold a pair at present positions, how far apart, and sums over the pairs."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import lattice_numbers, periodic_kind, scalar_of, side_by_side
from jfrnn._engine.plans import Clear, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.sum_results import FoundSums, Summed, SumsOf
from jfrnn._geometry import EXCHANGED, LARGEST_TURN, Cutoff, Cutoffs, Lattice
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kernel, Kind, kept
from jfrnn.kernels.kept import ListKind
from jfrnn.kernels.pair_sum_cpu import TermText

# what a call is given
_LIST = ("rows", "points", "cutoff", "steps", "idx", "count", "codes", "slots", "starts", "lengths", "order", "systems")


class KeptList(NamedTuple):
    """A list at present positions; a pytree.

    Attributes:
        idx: [m, capacity] int32 sources.
        counts: [m] int32 true counts.
        codes: Image codes [m, capacity], or None.
        sources: Positions [n, d].
        rows: Positions of the rows [m, d]; None: they are the sources.
        turns: Lattice vectors between the cell and the sources and the rows, in whole floats [n, d] and [m, d], with codes.
        cutoff: One for all, or one per particle.
        lattice: The box, or one per system, or None.
        order: In which order CUDA takes rows that belong to the sources [n] (-1: as they come), or None.
        reversal: Slots by source, where they begin, and how many: the sums are then those of the sources, over the rows that list
            them. Or None.
        systems: With a box per system, whose boxes those of the sources [n] and of the rows [m] are, or None.
        numbers: What `numbers_of_pairs` returns of the box, if that is known, or None.
    """

    idx: Array
    counts: Array
    codes: Array | None
    sources: Array
    rows: Array | None
    turns: tuple[Array, Array] | None
    cutoff: Cutoff | Cutoffs
    lattice: Lattice | None
    order: Array | None
    reversal: tuple[Array, Array, Array] | None
    systems: tuple[Array, Array] | None = None
    numbers: Array | None = None

    @property
    def ends(self) -> tuple[Array, Array]:
        """Positions of the sources and of the rows."""
        return self.sources, self.sources if self.rows is None else self.rows


def kept_mask(given: KeptList) -> Array:
    """Say which slots hold a pair that is closer than the cutoff, exactly: [m, capacity] bool."""

    def on(cuda: bool) -> Callable[[KeptList], Array]:
        return lambda given: _measure(given, cuda, False)["mask"]

    return on_platform(given, cpu=on(False), cuda=on(True))


def kept_distances(given: KeptList) -> tuple[Array, Array]:
    """Return the distances of the pairs that are closer than the cutoff, exactly, [m, capacity], 0 in other slots; and the mask."""

    def on(cuda: bool) -> Callable[[KeptList], tuple[Array, Array]]:
        def call(given: KeptList) -> tuple[Array, Array]:
            found = _measure(given, cuda, True)
            return found["distances"], found["mask"]

        return call

    return on_platform(given, cpu=on(False), cuda=on(True))


def _measure(given: KeptList, cuda: bool, measured: bool) -> dict[str, Array]:
    kind, shape = _kind_of(given, cuda)._replace(measured=measured), given.idx.shape
    dims = {"mask": shape, **({"distances": shape} if measured else {}), "info": 2}
    return dict(zip(dims, _mask_callable(kind)(*_operands(given, kind, 0, None), output_dims=dims), strict=True))


def kept_slopes(given: KeptList, slots: Array | None, distances: Array, slopes: Array) -> Array:
    """Return the derivatives by positions [n, d] of a function whose derivatives by distances are `slopes` [n, capacity].

    The list is its own mirror image, and distances are those of `kept_distances`. `slots` are its reverse slots, on CUDA; on the
    CPU, None.
    """
    kind, dims = _kind_of(given, slots is not None), {"sums": given.sources.shape, "parts": 1, "info": 2}
    if slots is None:
        dims["parts"] = 4 * kept.BLOCKS_OF_ROWS * given.sources.shape[0]
    operands = _operands(given, kind, 0, None, slots)
    return _slope_callable(kind)(*operands, distances, slopes, output_dims=dims)[0]


def kept_sums(given: KeptList, summed: Summed, values: tuple[Array, Array | None, Array], apart: bool = False) -> FoundSums:
    """Sum a term over the pairs of a list, as `jfrnn._engine.warp_sums.pair_sums` does over those of a search.

    `values` are what all pairs share, what is read of i, or None where that is of the same arrays as what is read of j, and what is
    read of j. `apart`: a particle's pair with itself, without a shift, is left out. An extreme has its place in the row
    in place of the code of an image.
    """
    term = summed.term
    mirrored = values[1] is None

    def on(cuda: bool) -> Callable[[KeptList, tuple[Array, Array | None, Array]], FoundSums]:
        def call(given: KeptList, values: tuple[Array, Array | None, Array]) -> FoundSums:
            shared, own, others = values
            own = jnp.zeros((1, 1), given.sources.dtype) if own is None else own
            rows = len(given.ends[given.reversal is None])
            kind = _kind_of(given, cuda)._replace(apart=apart, mirrored=mirrored)
            kind = kind._replace(lanes=kept.lanes_of_sums(rows)) if cuda else kind
            kind = kind._replace(kind=summed.of(kind.kind))
            results = SumsOf(term, kind.kind, rows, kept.slots(rows, kind.lanes))
            operands = _operands(given, kind, term.columns, others)
            written = _sum_callable(kind, term, summed.key)(*operands, shared, own, output_dims=results.dims() | {"info": 2})
            return results.unpack(*written[:3])

        return call

    return on_platform(given, values, cpu=on(False), cuda=on(True))


def _kind_of(given: KeptList, cuda: bool) -> ListKind:
    cutoff, lattice, is_reversed = given.cutoff, given.lattice, given.reversal is not None
    rule = cutoff.rule if isinstance(cutoff, Cutoffs) else ""
    kind = Kind(
        given.sources.shape[1],
        double=given.sources.dtype == jnp.float64,
        scaled=cutoff.scaled,
        closed=cutoff.closed,
        periodic=periodic_kind(lattice),
        rule=EXCHANGED.get(rule, rule) if is_reversed else rule,
    )
    return ListKind(
        kind,
        images=1 if lattice is None else lattice.images.total,
        code_bytes=0 if given.codes is None else given.codes.dtype.itemsize,
        reversed=is_reversed,
        aligned=given.idx.shape[1] % 4 == 0,
        ordered=given.order is not None and cuda,
        lanes=kept.LANES if cuda else 0,
        boxes=given.systems is not None,
        itself=isinstance(cutoff, Cutoffs) and cutoff.itself,
        own=given.rows is None and not rule,
    )


def _operands(given: KeptList, kind: ListKind, columns: int, others: Array | None, slots: Array | None = None) -> list[Array]:
    """Return what kernels read of a list, in the order of `_LIST`, with columns of numbers of each source.

    `slots` are the reverse slots of a list that is not itself reversed.
    """
    dtype, (sources, rows), turns = given.sources.dtype, given.ends, given.turns or (None, None)
    if kind.reversed:
        sources, rows, turns = rows, sources, turns[::-1]
    of_sources, of_rows = _radii_of(given, kind)
    points = _beside(kind.length(columns), sources, others if columns else None, turns[0], of_sources, more=1)
    own = jnp.zeros((1, 1), dtype) if kind.own else _beside(kind.own_length, rows, turns[1], of_rows)
    cutoff = given.cutoff.largest if isinstance(given.cutoff, Cutoffs) else given.cutoff.radius
    nothing, steps = jnp.zeros(1, jnp.int32), jnp.zeros(1, dtype)
    if given.lattice is not None and given.codes is not None:
        steps = jnp.asarray(given.lattice.images.shifts).astype(dtype).reshape(-1)
    if isinstance(given.cutoff, Cutoffs) and given.cutoff.kinds is not None:
        table = given.cutoff.kinds[0]
        steps = jnp.concatenate([steps, jnp.full(1, table.size, dtype), table.reshape(-1)])
    codes = nothing if given.codes is None else given.codes
    reversal = given.reversal or [nothing if slots is None else slots, nothing, nothing]
    order = nothing if given.order is None or not kind.ordered else given.order
    systems = nothing if given.systems is None else given.systems[0 if kind.reversed else 1]
    numbers = _numbers_of(given, cutoff) if given.numbers is None else given.numbers
    return [own, points, numbers, steps, given.idx, given.counts, codes, *reversal, order, systems]


def _numbers_of(given: KeptList, cutoff: np.floating | Array) -> Array:
    if given.lattice is None:
        return jnp.reshape(jnp.asarray(cutoff, given.sources.dtype), 1)
    row = functools.partial(numbers_of_pairs, cutoff)
    return row(given.lattice) if given.systems is None else jax.vmap(row)(given.lattice)


def numbers_of_pairs(cutoff: np.floating | Array, lattice: Lattice) -> Array:
    """Return the cutoff, the numbers of a lattice and the largest number of a shift, [31], skewed ones with more."""
    dtype = lattice.matrix.dtype
    radius, most = (jnp.full(1, x, dtype) for x in (cutoff, 2 * LARGEST_TURN + max(lattice.images.reach)))
    none, slack = jnp.ones(lattice.dim, dtype), jnp.zeros((), dtype)
    return jnp.concatenate([radius, lattice_numbers(lattice, none, slack, slack, lattice.flags), most])


def _radii_of(given: KeptList, kind: ListKind) -> tuple[Array | None, Array | None]:
    """Return the cutoffs beside sources and rows, 0 if they are not read.

    With a table these are the species of sources, and where the row of a species begins in the table.
    """
    if not isinstance(given.cutoff, Cutoffs):
        return None, None
    if given.cutoff.kinds is not None:
        table, *both = given.cutoff.kinds
        beside, own = both[::-1] if kind.reversed else both
        dtype = given.sources.dtype
        return beside.astype(dtype), (own * np.int32(len(table))).astype(dtype)
    both = zip((given.cutoff.sources, given.cutoff.queries), given.ends, strict=True)
    found = [jnp.zeros(len(points), points.dtype) if x is None else x for x, points in both]
    return (found[1], found[0]) if kind.reversed else (found[0], found[1])


def _beside(length: int, *parts: Array | None, more: int = 0) -> Array:
    """Return arrays of points side by side, zeros up to a length, and `more` points whose numbers are NaN."""
    given = [x if x.ndim == 2 else x[:, None] for x in parts if x is not None]
    given = [jnp.pad(x, ((0, more), (0, 0)), constant_values=jnp.nan) for x in given]
    return side_by_side(given[0], [x[:, k] for x in given[1:] for k in range(x.shape[1])], length)


@kernel
def _mask_callable(kind: ListKind) -> Call:
    results = {"mask": np.bool_, **({"distances": scalar_of(kind.kind)} if kind.measured else {}), "info": np.int32}
    return Call(f"jfrnn_kept_mask_{kind.call}", _LIST, results, functools.partial(_plan_mask, kind))


@kernel
def _slope_callable(kind: ListKind) -> Call:
    results = dict.fromkeys(("sums", "parts"), scalar_of(kind.kind)) | {"info": np.int32}
    plan = functools.partial(_plan_slopes, kind)
    return Call(f"jfrnn_kept_slopes_{kind.call}", (*_LIST, "distances", "slopes"), results, plan)


@kernel
def _sum_callable(kind: ListKind, term: TermText, key: str) -> Call:
    results = dict.fromkeys(("sums", "totals", "errors"), scalar_of(kind.kind)) | {"info": np.int32}
    plan = functools.partial(_plan_sums, kind, term, key)
    return Call(f"jfrnn_kept_sums_{kind.call}_{key}", (*_LIST, "shared_values", "own_values"), results, plan)


def _launch(kind: ListKind, found: Kernel, shapes: Shapes) -> Plan:
    (m, capacity), n = shapes["idx"], shapes["points"][0] - 1
    m = m if not kind.reversed else n if kind.own else shapes["rows"][0]
    numbers = {"m": m, "n": n, "capacity": capacity, "images": kind.images, "closed": int(kind.kind.closed)}
    launch = Launch(found, kept.threads(m, kind.lanes)) if kind.cuda else share(found, m, kept.ROWS_AT_ONCE)
    return Plan([launch] if kind.cuda else [Clear("info", 8), launch], numbers)


def _plan_mask(kind: ListKind, shapes: Shapes, _: int) -> Plan:
    plan = _launch(kind, kept.mask_kernel(kind), shapes)
    if not kind.measured:
        return plan._replace(absent=["distances"])
    size = np.dtype(scalar_of(kind.kind)).itemsize * math.prod(shapes["distances"])
    return plan if kind.cuda else plan._replace(steps=[*ask_for_huge_pages("distances", size), *plan.steps])


def _plan_slopes(kind: ListKind, shapes: Shapes, _: int) -> Plan:
    found, *more = kept.slope_kernels(kind)
    plan = _launch(kind, found, shapes)
    if kind.cuda:
        return plan._replace(absent=["parts"])
    blocks, n = kept.BLOCKS_OF_ROWS, shapes["sums"][0]
    steps = [Clear("info", 8), share(found, blocks, max(1, blocks * kept.ROWS_AT_ONCE // n)), *(share(each, n) for each in more)]
    return plan._replace(steps=steps, absent=["slots"])


def _plan_sums(kind: ListKind, term: TermText, key: str, shapes: Shapes, _: int) -> Plan:
    return _launch(kind, kept.sum_kernel(kind, term, key), shapes)
