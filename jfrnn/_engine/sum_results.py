"""The arrays into which kernels write sums, and the sums in them."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine.operands import as_integer
from jfrnn._geometry import compensated_sum, rounded_sum
from jfrnn.kernels import Kind
from jfrnn.kernels.pair_sum_cpu import TermText

FoundSums = tuple[tuple[Array, ...], Array, Array]  # what `pair_sums` returns


class Summed(NamedTuple):
    """A term that is summed, and how; static.

    Attributes:
        term: Its text.
        key: Tells it from all others in names.
        compensated: Whether rounding errors of sums are added up, too.
        extremes: Whether the largest summands are found in place of sums.
    """

    term: TermText
    key: str
    compensated: bool = False
    extremes: bool = False

    def of(self, kind: Kind) -> Kind:
        """Return the kind of sums over the pairs of a search, or of a list."""
        return kind._replace(later=False, compensated=self.compensated, extremes=self.extremes)


class Values(NamedTuple):
    """What a term reads.

    Attributes:
        shared: Of all pairs, [width].
        own, others: Of i, [m, width], and of j, [n, width].
        own_beside, others_beside: The same without what rows of particles hold, too.
    """

    shared: Array
    own: Array
    others: Array
    own_beside: Array
    others_beside: Array

    @property
    def whole(self) -> tuple[Array, Array, Array]:
        """What kernels read that know no rows of particles."""
        return self.shared, self.own, self.others

    @property
    def beside_rows(self) -> tuple[Array, Array, Array]:
        """What kernels read beside rows of particles."""
        return self.shared, self.own_beside, self.others_beside


class SumsOf(NamedTuple):
    """The results of a kernel that sums a term: for each of `rows` queries, and over all pairs in `slots` partial sums."""

    term: TermText
    kind: Kind
    rows: int
    slots: int

    def dims(self) -> dict[str, Any]:
        """Return the shapes of the arrays that the kernel writes."""
        return {
            "sums": (self.rows, max(self.term.first or self._width, 1)),
            "totals": max(2 * self.slots * self._totals, 1),
            "more": (self.rows, self._width - self.term.first) if self.term.first else (1, 1),
            "errors": max(self.rows * self._width * (2 * self.kind.extremes + self.kind.compensated), 1),
        }

    def unpack(self, sums: Array, parts: Array, rest: Array, more: Array | None = None) -> FoundSums:
        """Return the results of `pair_sums`; partial sums over all pairs are added together with their rounding errors."""
        width, totals = self._width, self._totals
        shape = (self.rows, width, 2 if self.kind.extremes else 0)
        which = as_integer(rest[: math.prod(shape)]).reshape(shape)
        sums = sums if width > 0 else sums[:, :0]
        found = (sums,) if more is None or not self.term.first else (sums, more)
        parts, zero = parts[: 2 * self.slots * totals].reshape(self.slots, 2, totals), jnp.zeros((), parts.dtype)
        added = rounded_sum(*lax.reduce((parts[:, 0], parts[:, 1]), (zero, zero), compensated_sum, (0,)))  # in twice the precision
        return found, added, which

    @property
    def _totals(self) -> int:
        return sum(part.total for part in self.term.sums)

    @property
    def _width(self) -> int:
        return len(self.term.sums) - self._totals


def numbers_of_values(term: TermText, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, int]:
    """Return the numbers of the kernel of the CPU that sorts values and, where they are read, what rows of particles hold."""
    return {"width": len(term.other_columns), "reads_rows": term.reads_rows, "row_numbers": shapes["positions"][1]}
