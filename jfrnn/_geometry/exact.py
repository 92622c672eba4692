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

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.cutoffs import Cutoff, Cutoffs, fraction_bits, step_one_bounds
from jfrnn._geometry.floats import WHOLE_BITS, unit_scale
from jfrnn._geometry.integers import (
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
    """Points a and b [d, ...] of pairs, and the lattice shift of b (None in open space): x_b + shift·matrix - x_a.

    Where pairs form rows, a may have one column for all pairs of a row.
    `radii` is used with cutoffs per particle: one array of pair cutoffs, or two arrays whose mean is the cutoff.
    """

    a: Array
    b: Array
    radii: list[Array] | None = None
    shift: Array | None = None  # [d, ...] whole floats; twice as many if `shift_in_given` split the shifts
    matrix: Array | None = None  # [d, d], one lattice vector per row, 0 for open axes; or [d, d, ...] of each pair
    orthogonal: bool = True

    def lattice_terms(self) -> list[tuple[Array, Array]]:
        """Return shifts and vectors, [d, ...] or 1 where they are all alike, whose products sum to the translation."""
        if self.shift is None or self.matrix is None:
            return []
        dim, ones = len(self.b), (1,) * (self.b.ndim - 1)
        matrix = self.matrix if self.matrix.ndim > 2 else self.matrix.reshape(*self.matrix.shape, *ones)
        if self.orthogonal:
            return [(self.shift[:dim], jnp.stack([matrix[k, k] for k in range(dim)]))]
        return [(shift[None], vector) for shift, vector in zip(self.shift, matrix, strict=True)]


PointsAt = Callable[[Array | None], Pair]


def shift_in_given(shift: Array, basis: Basis | None, matrix: Array) -> tuple[Array, Array]:
    """Return shifts [d or 2·d, ...] and lattice vectors that express a translation exactly in the given vectors [d, d].

    `shift` [d, ...] holds whole floats that count vectors of the basis, which may stand behind the given ones, whole floats. Counts
    of the given vectors may be too large for one product to be exact, so each is split into two.
    """
    matrix, behind = matrix[: len(shift)], matrix[len(shift) :]
    if basis is None and len(behind) == 0:
        return shift, matrix
    counts = shift.astype(jnp.int32)
    numbers = behind.astype(jnp.int32) if basis is None else basis
    given = jnp.stack(
        [functools.reduce(jnp.add, (x * row[k] for x, row in zip(counts, numbers, strict=True))) for k in range(len(shift))]
    )
    high = (given + (1 << (WHOLE_BITS - 1))) >> WHOLE_BITS
    split = jnp.concatenate([given - (high << WHOLE_BITS), high])
    return split.astype(matrix.dtype), jnp.concatenate([matrix, matrix * 2**WHOLE_BITS])


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
        source = self.neighbor if at is None else flat_take(self.neighbor, at)
        own = self.rows.T[..., None] if at is None else self.rows.at[at // self.neighbor.shape[1]].get(mode="clip").T
        pair, shifted = Pair(own, jnp.moveaxis(self.sources[source], -1, 0), self.radii(at, source)), self.shifted
        if shifted is None:
            return pair
        shifts = shifted.shifts if at is None else shifted.shifts.reshape(-1, len(own)).at[at].get(mode="clip")
        given = shifted.matrix
        if given.ndim == 3:  # of each row
            given = jnp.moveaxis(given if at is None else given.at[at // self.neighbor.shape[1]].get(mode="clip"), 0, -1)
            given = given[..., None] if at is None else given
        shift, matrix = shift_in_given(jnp.moveaxis(shifts, -1, 0), shifted.basis, given)
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


def take_points(x: Array, at: Array) -> Array:
    """Return the points [d, ...] at these indices of x [n, d], all of which are valid."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(0,), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(x, at[..., None], dimensions, (1, x.shape[1]), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


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


def decide_in_units(pair: Pair, cutoff: Cutoff | Cutoffs) -> tuple[Array, Array]:
    """Decide pairs by step 2 alone; return which of them it can decide, and which of these are within the cutoff."""
    sign = _fixed_sign(pair, _threshold(pair, cutoff))
    return sign != _UNKNOWN, sign <= 0 if cutoff.closed else sign < 0


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
    All axes are processed together, so that the program is short.
    """
    dtype = np.dtype(pair.a.dtype)
    fraction = fraction_bits(dtype, threshold.times)
    eps, bits = jnp.finfo(dtype).eps, limb_bits(dtype)
    unsigned, finfo = np.dtype(f"uint{8 * dtype.itemsize}").type, jnp.finfo(dtype)
    exponent = (lax.bitcast_convert_type(threshold.scale, unsigned) >> unsigned(finfo.nmant)).astype(jnp.int32)
    up = exponent + (fraction + bits + int(finfo.minexp) - finfo.nmant - (finfo.maxexp - 1))
    up_of_axes, scale = (x[None] if x.ndim else x for x in (up, threshold.scale))
    (a, whole_a), (b, whole_b) = (_fixed_point(x, up_of_axes) for x in (pair.a, pair.b))
    displacement, estimate, known = _add(b, a, -1), pair.b - pair.a, whole_a & whole_b
    error = jnp.zeros((), dtype)
    for shift, vector in pair.lattice_terms():
        number, whole = _fixed_point(vector, up_of_axes)
        displacement = _add(displacement, number, shift.astype(limb_type(dtype)))
        estimate = estimate + shift * vector
        error = error + 16 * eps * (jnp.abs(pair.a) + jnp.abs(pair.b) + jnp.abs(shift * vector))
        known = known & whole & (jnp.abs(shift) <= 2**WHOLE_BITS)
    known = known & ((jnp.abs(estimate) + error) * scale < 4.5)
    total = [functools.reduce(lax.add, limb) for limb in _square_limbs(displacement, threshold.times, bits)]
    known = functools.reduce(lax.bitwise_and, known)
    less = threshold.less
    if less is None:
        numbers, wholes = zip(*(_fixed_point(x, up) for x in threshold.radii), strict=True)
        less = [-x for x in _square_limbs(functools.reduce(_add, numbers), 1, bits)]
        known = functools.reduce(lax.bitwise_and, wholes, known)
    return jnp.where(known, _sign_of_limbs([x + y for x, y in zip(total, less, strict=True)], bits), _UNKNOWN)


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
    (dim, size), radii, dtype = pair.b.shape, threshold.radii, np.dtype(pair.a.dtype)
    count, whole = full_count(dtype) + 3, limb_type(dtype)  # room for carries and the sign
    ends = radii[0], -radii[1] if len(radii) == 2 else jnp.zeros((), dtype)
    ends = [jnp.broadcast_to(x.reshape(1, -1), (1, size)) for x in ends]
    limbs = limbs_of(jnp.concatenate([pair.b, ends[0], pair.a, ends[1]]), count)  # [2 (d + 1), k, ...]
    times = np.array([threshold.times] * dim + [1], whole)[:, None, None]
    squared = (limbs[: dim + 1] - limbs[dim + 1 :]) * times
    for shift, vector in pair.lattice_terms():
        translation = shift.astype(whole)[..., None] * limbs_of(vector, count)
        squared = squared + jnp.pad(translation, ((0, 1), (0, 0), (0, 0))) * times
    squared = carry_limbs(squared)
    signs = np.array([1] * dim + [-1], whole)[:, None, None]
    return limb_sign(jnp.sum(limb_product(squared * signs, squared), axis=0, dtype=whole))
