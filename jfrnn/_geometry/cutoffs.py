"""Cutoffs of pairs, one for all (`Cutoff`) or one per particle (`Cutoffs`), and what step 1 of the pair test derives from them."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.floats import two_sum, unit_scale

Flags = Any  # bools in an array of the kind that was given, of NumPy or of JAX
RULES = ("gather", "scatter", "either", "both", "mean")  # whose cutoff is a pair's: i's, j's, the larger, the smaller, the mean


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


def is_radius(radii: Array | np.ndarray) -> Flags:
    """Say which cutoffs the pair test can decide: 0, which reaches what coincides, is one of them. NumPy's arrays give NumPy's."""
    dtype = np.dtype(radii.dtype)
    unsigned = np.uint32 if dtype == np.float32 else np.uint64  # compared as floats, denormal numbers were 0
    low, high = (np.array(x, dtype).view(unsigned)[()] for x in (smallest_cutoff(dtype), largest_cutoff(dtype)))
    bits = radii.view(unsigned) if isinstance(radii, np.ndarray) else lax.bitcast_convert_type(radii, unsigned)
    magnitude = bits << unsigned(1) >> unsigned(1)
    negative_zero = np.array(-0.0, dtype).view(unsigned)[()]
    return (bits <= negative_zero) & (magnitude - unsigned(1) >= low - unsigned(1)) & (magnitude <= high)  # 0 - 1 is the largest


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


def make_cutoffs(radii: Radii, closed: bool, skin: float = 0.0) -> Cutoffs:
    """Derive what the pair test needs; with a skin, of radii that are that much larger, rounded up."""
    parts = [
        None if x is None else jnp.where(is_radius(x), _sum_rounded_up(jnp.abs(x), skin), 0) for x in (radii.sources, radii.queries)
    ]
    largest = functools.reduce(jnp.maximum, (jnp.max(x, initial=0) for x in parts if x is not None))
    largest = jnp.where(largest > 0, largest, 1)
    return Cutoffs(parts[0], parts[1], largest, unit_scale(largest), radii.rule, closed)


def _sum_rounded_up(x: Array, skin: float) -> Array:
    if skin == 0:
        return x
    total, error = two_sum(x, jnp.asarray(skin, x.dtype))
    return jnp.where(error > 0, jnp.nextafter(total, jnp.asarray(jnp.inf, x.dtype)), total)


def widen(cutoff: Cutoff, slack: Array) -> Cutoff:
    """Return a cutoff whose step 1 leaves open what differences off by `slack` per component (at most 3) may not decide."""
    eps = jnp.finfo(slack.dtype).eps
    scale = cutoff.unit_scale if cutoff.scaled else slack.dtype.type(1)
    radius, off = cutoff.radius * scale, 2 * (slack * scale)
    inside = jnp.where(radius > off, (radius - off) ** 2 * (1 - 16 * eps), 0)
    return dataclasses.replace(cutoff, inside=inside, outside=(radius + off) ** 2 * (1 + 16 * eps))


def step_one_bounds(
    cutoff: "Cutoff | Cutoffs", radii: list[Array] | None, slack: Array | None = None
) -> tuple[np.floating | Array, np.floating | Array]:
    """Return the bounds of step 1: of one cutoff, or of pairs with these radii; differences may be off by `slack` per component."""
    if isinstance(cutoff, Cutoffs):
        return _bounds_of_pairs(cutoff, radii or [], slack)
    if slack is not None:
        cutoff = widen(cutoff, slack)
    return cutoff.inside, cutoff.outside


def _bounds_of_pairs(cutoffs: Cutoffs, radii: list[Array], slack: Array | None = None) -> tuple[Array, Array]:
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


def smallest_cutoff(dtype: np.dtype) -> float:
    """Return the smallest cutoff that keeps flushed denormals inside the band of step 1."""
    finfo = np.finfo(dtype)
    return 2.0 ** (finfo.minexp + finfo.nmant + 7)


def largest_cutoff(dtype: np.dtype) -> float:
    """Return the largest cutoff for which a cell edge is still finite."""
    return 2.0 ** (np.finfo(dtype).maxexp - 1)
