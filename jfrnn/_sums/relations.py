"""Relations: the pairs of a sum, from a search or from a list, and the loops that sum over them."""

import dataclasses
from collections.abc import Callable
from typing import Self, TypeGuard

import jax
import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine import FOLD_GROUP, Block, Inputs, KeptList, Options, Slots, Visit, fold_pairs, kept_mask
from jfrnn._geometry import EXCHANGED, Radii, are_finite, compensated_sum, mark_rows, rounded_sum
from jfrnn._search import Reverse, Topology, kept_shifts
from jfrnn._sums.fused import can_sum_list, check, sums_of_list
from jfrnn._sums.fused import is_fused as is_fusible
from jfrnn._sums.fused import sums as fused_sums
from jfrnn._sums.terms import Groups, Term
from jfrnn._tracing import Tree, call_apart, largest_of

_LIST_SLOTS = 1 << 22  # scalars of list slots that are processed at a time: 16 MB of float32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Searched:
    """The pairs of a search, which every sum repeats; no pair is stored.

    Attributes:
        inputs: The operands of the search, without a mask: inactive particles are at infinity.
        options: The options of the search. Static.
    """

    inputs: Inputs
    options: Options = dataclasses.field(metadata={"static": True})

    flipped = False

    @property
    def periodic(self) -> bool:
        """Whether pairs have lattice shifts."""
        return self.inputs.box is not None

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of rows and of sources."""
        n = self.inputs.sources.shape[0]
        return n if self.inputs.queries is None else self.inputs.queries.shape[0], n

    @property
    def symmetric(self) -> bool:
        """Whether exchanging i and j gives the same pairs."""
        radii = self.inputs.cutoff
        return self.inputs.queries is None and not (isinstance(radii, Radii) and radii.rule in EXCHANGED)

    def reverse(self) -> "Searched":
        """Return the same pairs with i and j exchanged and shifts negated."""
        sources, queries, active, box, cutoff, batch, exclude = self.inputs
        cutoff = cutoff.reverse() if isinstance(cutoff, Radii) else cutoff
        exclude = None if exclude is None else exclude.reverse()
        if queries is not None:
            sources, queries = queries, sources
            batch = batch if batch is None else batch.reverse()
        return Searched(Inputs(sources, queries, active, box, cutoff, batch, exclude), self.options)

    def fold(self, elements: int, visit: Visit, out: Tree) -> Tree:
        """Visit all pairs, as `fold_neighbors` does."""
        return fold_pairs(self.inputs, self.options, elements, visit, out)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OfList:
    """What the pairs of padded and flat lists have in common.

    Attributes:
        mask: Which slots hold a pair, bool.
        shifts: The lattice shift of each slot, [..., d] whole floats, or None in open space.
        source_count: Number of sources. Static.
        symmetric: Whether exchanging i and j gives the same pairs. Static.
        flipped: Whether i and j are exchanged: i are the sources of the list, j its rows, and shifts are negated. Static.
    """

    mask: Array
    shifts: Array | None
    source_count: int = dataclasses.field(metadata={"static": True})
    symmetric: bool = dataclasses.field(metadata={"static": True})
    flipped: bool = dataclasses.field(default=False, metadata={"static": True})

    @property
    def periodic(self) -> bool:
        """Whether pairs have lattice shifts."""
        return self.shifts is not None

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of rows and of sources; exchanged if flipped."""
        m, n = self._extent[0], self.source_count
        return (n, m) if self.flipped else (m, n)

    def reverse(self) -> Self:
        """Return the same pairs with i and j exchanged and shifts negated."""
        return self if self.symmetric else dataclasses.replace(self, flipped=not self.flipped)

    def mirrored(self) -> Self:
        """Return them so, without those of a particle with itself."""
        apart = self._are_apart()
        apart = apart if self.shifts is None else apart | (self.shifts != 0).any(axis=-1)
        return dataclasses.replace(self, mask=self.mask & apart, flipped=True)

    def fold(self, elements: int, visit: Visit, out: Tree) -> Tree:
        """Visit all pairs in blocks of rows, as `fold_neighbors` does."""
        m, widest = self._extent
        group = min(FOLD_GROUP, widest)
        if 0 in (m, group, self.source_count):
            return out
        size = min(max(_LIST_SLOTS // (group * elements), 1), m)

        def fold_block(b: Array, out: Tree) -> Tree:
            row = jnp.minimum(b * size, m - size) + lax.iota(jnp.int32, size)
            fresh = row >= b * size

            def fold(add: Callable[[Slots, Tree], Tree], state: Tree) -> Tree:
                longest = self._longest(row)

                def add_group(g: Array, state: Tree) -> Tree:
                    idx, shift, real = self._slots(row, g * group, group)
                    real = real & fresh[:, None]
                    return add(Slots(jnp.where(real, idx, 0), shift, real), state)

                return lax.fori_loop(0, (longest + (group - 1)) // group, add_group, state)

            return visit(Block(row, fresh, fold), out)

        return lax.fori_loop(0, -(-m // size), fold_block, out)

    @property
    def _extent(self) -> tuple[int, int]:
        """The number of rows, and the most pairs that one may have."""
        raise NotImplementedError

    def _longest(self, rows: Array) -> Array | int:
        """Return a length that none of these rows exceeds."""
        raise NotImplementedError

    def _slots(self, rows: Array, start: Array, group: int) -> tuple[Array, Array | None, Array]:
        """Return sources, shifts and mask, [rows, group, ...], of `group` slots of consecutive rows, from `start` on."""
        raise NotImplementedError

    def _are_apart(self) -> Array:
        """Say which slots hold another particle than their row."""
        raise NotImplementedError


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Listed(_OfList):
    """The pairs of a padded list.

    Attributes:
        idx: [m, c] int32 source indices, valid where `mask` [m, c] is set.
    """

    idx: Array

    @property
    def _extent(self) -> tuple[int, int]:
        return self.idx.shape[0], self.idx.shape[1]

    def _longest(self, rows: Array) -> int:
        return self.idx.shape[1]

    def _slots(self, rows: Array, start: Array, group: int) -> tuple[Array, Array | None, Array]:
        first = jnp.minimum(start, self.idx.shape[1] - group).astype(rows.dtype)
        new = first + lax.iota(jnp.int32, group) >= start

        def cut(x: Array) -> Array:
            origin = (rows[0], first, *[jnp.zeros_like(first)] * (x.ndim - 2))
            return lax.dynamic_slice(x, origin, (len(rows), group, *x.shape[2:]))

        return cut(self.idx), None if self.shifts is None else cut(self.shifts), cut(self.mask) & new

    def _are_apart(self) -> Array:
        return self.idx != lax.iota(jnp.int32, self.idx.shape[0])[:, None]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Flat(_OfList):
    """The pairs of a flat list.

    Attributes:
        senders: [total] int32 source indices, valid where `mask` [total] is set.
        receivers: [total] int32, their rows, ascending.
        offsets: [m + 1] int32, where the pairs of each row begin, and those of the last one end; they may exceed `total`.
    """

    senders: Array
    receivers: Array
    offsets: Array

    @property
    def _extent(self) -> tuple[int, int]:
        return self.offsets.shape[0] - 1, self.senders.shape[0]

    def _longest(self, rows: Array) -> Array:
        ends = jnp.minimum(self.offsets, self.senders.shape[0])
        return largest_of(ends[rows + 1] - ends[rows])

    def _slots(self, rows: Array, start: Array, group: int) -> tuple[Array, Array | None, Array]:
        edge = self.offsets[rows, None] + (start + lax.iota(jnp.int32, group))
        there = edge < jnp.minimum(self.offsets[rows + 1, None], self.senders.shape[0])
        edge = jnp.where(there, edge, 0)
        return self.senders[edge], None if self.shifts is None else self.shifts[edge], self.mask[edge] & there

    def _are_apart(self) -> Array:
        return self.senders != self.receivers


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kept:
    """The pairs of a list whose slots Warp's kernels decide while they sum.

    Attributes:
        given: The list at present positions.
        slots_by_source: The slots of each source (`Reverse`), if the list is not its own mirror image and they are known, or None.
        symmetric: Whether exchanging i and j gives the same pairs. Static.
        flipped: As in `Listed`. Static.
        apart: Whether a particle's pair with itself, without a shift, is left out. Static.
    """

    given: KeptList
    slots_by_source: Reverse | None
    symmetric: bool = dataclasses.field(metadata={"static": True})
    flipped: bool = dataclasses.field(default=False, metadata={"static": True})
    apart: bool = dataclasses.field(default=False, metadata={"static": True})

    @property
    def periodic(self) -> bool:
        """Whether pairs have lattice shifts."""
        return self.given.lattice is not None

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of rows and of sources; exchanged if flipped."""
        m, n = self.given.idx.shape[0], self.given.sources.shape[0]
        return (n, m) if self.flipped else (m, n)

    def reverse(self) -> "Kept":
        """Return the same pairs with i and j exchanged and shifts negated."""
        return self if self.symmetric else dataclasses.replace(self, flipped=not self.flipped)

    def mirrored(self) -> "Kept":
        """Return them so, without those of a particle with itself."""
        return dataclasses.replace(self, apart=True, flipped=True)

    def listed(self) -> Listed:
        """Return the same pairs, decided at once, for array programming."""
        given, n = self.given, self.given.sources.shape[0]
        mask, shifts = kept_mask(given), kept_shifts(given) if self.periodic else None
        kind = {"source_count": n, "symmetric": self.symmetric, "flipped": self.flipped}
        listed = Listed(idx=given.idx, mask=mask, shifts=shifts, **kind)
        return dataclasses.replace(listed.mirrored(), flipped=self.flipped) if self.apart else listed

    def directed(self) -> KeptList:
        """Return the list, with the slots of each source if i and j are exchanged."""
        if not self.flipped:
            return self.given
        given = self.given
        slots = Topology(given.idx, None, self.slots_by_source, None, given.sources.shape[0], 1, mutual=False, native=True)
        found = slots.with_reverse()
        assert found.starts is not None and found.lengths is not None  # no list that is its own mirror image is flipped
        return given._replace(reversal=(found.slots, found.starts, found.lengths))


Relation = Searched | Listed | Flat | Kept


def is_fused(relation: Relation, term: Term) -> TypeGuard[Searched]:
    """Say whether the fused engine sums this term over this relation."""
    return isinstance(relation, Searched) and 0 not in relation.sizes and is_fusible(relation.inputs, relation.options, term)


def summable(relation: Relation, term: Term) -> Relation:
    """Return the pairs in the form over which a term is summed; raise if the engine that was chosen by name cannot."""
    if isinstance(relation, Searched):
        check(relation.inputs, relation.options, term)
    elif isinstance(relation, Kept) and not can_sum_list(relation.given, term):
        return call_apart(Kept.listed, relation)  # once: derivatives are summed in the same way
    return relation


def sum_pairs(relation: Relation, term: Term, operands: Groups, compensated: bool) -> list[Array]:
    """Sum a term over all pairs (i, j) of a relation, with lattice shifts S; this specifies what every engine computes.

    Summands are t = term(True, S, (shared, own[i], others[j])), of operands `shared` of any shape, `own` [rows, ...] and `others`
    [sources, ...]. If `compensated`, the rounding errors of the sums are carried along, and added at the end.

    Return for each summand its sums over the neighbors j of each i, [rows, ...], or with `term.totals` over all pairs, [...]. Rows
    without neighbors are 0, whatever their operands hold; but with `term.marks` those of an i whose position is not finite are NaN
    (integers: the smallest one).
    """
    adder = _Adder(compensated)
    rows = relation.sizes[0]
    if isinstance(relation, Kept):
        return sums_of_list(relation.directed(), term, operands, compensated, relation.apart)
    if is_fused(relation, term):
        return fused_sums(relation.inputs, relation.options, term, operands, compensated)
    start = [adder.zeros(() if total else (rows,), x) for x, total in zip(term.summands, term.totals, strict=True)]

    def visit(block: Block, out: list) -> list:
        def add(slots: Slots, state: list) -> list:
            place, added = jnp.where(slots.real, slots.source, rows), []
            for old, terms, total in zip(state, evaluate(relation, term, operands, block, slots), term.totals, strict=True):
                if total:
                    added.append(adder.add(old, terms.reshape(1, -1, *terms.shape[2:]), squeeze=True))
                else:
                    added.append(adder.scatter(old, place, terms) if relation.flipped else adder.add(old, terms))
            return added

        if relation.flipped:
            return block.fold(add, out)
        of_all = list(zip(out, term.totals, strict=True))
        begin = [old if total else jax.tree.map(lambda all_rows: all_rows[block.query], old) for old, total in of_all]
        done, place = block.fold(add, begin), jnp.where(block.fresh, block.query, rows)
        return [
            new if total else jax.tree.map(lambda all_rows, some: all_rows.at[place].set(some, mode="drop"), old, new)
            for (old, total), new in zip(of_all, done, strict=True)
        ]

    found = relation.fold(term.elements, visit, start)
    results = [adder.result(state) for state in found]
    if not isinstance(relation, Searched) or not any(term.marks):
        return results
    good = are_finite(relation.inputs.sources if relation.inputs.queries is None else relation.inputs.queries)
    return [mark_rows(x, good) if mark else x for x, mark in zip(results, term.marks, strict=True)]


def evaluate(relation: Searched | Listed | Flat, term: Term, operands: Groups, block: Block, slots: Slots) -> list[Array]:
    """Evaluate a term on slots [b, g] of a block: [b, g, ...], 0 in masked slots."""
    mine, theirs = (operands.others, operands.own) if relation.flipped else (operands.own, operands.others)
    of_query, of_source = tuple(x[block.query] for x in mine), tuple(x[slots.source] for x in theirs)
    shift = jnp.zeros((*slots.real.shape, *term.shift.shape), term.shift.dtype) if slots.shift is None else slots.shift

    def one(real: Array, shift: Array, of_query: tuple, of_source: tuple) -> list[Array]:
        if relation.flipped:
            return list(term(real, -shift, Groups(operands.shared, of_source, of_query)))
        return list(term(real, shift, Groups(operands.shared, of_query, of_source)))

    each = jax.vmap(jax.vmap(one, (0, 0, None, 0)), (0, 0, 0, 0))
    summands = each(slots.real, shift, of_query, of_source)
    return [jnp.where(slots.real.reshape(*slots.real.shape, *[1] * (x.ndim - 2)), x, jnp.zeros_like(x)) for x in summands]


@dataclasses.dataclass(frozen=True)
class _Adder:
    """How sums are accumulated: as one array, or with compensation as two, the sum and its rounding error."""

    compensated: bool

    def zeros(self, rows: tuple[int, ...], like: jax.ShapeDtypeStruct) -> tuple[Array, ...]:
        return tuple(jnp.zeros((*rows, *like.shape), like.dtype) for _ in range(1 + self.compensated))

    def result(self, state: tuple[Array, ...]) -> Array:
        return rounded_sum(*state) if self.compensated else state[0]

    def scatter(self, state: tuple[Array, ...], place: Array, terms: Array) -> tuple[Array, ...]:
        """Add terms [b, g, ...] to the rows at `place`; these additions are not compensated."""
        return state[0].at[place].add(terms, mode="drop"), *state[1:]

    def add(self, state: tuple[Array, ...], terms: Array, squeeze: bool = False) -> tuple[Array, ...]:
        """Add terms [b, g, ...] to sums [b, ...]: first sum the terms of a row, then add that to the row's sum."""
        if not self.compensated:
            added = jnp.sum(terms, axis=1, dtype=terms.dtype)
            return (state[0] + (added[0] if squeeze else added),)
        zero = jnp.zeros((), terms.dtype)  # one reduction of both, as XLA may evaluate terms once per reduction
        sums = lax.reduce((terms, jnp.zeros_like(terms)), (zero, zero), compensated_sum, (1,))
        value, error = (x[0] if squeeze else x for x in sums)
        return compensated_sum(state, (value, error))
