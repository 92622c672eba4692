"""Where a pair is decided: `|x_j - x_i| < cutoff` exactly as real arithmetic on the given floats decides it.

Three steps, each exact where it answers and each asked only what the one before left open:

1. `squared_distance` against `Cutoff.inside` and `Cutoff.outside`, in working precision. With u = eps/2, each difference
   carries a relative error u, each square 3u, the sum of three at most 5u, and r², times 1 ± the band, 2u more: in all at most
   3.5 eps. Flushed denormals add at most 3·2^-126 to a difference, which is below 2^-28 of any cutoff that `checked_cutoff` lets
   pass. A band of 8 eps on either side is therefore safe whatever the compiler fuses into multiply-adds; the kernels of the CPU,
   which flush nothing that matters here, take 4.
2. `_sum_sign`: error-free transformations (Dekker 1971; Ogita, Rump & Oishi 2005, doi:10.1137/030601818). Factors are split
   by integer operations into halves of at most half the mantissa, so that every product is exact and a fused multiply-add
   gives the same float as a product and a sum.
3. `_integer_sign`: fixed-point integers as wide as the float format (limbs of 11 bits in int32). No rounding exists there;
   it answers for coordinates whose exponents lie so far apart that step 2 would underflow or need more terms.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.reduced import Basis
from jfrnn._tracing import leading_axes, set_places


class Pair(NamedTuple):
    """Points a and b of pairs, axis by axis, and the lattice shift that b takes (None: no lattice): x_b + shift·matrix - x_a.

    `radii`, where cutoffs differ: one array, the cutoff of each pair; or two, of which the cutoff is the mean.
    """

    a: list[Array]
    b: list[Array]
    radii: list[Array] | None = None
    shift: list[Array] | None = None  # whole floats
    matrix: Array | None = None  # [d, d], lattice vectors in rows, 0 where space is open
    orthogonal: bool = True

    def lattice_terms(self, axis: int) -> list[tuple[Array, Array]]:
        """Return the shifts and the components of lattice vectors whose products belong to one axis."""
        if self.shift is None or self.matrix is None:
            return []
        rows = [axis] if self.orthogonal else range(len(self.shift))  # more than axes where numbers are cut into two
        return [(self.shift[k], self.matrix[k, axis]) for k in rows]


_WHOLE_BITS = 12  # of whole numbers whose products with half mantissas are exact


def shift_in_given(shift: list[Array], basis: Basis | None, matrix: Array) -> tuple[list[Array], Array]:
    """Return terms of a translation, shifts and lattice vectors, that say it exactly in the given vectors [d, d].

    `shift`, whole floats, counts vectors of the basis; in the given ones numbers may be large: they are cut into two.
    """
    if basis is None:
        return shift, matrix
    counts = [x.astype(jnp.int32) for x in shift]
    given = [functools.reduce(jnp.add, (x * row[k] for x, row in zip(counts, basis, strict=True))) for k in range(len(shift))]
    high = [(x + (1 << (_WHOLE_BITS - 1))) >> _WHOLE_BITS for x in given]
    low = [x - (h << _WHOLE_BITS) for x, h in zip(given, high, strict=True)]
    return [x.astype(matrix.dtype) for x in (*low, *high)], jnp.concatenate([matrix, matrix * 2**_WHOLE_BITS])


def combined(basis: Basis, matrix: Array) -> Array:
    """Return basis @ matrix, whole numbers times lattice vectors, each component rounded about once; differentiable."""
    whole = np.array(basis)
    high = (whole + (1 << (_WHOLE_BITS - 1))) >> _WHOLE_BITS
    half = _half_mantissa(lax.stop_gradient(matrix))
    terms = []
    for numbers, size in ((whole - (high << _WHOLE_BITS), 1), (high, 2**_WHOLE_BITS)):
        if numbers.any():
            times = numbers.astype(matrix.dtype)
            terms += [times[:, k, None] * (part[k] * size)[None] for k in range(len(whole)) for part in (matrix - half, half)]
    for _ in range(3):
        terms = _distill(terms)
    return functools.reduce(jnp.add, terms)


PointsAt = Callable[[Array | None], Pair]

LIMB_BITS = 11
_LIMB_MASK = (1 << LIMB_BITS) - 1
_UNKNOWN = 2  # a sign that step 2 could not prove
_INTEGER_CHUNK = 64  # pairs that one round of the integer test decides


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Cutoff:
    """A cutoff, rounded once to the dtype of the positions, with all that the pair test derives from it.

    The numbers are operands of the compiled program, not constants in it: one program serves every cutoff.

    Attributes:
        radius: r.
        inside: scaled squared distances below this belong to pairs, without doubt.
        outside: scaled squared distances above this do not, without doubt.
        unit_scale: power of two, itself a normal float, that brings r into [1, 4).
        plain_bits: magnitude bits of the smallest coordinate for which step 2 cannot underflow.
        closed: pairs at exactly r count. Static.
        scaled: r is so small or large that differences take `unit_scale` before they are squared. Static.
    """

    radius: np.floating | Array
    inside: np.floating | Array
    outside: np.floating | Array
    unit_scale: np.floating | Array
    plain_bits: np.unsignedinteger | Array
    closed: bool = dataclasses.field(metadata={"static": True})
    scaled: bool = dataclasses.field(metadata={"static": True})


RULES = ("gather", "scatter", "either", "both", "mean")  # whose cutoff is a pair's: i's, j's, the larger, the smaller, the mean


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Radii:
    """Cutoffs that differ from particle to particle, as they were given; data, so that they may be traced.

    Attributes:
        sources: [n] of the sources, or None where the rule does not ask for them.
        queries: [m] of the queries, likewise.
        rule: Which of both is a pair's (`RULES`). Static.
    """

    sources: Array | None
    queries: Array | None
    rule: str = dataclasses.field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Cutoffs:
    """What the pair test derives from radii, which are 0 or positive and finite wherever a particle takes part, else 0.

    Attributes:
        sources: [n], or None where the rule does not ask for them.
        queries: [m], likewise.
        largest: [] the largest of them all.
        unit_scale: [] power of two, itself a normal float, that brings the largest into [1, 4).
        rule: Static.
        closed: Pairs at exactly the cutoff count. Static.
    """

    sources: Array | None
    queries: Array | None
    largest: Array
    unit_scale: Array
    rule: str = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    scaled = True

    def of_pairs(self, queries: Array | None, sources: Array | None) -> list[Array]:
        """Return the cutoff of each pair, or two of which it is the mean, from those of its query and its source."""
        if sources is None or queries is None:
            return [x for x in (queries, sources) if x is not None]
        if self.rule == "mean":
            return [queries, sources]
        return [jnp.maximum(queries, sources) if self.rule == "either" else jnp.minimum(queries, sources)]


def is_radius(radii: Array | np.ndarray) -> Any:  # noqa: ANN401
    """Say which cutoffs the pair test can decide: 0, which reaches what coincides, is one of them. NumPy's arrays give NumPy's."""
    dtype = np.dtype(radii.dtype)
    unsigned = np.uint32 if dtype == np.float32 else np.uint64  # compared as floats, denormal numbers were 0
    low, high = (np.array(x, dtype).view(unsigned)[()] for x in (smallest_cutoff(dtype), largest_cutoff(dtype)))
    bits = radii.view(unsigned) if isinstance(radii, np.ndarray) else lax.bitcast_convert_type(radii, unsigned)
    magnitude = bits << unsigned(1) >> unsigned(1)
    negative_zero = np.array(-0.0, dtype).view(unsigned)[()]
    return (bits <= negative_zero) & (magnitude - unsigned(1) >= low - unsigned(1)) & (magnitude <= high)  # 0 - 1 is the largest


def make_cutoffs(radii: Radii, closed: bool, skin: float = 0.0) -> Cutoffs:
    """Derive what the pair test needs; with a skin, of radii that are that much larger, rounded up."""
    parts = [
        None if x is None else jnp.where(is_radius(x), _sum_rounded_up(jnp.abs(x), skin), 0) for x in (radii.sources, radii.queries)
    ]
    largest = functools.reduce(jnp.maximum, (jnp.max(x, initial=0) for x in parts if x is not None))
    largest = jnp.where(largest > 0, largest, 1)
    return Cutoffs(parts[0], parts[1], largest, _unit_scale(largest), radii.rule, closed)


def _sum_rounded_up(x: Array, skin: float) -> Array:
    if skin == 0:
        return x
    total, error = two_sum(x, jnp.asarray(skin, x.dtype))
    return jnp.where(error > 0, jnp.nextafter(total, jnp.asarray(jnp.inf, x.dtype)), total)


def bounds_of_pairs(cutoffs: Cutoffs, radii: list[Array], slack: Array | None = None) -> tuple[Array, Array]:
    """Return what step 1 compares scaled squared distances with: below the first a pair without doubt, above the second none.

    A mean is rounded, and so are its halves: 32 eps instead of 8 cover that generously. A cutoff so small against the largest
    that squares could underflow leaves to the next steps whatever is not surely farther.
    """
    finfo = jnp.finfo(cutoffs.largest.dtype)
    scaled = [radius * cutoffs.unit_scale for radius in radii]
    radius = scaled[0] if len(scaled) == 1 else (scaled[0] + scaled[1]) / 2
    off = 0 if slack is None else 2 * slack * cutoffs.unit_scale
    least = 2.0 ** (finfo.minexp // 2 + finfo.nmant)
    sure = radius > jnp.maximum(off, least)
    inside = jnp.where(sure, (radius - off) ** 2 * (1 - 32 * finfo.eps), -1)
    outside = (jnp.maximum(radius, least) + off) ** 2 * (1 + 32 * finfo.eps)
    return inside, outside


def _unit_scale(x: Array) -> Array:
    """Return the power of two that brings positive floats into [1, 4) and is itself a normal float."""
    unsigned, nmant, bias = (jnp.uint32, 23, 127) if x.dtype == jnp.float32 else (jnp.uint64, 52, 1023)
    exponent = lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)  # biased: 2·bias - e is that of 2^-(e - bias)
    return lax.bitcast_convert_type(jnp.maximum(unsigned(2 * bias) - exponent, unsigned(1)) << unsigned(nmant), x.dtype)


def make_cutoff(value: float, dtype: np.dtype, closed: bool) -> Cutoff:
    """Round a cutoff within `smallest_cutoff` and `largest_cutoff` to a dtype and derive the bounds of the pair test."""
    finfo = np.finfo(dtype)
    narrow = dtype == np.float32
    radius = dtype.type(value)
    exponent = int(np.frexp(radius)[1]) - 1
    unit_scale = dtype.type(2.0 ** -min(exponent, -int(finfo.minexp)))
    scaled = abs(exponent) > (30 if narrow else 400)
    square = (radius * unit_scale if scaled else radius) ** 2
    lowest = max(exponent - (35 if narrow else 450), int(finfo.minexp) + finfo.nmant + 1)
    return Cutoff(
        radius=radius,
        inside=square * dtype.type(1 - 8 * finfo.eps),
        outside=square * dtype.type(1 + 8 * finfo.eps),
        unit_scale=unit_scale,
        plain_bits=np.frombuffer(dtype.type(2.0**lowest).tobytes(), np.uint32 if narrow else np.uint64)[0],
        closed=closed,
        scaled=scaled,
    )


def widened(cutoff: Cutoff, slack: Array) -> Cutoff:
    """Return a cutoff whose step 1 leaves open what differences off by `slack` per component (at most 3) may not decide."""
    eps = jnp.finfo(slack.dtype).eps
    scale = cutoff.unit_scale if cutoff.scaled else slack.dtype.type(1)
    radius, off = cutoff.radius * scale, 2 * (slack * scale)
    inside = jnp.where(radius > off, (radius - off) ** 2 * (1 - 16 * eps), 0)
    return dataclasses.replace(cutoff, inside=inside, outside=(radius + off) ** 2 * (1 + 16 * eps))


def squared_distance(difference: list[Array], cutoff: "Cutoff | Cutoffs") -> Array:
    """Sum the squares of the scaled differences, one array per axis, in working precision (step 1)."""
    if cutoff.scaled:
        difference = [component * cutoff.unit_scale for component in difference]
    total = difference[0] * difference[0]
    for component in difference[1:]:
        total = total + component * component
    return total


def is_pair_of(rows: Array, sources: Array, neighbor: Array, cutoff: "Cutoff | Cutoffs", shifted: "Shifted | None" = None) -> Array:
    """Decide exactly, for rows [m, d], sources [n, d] and source indices [m, k], which pairs there are: [m, k] bool."""
    axes = range(sources.shape[1])
    if shifted is None:
        difference = [sources[neighbor, axis] - rows[:, axis, None] for axis in axes]
    else:
        difference = list(jnp.moveaxis(shifted.vectors, -1, 0))

    def of_rows(column: Array, at: Array | None) -> Array:  # no index array of all slots: XLA would make constants of it
        if at is None:
            return jnp.broadcast_to(column[:, None], neighbor.shape)
        return column.at[at // neighbor.shape[1]].get(mode="clip")

    def radii_of(at: Array | None, source: Array) -> list[Array] | None:
        if isinstance(cutoff, Cutoff):
            return None
        own, other = cutoff.queries, cutoff.sources
        return cutoff.of_pairs(None if own is None else of_rows(own, at), None if other is None else other[source])

    inside, outside = step_one_bounds(cutoff, radii_of(None, neighbor), None if shifted is None else shifted.slack)
    square = squared_distance(difference, cutoff)

    def points(at: Array | None) -> Pair:
        source = neighbor if at is None else flat_take(neighbor, at)
        if at is None:
            own, others = [of_rows(rows[:, axis], at) for axis in axes], [sources[source, axis] for axis in axes]
        else:
            own, others = list(rows.at[at // neighbor.shape[1]].get(mode="clip").T), list(sources[source].T)
        pair = Pair(own, others, radii_of(at, source))
        if shifted is None:
            return pair
        shifts = shifted.shifts if at is None else shifted.shifts.reshape(-1, len(axes)).at[at].get(mode="clip")
        shift = list(jnp.moveaxis(shifts, -1, 0))
        shift, matrix = shift_in_given(shift, shifted.basis, shifted.matrix)
        return pair._replace(shift=shift, matrix=matrix, orthogonal=shifted.orthogonal)

    surely = square < inside
    return surely | refine((square <= outside) & ~surely, points, cutoff)


def step_one_bounds(
    cutoff: "Cutoff | Cutoffs", radii: list[Array] | None, slack: Array | None = None
) -> tuple[np.floating | Array, np.floating | Array]:
    """Return the bounds of step 1: of one cutoff, or of pairs with these radii; differences may be off by `slack` per component."""
    if isinstance(cutoff, Cutoffs):
        return bounds_of_pairs(cutoff, radii or [], slack)
    if slack is not None:
        cutoff = widened(cutoff, slack)
    return cutoff.inside, cutoff.outside


class Shifted(NamedTuple):
    """What a lattice adds to pairs [m, k]: their computed vectors and shifts [m, k, d], and a bound on the vectors' error."""

    vectors: Array
    shifts: Array
    slack: Array
    matrix: Array
    orthogonal: bool
    basis: Basis | None = None  # in which shifts count, of the vectors in `matrix`; None: those


def flat_take(x: Array, at: Array) -> Array:
    """Return the elements of x at flat indices, which are clipped to its size."""
    return x.reshape(-1).at[at].get(mode="clip")


def refine(doubtful: Array, points: PointsAt, cutoff: Cutoff | Cutoffs) -> Array:
    """Decide the pairs that step 1 left open (steps 2 and 3); False elsewhere. Costs nothing where none is open.

    `points(None)` gives both points of every pair in the shape of `doubtful`; `points(at)` those of the pairs at the flat indices
    `at`, so that nobody has to store what is rarely asked for.
    """
    decide = functools.partial(_refine_some, points=points, cutoff=cutoff)
    return lax.cond(jnp.any(doubtful), decide, jnp.zeros_like, doubtful)


def _refine_some(doubtful: Array, points: PointsAt, cutoff: Cutoff | Cutoffs) -> Array:
    pairs = points(None)
    signs = jnp.where(doubtful, _sum_sign(pairs, _threshold(pairs, cutoff)), 1).reshape(-1)
    chunk = min(_INTEGER_CHUNK, signs.size)

    def decide_at(signs: Array, at: Array) -> Array:
        pairs = points(at)
        return signs.at[at].set(_integer_sign(pairs, _threshold(pairs, cutoff)), mode="drop")

    def decide_chunk(signs: Array) -> Array:
        at = set_places(signs == _UNKNOWN, chunk)  # there is one: the branch is a wall, or XLA finds `at` anew for each use of it
        return lax.cond(at[0] < signs.size, decide_at, lambda signs, _: signs, signs, at)

    signs = lax.while_loop(lambda signs: jnp.any(signs == _UNKNOWN), decide_chunk, signs)
    return (signs <= 0 if cutoff.closed else signs < 0).reshape(doubtful.shape)


class _Threshold(NamedTuple):
    """What steps 2 and 3 know of the cutoff of pairs: scalars, or one value per pair.

    Attributes:
        radii: r; or two, of which r is the mean: then twice the distance is compared with their sum.
        scale: power of two that brings the larger one into [1, 4).
        plain_bits: magnitude bits of the smallest number for which step 2 cannot underflow.
    """

    radii: list[Array]
    scale: Array
    plain_bits: Array

    @property
    def times(self) -> int:
        """How often the distance is compared with the sum of the radii."""
        return len(self.radii)


def _threshold(pair: Pair, cutoff: Cutoff | Cutoffs) -> _Threshold:
    if isinstance(cutoff, Cutoff):
        radius, scale, plain = lax.optimization_barrier((cutoff.radius, cutoff.unit_scale, cutoff.plain_bits))  # no constants:
        return _Threshold([radius], scale, plain)  # they could be regrouped
    radii = pair.radii or []
    larger = functools.reduce(jnp.maximum, radii)
    narrow = larger.dtype == jnp.float32
    unsigned, nmant = (jnp.uint32, 23) if narrow else (jnp.uint64, 52)
    exponent = lax.bitcast_convert_type(larger, unsigned) >> unsigned(nmant)
    below = unsigned(35 if narrow else 450)
    lowest = jnp.maximum(jnp.maximum(exponent, below) - below, unsigned(nmant + 2))
    return _Threshold(radii, _unit_scale(larger), lowest << unsigned(nmant))


# --- step 2: error-free transformations -------------------------------------------------------------------------------


def _sum_sign(pair: Pair, threshold: _Threshold) -> Array:
    """Return the sign of |b - a|² - r² where it is proven, ties of representable differences included, else _UNKNOWN; int32."""
    radii, scale, least = threshold
    terms, slack = [], jnp.zeros_like(pair.a[0])
    plain = [_is_plain(x, least) for x in (*pair.a, *pair.b, *(radii if len(radii) == 2 else ()))]
    distance_scale = scale * threshold.times
    for axis, (ak, bk) in enumerate(zip(pair.a, pair.b, strict=True)):
        high, low = _two_difference(bk, ak)
        rest = jnp.zeros_like(ak)
        for shift, component in pair.lattice_terms(axis):
            half = _half_mantissa(component)  # times a shift of at most half a mantissa: exact
            *others, low, high = _distill(_distill([low, shift * (component - half), shift * half, high]))
            rest = sum((jnp.abs(x * distance_scale) for x in others), rest)
            plain += [_is_plain(component, least), jnp.abs(shift) <= 2**_WHOLE_BITS]
        if pair.shift is not None:
            slack = slack + (4 * jnp.abs(high * distance_scale) * rest + 2 * rest * rest)
        high, low = high * distance_scale, low * distance_scale
        terms += _exact_square(high)
        tail = 2 * high * low
        terms.append(tail)
        slack = slack + (jnp.abs(tail) * jnp.finfo(slack.dtype).eps + 2 * low * low)
    radius, low = radii[0] * scale, None
    if len(radii) == 2:
        radius, low = two_sum(radius, radii[1] * scale)
    terms += [-term for term in _exact_square(jnp.broadcast_to(radius, slack.shape))]
    if low is not None:
        tail = -2 * radius * low
        terms.append(tail)
        slack = slack + (jnp.abs(tail) * jnp.finfo(slack.dtype).eps + 2 * low * low)
    for _ in range(3):
        terms = _distill(terms)
    rest = sum(jnp.abs(term) for term in terms[:-1])
    bound = 2 * (rest + slack)  # twice: covers the rounding of the sums of absolute values above
    leading = terms[-1]
    known = (jnp.abs(leading) > bound) | ((leading == 0) & (bound == 0))
    known = functools.reduce(jnp.logical_and, plain, known)
    return jnp.where(known, jnp.sign(leading).astype(jnp.int32), _UNKNOWN)


def _two_difference(a: Array, b: Array) -> tuple[Array, Array]:
    """Return fl(a - b) and its rounding error (Knuth 1969)."""
    difference = a - b
    b_virtual = a - difference
    a_virtual = difference + b_virtual
    return difference, (a - a_virtual) + (b_virtual - b)


def compensated_sum(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, Array]:
    """Add sums with what rounding took of them (value, error): nearly as in twice the precision."""
    total, rounding = two_sum(a[0], b[0])
    return total, a[1] + b[1] + rounding


def rounded_sum(value: Array, error: Array) -> Array:
    """Return what a compensated sum comes to; errors mean nothing where it is not finite."""
    return jnp.where(jnp.isfinite(value), value + error, value)


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return fl(a + b) and its rounding error (Knuth 1969)."""
    total = a + b
    b_virtual = total - a
    a_virtual = total - b_virtual
    return total, (a - a_virtual) + (b - b_virtual)


def _exact_square(x: Array) -> list[Array]:
    """Return three floats that sum to x² exactly, smallest first."""
    high = _half_mantissa(x)
    low = x - high
    return [low * low, 2 * high * low, high * high]


def _half_mantissa(x: Array) -> Array:
    """Round x to half its mantissa by integer operations on its bits: 12 bits of 24, 26 of 53."""
    unsigned, dropped = (jnp.uint32, 12) if x.dtype == jnp.float32 else (jnp.uint64, 27)
    bits = lax.bitcast_convert_type(x, unsigned)
    rounded = (bits + unsigned(1 << (dropped - 1))) >> unsigned(dropped) << unsigned(dropped)
    return lax.bitcast_convert_type(rounded, x.dtype)


def _distill(terms: list[Array]) -> list[Array]:
    """Add the terms up, keeping each rounding error in place: same exact sum, most of it in the last (VecSum)."""
    result = []
    total = terms[0]
    for term in terms[1:]:
        total, error = two_sum(total, term)
        result.append(error)
    return [*result, total]


def _is_plain(x: Array, least: Array) -> Array:
    """Say where x is 0 or large enough that no product of step 2 underflows."""
    unsigned = jnp.uint32 if x.dtype == jnp.float32 else jnp.uint64
    magnitude = lax.bitcast_convert_type(x, unsigned) << unsigned(1) >> unsigned(1)
    return (magnitude == 0) | (magnitude >= least)


# --- step 3: integers as wide as the float format ---------------------------------------------------------------------


def _integer_sign(pair: Pair, threshold: _Threshold) -> Array:
    """Return the sign of |b - a|² - r² for [k] pairs of finite points, in integer arithmetic throughout.

    A coordinate fills at most 6 limbs of 11 bits, a difference at most 12, each below 2^12 in magnitude; a limb of the sum of
    squares collects at most 3·12 products below 2^24 and stays below 2^31. With a lattice, limbs of a difference are below 2^30
    (shifts are below 2^16, doubled or not); carried into [-2^10, 2^10), all of them may be filled, 193 at most: 4·193·2^20 < 2^31.
    So are two radii, added up, and twice the differences that are compared with them.
    """
    dim, times = len(pair.a), threshold.times
    columns = jnp.stack([*pair.a, *pair.b, *(jnp.broadcast_to(radius, pair.a[0].shape) for radius in threshold.radii)])
    numbers = columns.reshape(-1) if pair.matrix is None else jnp.concatenate([columns.reshape(-1), pair.matrix.reshape(-1)])
    limbs = _limbs(numbers)  # of all at once: what is written here is compiled wherever a pair is decided
    of_pairs, of_lattice = limbs[: columns.size].reshape(*columns.shape, -1), limbs[columns.size :]
    squared = times * (of_pairs[dim : 2 * dim] - of_pairs[:dim])
    if pair.shift is not None:
        squared = squared + _translation_limbs(times * jnp.stack(pair.shift).astype(jnp.int32), of_lattice, dim, pair.orthogonal)
    squared = jnp.concatenate([squared, of_pairs[2 * dim :].sum(axis=0, keepdims=True, dtype=jnp.int32)])  # [d + 1, k, count]
    if pair.shift is not None or times > 1:
        squared = _carried(jnp.pad(squared, ((0, 0), (0, 0), (0, 3))))
    signs, count = np.array([1] * dim + [-1], np.int32)[:, None, None], squared.shape[-1]

    def add_shifted(i: Array, total: Array) -> Array:
        squares = jnp.sum(signs * limb_of(squared, i) * squared, axis=0, dtype=jnp.int32)
        window = lax.dynamic_slice_in_dim(total, i, count, axis=1)
        return lax.dynamic_update_slice_in_dim(total, window + squares, i, axis=1)

    total = jnp.zeros((squared.shape[1], 2 * count), jnp.int32)
    return sign_of_limbs(lax.fori_loop(0, count, add_shifted, total))


def _translation_limbs(shift: Array, limbs: Array, dim: int, orthogonal: bool) -> Array:
    """Return shifts [t, k] times lattice vectors, of which limbs [t·d, count] are given, added up: [d, k, count]."""
    vectors = limbs.reshape(-1, dim, 1, limbs.shape[-1])
    if orthogonal:
        return shift[:dim, :, None] * jnp.stack([vectors[axis, axis] for axis in range(dim)])
    return jnp.sum(shift[:, None, :, None] * vectors, axis=0, dtype=jnp.int32)


def _carried(limbs: Array) -> Array:
    """Bring limbs [..., count] into [-2^10, 2^10), the number that they write staying the same."""

    def carry_on(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        limbs, carry = state
        value = limb_of(limbs, i) + carry
        carry = (value + (1 << (LIMB_BITS - 1))) >> LIMB_BITS
        return lax.dynamic_update_slice_in_dim(limbs, value - (carry << LIMB_BITS), i, axis=-1), carry

    return lax.fori_loop(0, limbs.shape[-1], carry_on, (limbs, jnp.zeros_like(limbs[..., :1])))[0]


def limb_of(x: Array, i: Array) -> Array:
    return lax.dynamic_slice_in_dim(x, i, 1, axis=-1)


def sign_of_limbs(total: Array) -> Array:
    """Carry upwards with floor division: the last carry holds the sign, the remainders tell zero from positive."""

    def carry_on(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        carry, seen = state
        value = limb_of(total, i)[:, 0] + carry
        return value >> LIMB_BITS, seen | (value & _LIMB_MASK)

    zero = jnp.zeros(total.shape[0], jnp.int32)
    carry, seen = lax.fori_loop(0, total.shape[1], carry_on, (zero, zero))
    return jnp.where(carry < 0, -1, ((seen != 0) | (carry != 0)).astype(jnp.int32))


def _limbs(x: Array) -> Array:
    """Write finite floats [...] as signed int32 limbs [..., count], in units of the smallest denormal, lowest limb first."""
    finfo = jnp.finfo(x.dtype)
    sign, exponent, high, low = fields_of(x)
    place = jnp.maximum(exponent, 1) - 1
    width = finfo.nmant + 1
    count = -(-(finfo.maxexp - finfo.minexp + width) // LIMB_BITS)
    shift = leading_axes(jnp.arange(count, dtype=jnp.int32) * LIMB_BITS, place.ndim + 1) - place[..., None]
    limbs = shift_right(high[..., None], low[..., None], shift) & np.uint32(_LIMB_MASK)
    return jnp.where(sign[..., None], -1, 1) * limbs.astype(jnp.int32)


def fields_of(x: Array) -> tuple[Array, Array, Array, Array]:
    """Split floats into sign, biased exponent and the mantissa with its leading bit, as high and low uint32 words."""
    bits = lax.bitcast_convert_type(x, jnp.uint32)
    top, below = (bits, None) if x.dtype == jnp.float32 else (bits[..., 1], bits[..., 0])
    nmant = 23 if below is None else 20
    exponent = ((top >> nmant) & np.uint32(0xFF if below is None else 0x7FF)).astype(jnp.int32)
    lead = (exponent > 0).astype(jnp.uint32) << nmant
    mantissa = (top & np.uint32((1 << nmant) - 1)) | lead
    sign = (top >> 31) == 1
    if below is None:
        return sign, exponent, jnp.zeros_like(mantissa), mantissa
    return sign, exponent, mantissa, below


def shift_right(high: Array, low: Array, shift: Array) -> Array:
    """Return the low word of (high·2^32 + low) >> shift; a negative shift goes left."""

    def shifted(word: Array, by: Array) -> Array:  # XLA leaves shifts by 32 or more to the hardware: clamp, then mask
        return jnp.where((by >= 0) & (by < 32), word >> jnp.clip(by, 0, 31).astype(jnp.uint32), np.uint32(0))

    def lifted(word: Array, by: Array) -> Array:
        return jnp.where((by >= 0) & (by < 32), word << jnp.clip(by, 0, 31).astype(jnp.uint32), np.uint32(0))

    from_low = jnp.where(shift >= 0, shifted(low, shift), lifted(low, -shift))
    from_high = jnp.where(shift >= 32, shifted(high, shift - 32), lifted(high, 32 - shift))
    return from_low | from_high


def smallest_cutoff(dtype: np.dtype) -> float:
    """Return the smallest cutoff that keeps flushed denormals inside the band of step 1."""
    finfo = np.finfo(dtype)
    return 2.0 ** (finfo.minexp + finfo.nmant + 7)


def largest_cutoff(dtype: np.dtype) -> float:
    """Return the largest cutoff for which a cell edge is still finite."""
    return 2.0 ** (np.finfo(dtype).maxexp - 1)
