"""Cutoffs, one for all particles (`Cutoff`) or one per particle (`Cutoffs`), with the derived constants of the pair test."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.floats import two_sum, unit_scale
from jfrnn._tracing import portable

Flags = Any  # bool array of NumPy or JAX, like the argument
RULES = ("gather", "scatter", "either", "both", "mean")  # cutoff of a pair: i's, j's, larger, smaller, mean
SUM = "sum"  # a rule of users: the mean of doubled radii, exactly
TABLE = "table"  # a rule of pairs of species
ALIKE = 2  # species that reach as far as each other within this factor are searched by cells, wherever particles are
# the smallest cutoff whose band of step 1 covers flushed denormals, and the largest whose cell edge is finite
RANGE_OF = {
    np.dtype(x.dtype): (2.0 ** (x.minexp + x.nmant + 7), 2.0 ** (x.maxexp - 1)) for x in map(np.finfo, (np.float32, np.float64))
}
EXCHANGED = {"gather": "scatter", "scatter": "gather"}  # rules that become another one where i and j are exchanged


class Units(NamedTuple):
    """How step 2 of the pair test counts scaled lengths: 2^-upper units, each of 2^(2 limb) smaller ones.

    Attributes:
        upper: Binary digits of the upper integer. Scaled lengths are below 2^(31 - upper) (float64: 2^(63 - upper)).
        limb: Binary digits of a limb of a square; the lower integer has twice as many.
    """

    upper: int
    limb: int


UNITS = {4: Units(15, 12), 8: Units(34, 26)}  # by the size of a float [B]: 2^-39 and 2^-86 of a scaled length


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Cutoff:
    """One cutoff for all pairs, rounded to the dtype of the positions, with the derived constants of the pair test.

    The numbers are operands of the compiled program, not constants in it: one program serves every cutoff.

    Attributes:
        radius: The cutoff r.
        inside: A scaled squared distance below this certainly belongs to a pair.
        outside: A scaled squared distance above this certainly does not.
        unit_scale: Power of two, a normal float, that scales r into [1, 4).
        less: [7] integers, the limbs of -r² in the units of step 2 of the pair test.
        closed: Whether pairs at exactly r count. Static.
        scaled: Whether r is so small or large that differences are multiplied by `unit_scale` before squaring. Static.
    """

    radius: np.floating | Array
    inside: np.floating | Array
    outside: np.floating | Array
    unit_scale: np.floating | Array
    less: np.ndarray | Array
    closed: bool = dataclasses.field(metadata={"static": True})
    scaled: bool = dataclasses.field(metadata={"static": True})


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Radii:
    """Cutoffs per particle, or per pair of species, as the user gave them; arrays, so they may be traced.

    Attributes:
        sources: [n] cutoffs of the sources, or None if the rule does not use them; with a table species, int32.
        queries: [m] cutoffs or species of the queries, likewise.
        rule: How the cutoff of a pair follows from both (`RULES` and `TABLE`). Static.
        summed: Whether they are twice the radii that the user gave, whose sum is then their mean. Static.
        table: [s, s] cutoffs of pairs of species, 0 for those that are no neighbors; None with cutoffs per particle.
        itself: Whether each particle is its own neighbor, whatever its cutoff. Static.
        alike: Whether species are known to reach almost as far as each other: by a factor of `ALIKE`. Static.
    """

    sources: Array | None
    queries: Array | None
    rule: str = dataclasses.field(metadata={"static": True})
    summed: bool = dataclasses.field(default=False, metadata={"static": True})
    table: Array | None = None
    itself: bool = dataclasses.field(default=False, metadata={"static": True})
    alike: bool = dataclasses.field(default=False, metadata={"static": True})

    @property
    def asked(self) -> str:
        """The rule that the user named."""
        return SUM if self.summed else RULES[0] if self.rule == TABLE else self.rule

    def reverse(self) -> "Radii":
        """Return the cutoffs of the same pairs with queries and sources exchanged."""
        rule = EXCHANGED.get(self.rule, self.rule)
        return dataclasses.replace(self, sources=self.queries, queries=self.sources, rule=rule)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Cutoffs:
    """Checked cutoffs per particle with the derived constants of the pair test. Invalid cutoffs are replaced by 0.

    Attributes:
        sources: [n] cutoffs of the sources, or None if the rule does not use them.
        queries: [m] cutoffs of the queries, likewise.
        largest: [] the largest of all.
        unit_scale: [] power of two, a normal float, that scales the largest into [1, 4).
        rule: How the cutoff of a pair follows from both (`RULES` and `TABLE`). Static.
        closed: Whether pairs at exactly the cutoff count. Static.
        kinds: With a table, the cutoffs of pairs of species, [s, s], -1 for those that are no neighbors, and the species of the
            sources and of the queries. The cutoff of a particle is then the largest one of its species. Otherwise None.
        itself: Whether each particle is its own neighbor, whatever its cutoff. Static.
        alike: As in `Radii`. Static.
        longer: [] how many queries have longer cutoffs than `largest`, if there may be some.
    """

    sources: Array | None
    queries: Array | None
    largest: Array
    unit_scale: Array
    rule: str = dataclasses.field(metadata={"static": True})
    closed: bool = dataclasses.field(metadata={"static": True})
    kinds: tuple[Array, Array, Array] | None = None
    itself: bool = dataclasses.field(default=False, metadata={"static": True})
    alike: bool = dataclasses.field(default=False, metadata={"static": True})
    longer: Array | None = None
    scaled = True

    @property
    def of_points(self) -> tuple[Array | None, Array | None]:
        """What `of_pairs` takes of the sources [n] and of the queries [m]: their cutoffs, or their species."""
        return (self.sources, self.queries) if self.kinds is None else self.kinds[1:]

    @property
    def of_cells(self) -> "Cutoffs":
        """These cutoffs for those who look for candidates: no pair of species reaches farther than either does at all."""
        return self if self.kinds is None else dataclasses.replace(self, rule="both", kinds=None)

    def of_pairs(self, queries: Array | None, sources: Array | None) -> list[Array]:
        """Return the cutoff of each pair in a list of one array, or of two arrays if the rule is their mean.

        It takes what `of_points` holds of them.
        """
        if self.kinds is not None and queries is not None and sources is not None:
            table = self.kinds[0]
            at = queries * np.int32(len(table)) + sources
            return [table.reshape(-1).at[at].get(mode="promise_in_bounds")]
        if sources is None or queries is None:
            return [x for x in (queries, sources) if x is not None]
        if self.rule == "mean":
            return [queries, sources]
        return [jnp.maximum(queries, sources) if self.rule == "either" else jnp.minimum(queries, sources)]


def is_radius(radii: Array | np.ndarray) -> Flags:
    """Say which cutoffs the pair test can decide; 0 is valid: it finds coincident particles. NumPy input gives NumPy output."""
    dtype = np.dtype(radii.dtype)
    unsigned = np.uint32 if dtype == np.float32 else np.uint64  # bits are compared: as floats, denormals would be flushed to 0
    low, high = (np.array(x, dtype).view(unsigned)[()] for x in RANGE_OF[dtype])
    bits = radii.view(unsigned) if isinstance(radii, np.ndarray) else lax.bitcast_convert_type(radii, unsigned)
    magnitude = bits << unsigned(1) >> unsigned(1)
    negative_zero = np.array(-0.0, dtype).view(unsigned)[()]
    return (bits <= negative_zero) & (magnitude - unsigned(1) >= low - unsigned(1)) & (magnitude <= high)  # 0 - 1 wraps around


def make_cutoff(value: float, dtype: np.dtype, closed: bool) -> Cutoff:
    """Round a cutoff that is within `RANGE_OF` a dtype to it, and derive the constants of the pair test."""
    finfo = np.finfo(dtype)
    narrow = dtype == np.float32
    radius = dtype.type(value)
    exponent = int(np.frexp(radius)[1]) - 1
    unit_scale = dtype.type(2.0 ** -min(exponent, -int(finfo.minexp)))
    scaled = abs(exponent) > (30 if narrow else 400)
    square, units = (radius * unit_scale if scaled else radius) ** 2, UNITS[dtype.itemsize]
    number = int(float(radius) * float(unit_scale) * 2.0 ** (units.upper + 2 * units.limb)) ** 2  # r² in the units of step 2
    limbs = [number >> (units.limb * k) & ((1 << units.limb) - 1) for k in range(6)] + [number >> (units.limb * 6)]
    return Cutoff(
        radius=radius,
        inside=square * dtype.type(1 - 8 * finfo.eps),
        outside=square * dtype.type(1 + 8 * finfo.eps),
        unit_scale=unit_scale,
        less=-np.array(limbs, np.int32 if narrow else np.int64),
        closed=closed,
        scaled=scaled,
    )


def make_cutoffs(radii: Radii, closed: bool, skin: float = 0.0) -> Cutoffs:
    """Derive the constants of the pair test from cutoffs per particle; a skin is added to each, rounded up."""
    if radii.table is not None:
        return _make_cutoffs_of_kinds(radii, radii.table, closed, skin)
    parts = [
        None if x is None else jnp.where(is_radius(x), _sum_rounded_up(jnp.abs(x), skin), 0) for x in (radii.sources, radii.queries)
    ]
    largest = functools.reduce(jnp.maximum, (jnp.max(x, initial=0) for x in parts if x is not None))
    largest = jnp.where(largest > 0, largest, 1)
    return Cutoffs(parts[0], parts[1], largest, unit_scale(largest), radii.rule, closed, itself=radii.itself)


def _make_cutoffs_of_kinds(radii: Radii, given: Array, closed: bool, skin: float) -> Cutoffs:
    assert radii.sources is not None and radii.queries is not None  # the species
    table = jnp.where(is_radius(given) & (given > 0), _sum_rounded_up(given, skin), -1)
    farthest = jnp.maximum(jnp.max(table, axis=1, initial=0), 0)
    kinds = [jnp.clip(x, 0, len(table) - 1) for x in (radii.sources, radii.queries)]
    largest = jnp.max(farthest, initial=0)
    largest = jnp.where(largest > 0, largest, 1)
    named, scale = (table, kinds[0], kinds[1]), unit_scale(largest)
    return Cutoffs(farthest[kinds[0]], farthest[kinds[1]], largest, scale, TABLE, closed, named, radii.itself, radii.alike)


def are_valid(radii: Radii) -> tuple[Array | None, Array | None]:
    """Say which sources [n] and queries [m] have a valid cutoff, or a species with valid ones; None for those that need none."""
    if radii.table is None:
        of_sources, of_queries = (None if x is None else is_radius(x) for x in (radii.sources, radii.queries))
        return of_sources, of_queries
    right, kinds = (is_radius(radii.table) & (radii.table == radii.table.T)).all(axis=1), len(radii.table)
    of_sources, of_queries = (
        None if x is None else (x >= 0) & (x < kinds) & right[jnp.clip(x, 0, kinds - 1)] for x in (radii.sources, radii.queries)
    )
    return of_sources, of_queries


def _sum_rounded_up(x: Array, skin: float) -> Array:
    if skin == 0:
        return x
    total, error = two_sum(x, jnp.asarray(skin, x.dtype))
    return jnp.where(error > 0, jnp.nextafter(total, jnp.asarray(jnp.inf, x.dtype)), total)


def widen(cutoff: Cutoff, slack: Array) -> Cutoff:
    """Return a cutoff whose step 1 tolerates an error of up to `slack` in each of at most 3 components of a displacement."""
    eps = jnp.finfo(slack.dtype).eps
    scale = cutoff.unit_scale if cutoff.scaled else slack.dtype.type(1)
    radius, off = cutoff.radius * scale, 2 * (slack * scale)
    inside = jnp.where(radius > off, (radius - off) ** 2 * (1 - 16 * eps), 0)
    return dataclasses.replace(cutoff, inside=inside, outside=(radius + off) ** 2 * (1 + 16 * eps))


def step_one_bounds(
    cutoff: "Cutoff | Cutoffs", radii: list[Array] | None, slack: Array | None = None
) -> tuple[np.floating | Array, np.floating | Array]:
    """Return the bounds of step 1, for one cutoff or per pair: squared distances below the first are pairs, above the second not.

    `slack` bounds the error of each component. Of cutoffs per pair the band is 32 eps instead of 8 because a mean and its halves
    are rounded. If one is so much smaller than the largest that its square could underflow, only distances that are certainly
    larger are decided here.
    """
    if isinstance(cutoff, Cutoff):
        cutoff = cutoff if slack is None else widen(cutoff, slack)
        return cutoff.inside, cutoff.outside
    finfo = jnp.finfo(cutoff.largest.dtype)
    scaled = [radius * cutoff.unit_scale for radius in radii or []]
    radius = scaled[0] if len(scaled) == 1 else (scaled[0] + scaled[1]) / 2
    off = 0 if slack is None else 2 * slack * cutoff.unit_scale
    least = 2.0 ** (finfo.minexp // 2 + finfo.nmant)
    sure = radius > jnp.maximum(off, least)
    inside = jnp.where(sure, (radius - off) ** 2 * (1 - 32 * finfo.eps), -1)
    outside = (jnp.maximum(radius, least) + off) ** 2 * (1 + 32 * finfo.eps)
    if cutoff.kinds is not None:
        outside = jnp.where(radius > 0, outside, -1)
    return inside, outside
