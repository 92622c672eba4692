"""The pair test: decide `|x_j - x_i| < cutoff` as exact arithmetic on the given floats would.

There are three steps. Each is exact where it decides, and only evaluated for what the previous one left open:

1. `squared_distance` is compared with `Cutoff.inside` and `Cutoff.outside` in working precision. With u = eps/2, a difference has a
   relative error of u, a square 3u, a sum of three at most 5u, and r² times 1 ± the band 2u more: at most 3.5 eps in all. Flushed
   denormals add at most 3·2^-126 to a difference, less than 2^-28 of any cutoff that `check_cutoff` accepts. A band of 8 eps on
   either side is therefore safe however the compiler fuses multiply-adds; the CPU kernels, which flush nothing that matters here,
   use 4 eps.
2. `_fixed_sign` counts distances in units of about 2^-39 cutoffs (float64: 2^-86), in two machine integers per axis. The upper one
   wraps around, so coordinates and lattice translations of any size may be added; only the displacement has to fit. It decides all
   pairs whose coordinates are whole numbers of units, as all floats are that exceed 2^-14 cutoffs (float64: 2^-32).
3. `_integer_sign` uses fixed-point integers as wide as the float format (`jfrnn._geometry.integers`), which never round. It decides
   the pairs that are left.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.cutoffs import Cutoff, Cutoffs, fraction_bits, step_one_bounds
from jfrnn._geometry.floats import WHOLE_BITS, unit_scale
from jfrnn._geometry.integers import (
    beside,
    carry_limbs,
    full_count,
    limb_bits,
    limb_product,
    limb_sign,
    limb_type,
    limbs_of,
)
from jfrnn._geometry.reduced import Basis
from jfrnn._tracing import largest_of

_UNKNOWN = 2  # the sign that step 2 could not prove
_INTEGER_CHUNK = 64  # pairs per iteration of the integer test


class Pair(NamedTuple):
    """Points a and b of pairs, per axis, and the lattice shift of b (None in open space): x_b + shift·matrix - x_a.

    Where pairs form rows, a may have one column for all pairs of a row.
    `radii` is used with cutoffs per particle: one array of pair cutoffs, or two arrays whose mean is the cutoff.
    """

    a: list[Array]
    b: list[Array]
    radii: list[Array] | None = None
    shift: list[Array] | None = None  # whole floats
    matrix: Array | None = None  # [d, d], one lattice vector per row, 0 for open axes; or [d, d, ...] of each pair
    orthogonal: bool = True

    def lattice_terms(self, axis: int) -> list[tuple[Array, tuple[int, int]]]:
        """Return shifts, and the places in `matrix` of what they multiply, which sum to the translation along an axis."""
        if self.shift is None or self.matrix is None:
            return []
        rows = [axis] if self.orthogonal else range(len(self.shift))  # twice the axes if `shift_in_given` split the shifts
        return [(self.shift[k], (k, axis)) for k in rows]


PointsAt = Callable[[Array | None], Pair]


def shift_in_given(shift: list[Array], basis: Basis | None, matrix: Array) -> tuple[list[Array], Array]:
    """Return shifts and lattice vectors that express a translation exactly in the given vectors [d, d].

    `shift` holds whole floats that count vectors of the basis, which may stand behind the given ones, whole floats. Counts of the
    given vectors may be too large for one product to be exact, so each is split into two.
    """
    matrix, behind = matrix[: len(shift)], matrix[len(shift) :]
    if basis is None and len(behind) == 0:
        return shift, matrix
    counts = [x.astype(jnp.int32) for x in shift]
    numbers = behind.astype(jnp.int32) if basis is None else basis
    given = [functools.reduce(jnp.add, (x * row[k] for x, row in zip(counts, numbers, strict=True))) for k in range(len(shift))]
    high = [(x + (1 << (WHOLE_BITS - 1))) >> WHOLE_BITS for x in given]
    low = [x - (h << WHOLE_BITS) for x, h in zip(given, high, strict=True)]
    return [x.astype(matrix.dtype) for x in (*low, *high)], jnp.concatenate([matrix, matrix * 2**WHOLE_BITS])


def squared_distance(difference: list[Array], cutoff: "Cutoff | Cutoffs") -> Array:
    """Sum the squares of the scaled differences, one array per axis, in working precision (step 1)."""
    if cutoff.scaled:
        difference = [component * cutoff.unit_scale for component in difference]
    total = difference[0] * difference[0]
    for component in difference[1:]:
        total = total + component * component
    return total


class Shifted(NamedTuple):
    """The lattice part of pairs [m, k]: displacements and shifts [m, k, d], a bound on the error of displacements, the lattice.

    That is `matrix`, [d, d], or [m, d, d] of each row, or [m, 2 d, d] as `Lattice.given` may be.
    """

    vectors: Array
    shifts: Array
    slack: Array
    matrix: Array
    orthogonal: bool
    basis: Basis | None = None  # the vectors that shifts count, in terms of `matrix`; None: those of `matrix`


class _Slots(NamedTuple):
    """Pairs of rows [m, d] and of the sources [n, d] at indices [m, k]."""

    rows: Array
    sources: Array
    neighbor: Array
    cutoff: Cutoff | Cutoffs
    shifted: Shifted | None

    def differences(self) -> list[Array]:
        """Return source minus row, per axis [m, k]."""
        if self.shifted is not None:
            return list(jnp.moveaxis(self.shifted.vectors, -1, 0))
        return [self.sources[self.neighbor, axis] - self.rows[:, axis, None] for axis in range(self.sources.shape[1])]

    def radii(self, at: Array | None, source: Array) -> list[Array] | None:
        """Return the cutoffs of a `Pair` at flat indices, or of all pairs, with these sources."""
        if isinstance(self.cutoff, Cutoff):
            return None
        other, own = self.cutoff.of_points
        return self.cutoff.of_pairs(None if own is None else self._spread(own, at), None if other is None else other[source])

    def points(self, at: Array | None) -> Pair:
        """Return the points at flat indices, or of all pairs."""
        axes, source = range(self.sources.shape[1]), self.neighbor if at is None else flat_take(self.neighbor, at)
        others = list(jnp.moveaxis(self.sources[source], -1, 0))
        if at is None:
            own = [self._spread(self.rows[:, axis], at) for axis in axes]
        else:
            own = list(self.rows.at[at // self.neighbor.shape[1]].get(mode="clip").T)
        pair, shifted = Pair(own, others, self.radii(at, source)), self.shifted
        if shifted is None:
            return pair
        shifts = shifted.shifts if at is None else shifted.shifts.reshape(-1, len(axes)).at[at].get(mode="clip")
        given = shifted.matrix
        if given.ndim == 3:  # of each row
            given = jnp.moveaxis(given if at is None else given.at[at // self.neighbor.shape[1]].get(mode="clip"), 0, -1)
            given = given[..., None] if at is None else given
        shift, matrix = shift_in_given(list(jnp.moveaxis(shifts, -1, 0)), shifted.basis, given)
        return pair._replace(shift=shift, matrix=matrix, orthogonal=shifted.orthogonal)

    def _spread(self, column: Array, at: Array | None) -> Array:  # without an index array of all slots, a large constant for XLA
        if at is None:
            return jnp.broadcast_to(column[:, None], self.neighbor.shape)
        return column.at[at // self.neighbor.shape[1]].get(mode="clip")


def is_pair_of(
    rows: Array, sources: Array, neighbor: Array, asked: Array, cutoff: Cutoff | Cutoffs, shifted: Shifted | None = None
) -> Array:
    """Decide exactly which of the pairs of rows [m, d] and sources [n, d] at indices [m, k] are within the cutoff: [m, k] bool.

    The result is False where `asked`, [m, k] bool, is False.
    """
    slots = _Slots(rows, sources, neighbor, cutoff, shifted)
    difference = slots.differences()
    inside, outside = step_one_bounds(cutoff, slots.radii(None, neighbor), None if shifted is None else shifted.slack)
    square = squared_distance(difference, cutoff)
    no, yes, open_pair = np.arange(3, dtype=np.int8)
    step_one = jnp.where(asked & (square <= outside), jnp.where(square < inside, yes, open_pair), no)  # one int8 array, one kernel

    def refine_open(step_one: Array) -> Array:
        return (step_one == yes) | decide_pairs(step_one == open_pair, slots.points, cutoff)

    return lax.cond(jnp.max(step_one, initial=no) == open_pair, refine_open, lambda step_one: step_one == yes, step_one)


def flat_take(x: Array, at: Array) -> Array:
    """Return the elements of x at flat indices, all of which are valid."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(x.reshape(-1), at[..., None], dimensions, (1,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def decide_pairs(doubtful: Array, points: PointsAt, cutoff: Cutoff | Cutoffs) -> Array:
    """Decide the pairs that step 1 left open by steps 2 and 3; False elsewhere.

    `points(None)` returns both points of every pair in the shape of `doubtful`, and `points(at)` those at the flat indices `at`.
    """
    pairs = points(None)
    signs = jnp.where(doubtful, _fixed_sign(pairs, _threshold(pairs, cutoff)), 1).astype(jnp.int8)
    chunk = min(_INTEGER_CHUNK, signs.size)

    def decide_chunk(signs: Array) -> Array:
        flat = signs.reshape(-1)
        first = jnp.minimum(lax.argmax(flat, 0, jnp.int32), flat.size - chunk)  # that of an unknown sign, the largest value
        here = points(first + lax.iota(jnp.int32, chunk))
        known = lax.dynamic_slice_in_dim(flat, first, chunk)
        known = jnp.where(known == _UNKNOWN, _integer_sign(here, _threshold(here, cutoff)).astype(jnp.int8), known)
        return lax.dynamic_update_slice_in_dim(flat, known, first, axis=0).reshape(signs.shape)

    signs = lax.while_loop(lambda signs: largest_of(signs) == _UNKNOWN, decide_chunk, signs)
    return signs <= 0 if cutoff.closed else signs < 0


class _Threshold(NamedTuple):
    """The cutoff as steps 2 and 3 use it: scalars, or one value per pair.

    Attributes:
        radii: The cutoff r; or two radii with mean r, in which case twice the distance is compared with their sum.
        scale: Power of two that scales the larger radius into [1, 4).
        less: The limbs of -r² with one cutoff for all pairs, or None.
    """

    radii: list[Array]
    scale: Array
    less: list[Array] | None = None

    @property
    def times(self) -> int:
        """The factor of the distance that is compared with the sum of the radii."""
        return len(self.radii)


def _threshold(pair: Pair, cutoff: Cutoff | Cutoffs) -> _Threshold:
    if isinstance(cutoff, Cutoff):
        return _Threshold([jnp.asarray(cutoff.radius)], jnp.asarray(cutoff.unit_scale), list(jnp.asarray(cutoff.less)))
    radii = pair.radii or []
    return _Threshold(radii, unit_scale(functools.reduce(jnp.maximum, radii)))


def _fixed_sign(pair: Pair, threshold: _Threshold) -> Array:
    """Return the sign of |b - a|² - r² where units of step 2 express all its parts, ties included, else _UNKNOWN; int32.

    A cutoff is below 4 in scaled lengths, and so is each component of a displacement that step 1 leaves open, up to its band.
    """
    dtype = np.dtype(pair.a[0].dtype)
    fraction = fraction_bits(dtype, threshold.times)
    eps, bits = jnp.finfo(dtype).eps, limb_bits(dtype)
    known, total = jnp.ones(pair.b[0].shape, bool), None
    unsigned, finfo = np.dtype(f"uint{8 * dtype.itemsize}").type, jnp.finfo(dtype)
    exponent = (lax.bitcast_convert_type(threshold.scale, unsigned) >> unsigned(finfo.nmant)).astype(jnp.int32)
    up = exponent + (fraction + bits + int(finfo.minexp) - finfo.nmant - (finfo.maxexp - 1))

    def fixed(x: Array) -> _Fixed:
        nonlocal known
        number, whole = _fixed_point(x, up)
        known = known & whole
        return number

    matrix = jnp.zeros((0, 0), dtype) if pair.matrix is None else pair.matrix
    lattice = _fixed_point(matrix.reshape(*matrix.shape, *[1] * up.ndim) if matrix.ndim == 2 else matrix, up)
    for axis, (ak, bk) in enumerate(zip(pair.a, pair.b, strict=True)):
        displacement, estimate = _add(fixed(bk), fixed(ak), -1), bk - ak
        error = jnp.zeros((), dtype)
        for shift, at in pair.lattice_terms(axis):
            component, (number, whole) = matrix[at], jax.tree.map(lambda x, at=at: x[at], lattice)
            known = known & whole
            displacement = _add(displacement, number, shift.astype(limb_type(dtype)))
            estimate = estimate + shift * component
            error = error + 16 * eps * (jnp.abs(ak) + jnp.abs(bk) + jnp.abs(shift * component))
            known = known & (jnp.abs(shift) <= 2**WHOLE_BITS)
        known = known & ((jnp.abs(estimate) + error) * threshold.scale < 4.5)
        square = _square_limbs(displacement, threshold.times, bits)
        total = square if total is None else [x + y for x, y in zip(total, square, strict=True)]
    less = threshold.less or [-x for x in _square_limbs(functools.reduce(_add, map(fixed, threshold.radii)), 1, bits)]
    return jnp.where(known, _sign_of_limbs([x + y for x, y in zip(total or [], less, strict=True)], bits), _UNKNOWN)


class _Fixed(NamedTuple):
    """A number upper + lower / 2^bits in the units of step 2, `bits` being those of a limb. `upper` wraps around."""

    upper: Array
    lower: Array


def _add(x: _Fixed, y: _Fixed, times: Array | int = 1) -> _Fixed:
    return _Fixed(x.upper + y.upper * times, x.lower + y.lower * times)


def _fixed_point(x: Array, up: Array) -> tuple[_Fixed, Array]:
    """Return x in the units of step 2, and whether it has no finer digits; `up` is where the lowest bit of denormals is there."""
    dtype, finfo = np.dtype(x.dtype), jnp.finfo(x.dtype)
    bits, width, whole = limb_bits(dtype), 8 * dtype.itemsize, limb_type(dtype)

    def by(amount: Array) -> Array:  # the result of longer shifts would depend on the hardware
        return lax.clamp(whole.type(0), amount, whole.type(width - 1))

    word = lax.bitcast_convert_type(x, whole)
    exponent = (word >> finfo.nmant) & ((1 << finfo.nexp) - 1)
    mantissa = (word & ((1 << finfo.nmant) - 1)) | (jnp.minimum(exponent, 1) << finfo.nmant)
    place = jnp.maximum(exponent, 1) + (up.astype(whole) - 1)  # of the lowest digit, in digits of `lower`
    finer, left = by(-place), jnp.maximum(place, 0)
    digits, sign = mantissa >> finer, (word >> (width - 1)) | 1
    upper = jnp.where(left < bits + width, (digits >> by(bits - left)) << by(left - bits), 0)
    lower = (digits << by(left)) & ((1 << bits) - 1)
    return _Fixed(upper * sign, lower * sign), digits << finer == mantissa


def _square_limbs(x: _Fixed, times: int, bits: int) -> list[Array]:
    """Return (times·x)² in seven limbs, the lowest first, not carried; the highest keeps the rest."""
    lower, mask = x.lower * times, (1 << bits) - 1
    upper, lower = x.upper * times + (lower >> bits), lower & mask
    negative = upper < 0
    upper = jnp.where(negative, jnp.where(lower == 0, -upper, ~upper), upper)
    lower = jnp.where(negative, -lower & mask, lower)
    limbs = [lower, upper & mask, (upper >> bits) & mask, upper >> (2 * bits)]
    pairs, twice = [[(i, k - i) for i in range(4) if 0 <= k - i <= i] for k in range(7)], [2 * limb for limb in limbs]
    return [functools.reduce(lax.add, ((limbs if i == j else twice)[i] * limbs[j] for i, j in of_limb)) for of_limb in pairs]


def _sign_of_limbs(limbs: list[Array], bits: int) -> Array:
    """Return the sign of a sum of squares of `_square_limbs`, int32."""
    carry, rest = jnp.zeros_like(limbs[0]), jnp.zeros_like(limbs[0])
    for limb in limbs[:-1]:
        total = limb + carry
        carry, rest = total >> bits, rest | (total & ((1 << bits) - 1))
    highest = limbs[-1] + carry
    return jnp.where(highest == 0, (rest != 0).astype(highest.dtype), jnp.sign(highest)).astype(jnp.int32)


def _integer_sign(pair: Pair, threshold: _Threshold) -> Array:
    """Return the sign of |b - a|² - r² for [k] pairs of finite points, in integer arithmetic only.

    Limbs of a difference are below 2^12 (float64: 2^27), in a lattice below 2^30 (2^46, as shifts are below 2^16); so are the sum
    of two radii and twice the differences. A limb of the sum of squares adds 4·29 (4·84) products of limbs carried by
    `carry_limbs`, which stays below 2^30 (2^61).
    """
    dim, radii, dtype = len(pair.a), threshold.radii, np.dtype(pair.a[0].dtype)
    count, whole = full_count(dtype) + 3, limb_type(dtype)  # room for carries and the sign
    ends = radii[0], -radii[1] if len(radii) == 2 else jnp.zeros((), dtype)
    limbs = limbs_of(beside([*pair.b, ends[0], *pair.a, ends[1]]), count)  # [k, 2 (d + 1), ...]
    times = np.array([threshold.times] * dim + [1], whole)[None, :, None]
    squared = (limbs[:, : dim + 1] - limbs[:, dim + 1 :]) * times
    if pair.shift is not None and pair.matrix is not None:
        shift = beside(pair.shift).astype(whole)
        squared = squared + _translation_limbs(shift, pair.matrix, count, pair.orthogonal) * times
    squared = carry_limbs(squared)
    signs = np.array([1] * dim + [-1], whole)[None, :, None]
    return limb_sign(jnp.sum(limb_product(squared * signs, squared), axis=1, dtype=whole))


def _translation_limbs(shift: Array, vectors: Array, count: int, orthogonal: bool) -> Array:
    """Return the sum of shifts [k, t] times lattice vectors [t, d] as limbs [k, d + 1, ...]; the last axis entry is 0.

    Where each pair has a lattice of its own, vectors are [t, d, k].
    """
    dim, shift = vectors.shape[1], shift[..., None]
    vectors = vectors[None] if vectors.ndim == 2 else jnp.moveaxis(vectors, -1, 0)
    limbs = limbs_of(jnp.pad(vectors, ((0, 0), (0, 0), (0, 1))), count)  # [1 or k, t, d + 1, ...]
    if orthogonal:
        vectors_of = np.eye(dim, dim + 1, dtype=limbs.dtype)
        limbs = jnp.sum(vectors_of[None, ..., None] * limbs[:, :dim], axis=1, dtype=limbs.dtype)
        return jnp.pad(shift[:, :dim], ((0, 0), (0, 1), (0, 0))) * limbs
    return functools.reduce(jnp.add, (shift[:, k, None] * limbs[:, k] for k in range(limbs.shape[1])))
