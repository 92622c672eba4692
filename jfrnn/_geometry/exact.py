"""The pair test: decide `|x_j - x_i| < cutoff` as exact arithmetic on the given floats would.

There are three steps. Each is exact where it decides, and only evaluated for what the previous one left open:

1. `squared_distance` is compared with `Cutoff.inside` and `Cutoff.outside` in working precision. With u = eps/2, a difference has a
   relative error of u, a square 3u, a sum of three at most 5u, and r² times 1 ± the band 2u more: at most 3.5 eps in all. Flushed
   denormals add at most 3·2^-126 to a difference, less than 2^-28 of any cutoff that `check_cutoff` accepts. A band of 8 eps on
   either side is therefore safe however the compiler fuses multiply-adds; the CPU kernels, which flush nothing that matters here,
   use 4 eps.
2. `_fixed_sign` counts distances in units of 2^-39 scaled lengths (float64: 2^-86), in two machine integers per axis. A difference
   of two floats is exactly the sum of two others (Knuth 1969), which are converted to these units. It decides all pairs whose
   coordinates are whole numbers of units, as all floats are that exceed 2^-14 cutoffs (float64: 2^-32), unless coordinates differ
   by more than 2^14 cutoffs (2^27), as those of images of particles that were not wrapped may.
3. `_integer_sign` uses fixed-point integers as wide as the float format (`jfrnn._geometry.integers`), which never round. It decides
   the pairs that are left.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.cutoffs import UNITS, Cutoff, Cutoffs, step_one_bounds
from jfrnn._geometry.floats import WHOLE_BITS, two_sum, unit_scale
from jfrnn._geometry.integers import carry_limbs, full_count, limb_product, limb_sign, limb_type, limbs_of
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

    def along(self, k: int) -> tuple[Array, Array, list[tuple[Array, Array]]]:
        """Return the components of a and b along one axis, and shifts and lattice vectors between them."""
        if self.shift is None or self.matrix is None:
            return self.a[k], self.b[k], []
        terms = [(self.shift[k], self.matrix[k, k])] if self.orthogonal else list(zip(self.shift, self.matrix[:, k], strict=True))
        return self.a[k], self.b[k], terms


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
    return functools.reduce(jnp.add, (component * component for component in difference))


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
    if isinstance(cutoff, Cutoffs) and cutoff.itself:
        itself = asked & (neighbor == lax.broadcasted_iota(jnp.int32, neighbor.shape, 0)) & (square == square)
        itself = itself if shifted is None else itself & (shifted.shifts == 0).all(axis=-1)
        step_one = jnp.where(itself, yes, step_one)

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
    signs = jnp.where(doubtful, _fixed_sign(pairs, cutoff), 1).astype(jnp.int8)
    chunk = min(_INTEGER_CHUNK, signs.size)

    def decide_chunk(signs: Array) -> Array:
        flat = signs.reshape(-1)
        first = jnp.minimum(lax.argmax(flat, 0, jnp.int32), flat.size - chunk)  # that of an unknown sign, the largest value
        here = points(first + lax.iota(jnp.int32, chunk))
        known = lax.dynamic_slice_in_dim(flat, first, chunk)
        known = jnp.where(known == _UNKNOWN, _integer_sign(here, cutoff).astype(jnp.int8), known)
        return lax.dynamic_update_slice_in_dim(flat, known, first, axis=0).reshape(signs.shape)

    signs = lax.while_loop(lambda signs: largest_of(signs) == _UNKNOWN, decide_chunk, signs)
    return signs <= 0 if cutoff.closed else signs < 0


def decide_in_units(pair: Pair, cutoff: Cutoff | Cutoffs) -> tuple[Array, Array]:
    """Decide pairs by step 2 alone, in one kernel; return which it can decide, and which of these are within the cutoff."""
    sign = _fixed_sign(pair, cutoff, by_axis=True)
    return sign != _UNKNOWN, sign <= 0 if cutoff.closed else sign < 0


def decide_in_integers(pair: Pair, cutoff: Cutoff | Cutoffs) -> Array:
    """Decide [k] pairs by step 3; return which are within the cutoff."""
    sign = _integer_sign(pair, cutoff)
    return sign <= 0 if cutoff.closed else sign < 0


def _radii_of(pair: Pair, cutoff: Cutoff | Cutoffs) -> list[Array]:
    """Return the cutoff r, a scalar or one per pair; or two radii with mean r: twice the distance is compared with their sum."""
    return [jnp.asarray(cutoff.radius)] if isinstance(cutoff, Cutoff) else pair.radii or []


def _fixed_sign(pair: Pair, cutoff: Cutoff | Cutoffs, by_axis: bool = False) -> Array:
    """Return the sign of |b - a|² - r² where units of step 2 express all its parts, ties included, else _UNKNOWN; int32.

    All axes are processed together, so that the program is short, or one after the other, so that all is one kernel.
    """
    radii, alike = _radii_of(pair, cutoff), isinstance(cutoff, Cutoff)
    scale = jnp.asarray(cutoff.unit_scale) if alike else unit_scale(functools.reduce(jnp.maximum, radii))  # of the larger radius
    if by_axis:
        axes = [_square_in_units(*pair.along(k), scale) for k in range(len(pair.b))]
        limbs, known = zip(*(x for x, _ in axes), strict=True), [x for _, x in axes]
    else:
        limbs, known = _square_in_units(pair.a, pair.b, pair.lattice_terms(), scale[None] if scale.ndim else scale)
    total, known = [functools.reduce(lax.add, limb) for limb in limbs], functools.reduce(lax.bitwise_and, known)
    if isinstance(cutoff, Cutoff):
        less = list(jnp.asarray(cutoff.less))
    else:
        numbers, wholes = zip(*(_in_units(x, scale) for x in radii), strict=True)
        less = [-x for x in _square_limbs(*map(functools.partial(functools.reduce, lax.add), zip(*numbers, strict=True)))]
        known = functools.reduce(lax.bitwise_and, wholes, known)
    return jnp.where(known, _sign_of_limbs([x * len(radii) ** 2 + y for x, y in zip(total, less, strict=True)]), _UNKNOWN)


def _square_in_units(a: Array, b: Array, terms: list[tuple[Array, Array]], scale: Array) -> tuple[list[Array], Array]:
    """Return the limbs of (b - a)² in the units of step 2, and whether these express b - a: along one axis, or all [d, ...].

    A cutoff is below 4 in scaled lengths, and so is each component of a displacement that step 1 leaves open, up to its band.
    The difference of two floats is exactly the sum of two others, where no digit lies below the smallest normal float.
    """
    dtype = np.dtype(a.dtype)
    eps, limb = jnp.finfo(dtype).eps, UNITS[dtype.itemsize].limb
    difference, finer = two_sum(b, -a)
    numbers, knowns = zip(*(_in_units(x, scale) for x in (difference, finer)), strict=True)
    upper, lower = (x + y for x, y in zip(*numbers, strict=True))
    known = _has_normal_digits(a) & _has_normal_digits(b) & knowns[0] & knowns[1]
    if not terms:
        return _square_limbs(upper, lower), known & (jnp.abs(difference) * scale < 4.5)
    lowest, lower = lower & ((1 << limb) - 1), lower >> limb
    estimate, error = difference, 16 * eps * (jnp.abs(a) + jnp.abs(b))
    for shift, vector in terms:
        (upper_part, lower_part), whole = _in_units(vector, scale)
        times = shift.astype(limb_type(dtype))
        upper, lower = upper + upper_part * times, lower + (lower_part >> limb) * times
        lowest = lowest + (lower_part & ((1 << limb) - 1)) * times
        estimate, error = estimate + shift * vector, error + 16 * eps * jnp.abs(shift * vector)
        known = known & whole & _has_normal_digits(vector) & (jnp.abs(shift) <= 2**WHOLE_BITS)
    lower = lower + (lowest >> limb)
    upper, lower = upper + (lower >> limb), (lower & ((1 << limb) - 1)) << limb | (lowest & ((1 << limb) - 1))
    return _square_limbs(upper, lower), known & ((jnp.abs(estimate) + error) * scale < 4.5)


def _has_normal_digits(x: Array) -> Array:
    """Say which floats are 0 or so large that all their digits are at least the smallest normal float, which no device flushes."""
    finfo = jnp.finfo(x.dtype)
    unsigned = np.dtype(f"uint{finfo.bits}").type
    least = unsigned(finfo.nmant + 1) << unsigned(finfo.nmant + 1)
    return (lax.bitcast_convert_type(x, unsigned) << unsigned(1)) - unsigned(1) >= least - unsigned(1)


def _in_units(x: Array, scale: Array) -> tuple[tuple[Array, Array], Array]:
    """Return x in the upper and the lower units of step 2, integers of the same sign, and whether these express it."""
    dtype, whole = np.dtype(x.dtype), limb_type(np.dtype(x.dtype))
    units = UNITS[dtype.itemsize]
    scaled = x * (scale * dtype.type(2.0**units.upper))
    upper = scaled.astype(whole)
    rest = (scaled - upper.astype(dtype)) * dtype.type(2.0 ** (2 * units.limb))
    lower = rest.astype(whole)
    fits = jnp.abs(scaled) < dtype.type(2.0 ** (8 * dtype.itemsize - 1))
    return (upper, lower), fits & (lower.astype(dtype) == rest) & ((scaled != 0) | (x == 0))


def _square_limbs(upper: Array, lower: Array) -> list[Array]:
    """Return the square of a number in upper and lower units: seven limbs, the lowest first, not carried; the last keeps the rest.

    `lower` is below 2^25 (float64: 2^53). Three of these squares, four times, fit into the integers.
    """
    bits = UNITS[np.dtype(upper.dtype).itemsize].limb
    mask = (1 << bits) - 1
    limbs = [lower & mask, lower >> bits, upper & mask, upper >> bits]
    pairs, twice = [[(i, k - i) for i in range(4) if 0 <= k - i <= i] for k in range(7)], [2 * limb for limb in limbs]
    return [functools.reduce(lax.add, ((limbs if i == j else twice)[i] * limbs[j] for i, j in of_limb)) for of_limb in pairs]


def _sign_of_limbs(limbs: list[Array]) -> Array:
    """Return the sign of a sum of squares of `_square_limbs`, int32."""
    bits = UNITS[np.dtype(limbs[0].dtype).itemsize].limb
    carry, rest = jnp.zeros_like(limbs[0]), jnp.zeros_like(limbs[0])
    for limb in limbs[:-1]:
        total = limb + carry
        carry, rest = total >> bits, rest | (total & ((1 << bits) - 1))
    highest = limbs[-1] + carry
    return jnp.where(highest == 0, (rest != 0).astype(highest.dtype), jnp.sign(highest)).astype(jnp.int32)


def _integer_sign(pair: Pair, cutoff: Cutoff | Cutoffs) -> Array:
    """Return the sign of |b - a|² - r² for [k] pairs of finite points, in integer arithmetic only.

    Limbs of a difference are below 2^12 (float64: 2^27), in a lattice below 2^30 (2^46, as shifts are below 2^16); so are the sum
    of two radii and twice the differences. A limb of the sum of squares adds 4·29 (4·84) products of limbs carried by
    `carry_limbs`, which stays below 2^30 (2^61).
    """
    (dim, size), radii, dtype = pair.b.shape, _radii_of(pair, cutoff), np.dtype(pair.a.dtype)
    count, whole = full_count(dtype) + 3, limb_type(dtype)  # room for carries and the sign
    ends = radii[0], -radii[1] if len(radii) == 2 else jnp.zeros((), dtype)
    ends = [jnp.broadcast_to(x.reshape(1, -1), (1, size)) for x in ends]
    limbs = limbs_of(jnp.concatenate([pair.b, ends[0], pair.a, ends[1]]), count)  # [2 (d + 1), k, ...]
    times = np.array([len(radii)] * dim + [1], whole)[:, None, None]
    squared = (limbs[: dim + 1] - limbs[dim + 1 :]) * times
    for shift, vector in pair.lattice_terms():
        translation = shift.astype(whole)[..., None] * limbs_of(vector, count)
        squared = squared + jnp.pad(translation, ((0, 1), (0, 0), (0, 0))) * times
    squared = carry_limbs(squared)
    signs = np.array([1] * dim + [-1], whole)[:, None, None]
    return limb_sign(jnp.sum(limb_product(squared * signs, squared), axis=0, dtype=whole))
