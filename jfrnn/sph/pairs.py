"""A pair of particles, and sums over the neighbors of each: the one place where the solver meets jfrnn."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

import jfrnn
from jfrnn.sph.kernels import Kernel

Values = dict[str, Array]
"""What is known of each particle: m [kg], rho [kg/m³], volume m/rho, specific 1/rho, p [Pa], v, u, w [m/s], wall, inverse."""
Term = Callable[["Pair", Values, Values], Any]
OwnTerm = Callable[["Pair", "Pair", Values, Values], Any]
Length = TypeVar("Length", float, Array)
_BEYOND = 1 + 2**-12  # a lattice has many pairs at exactly the support, which take long to decide (10 times the sum) and add 0


class Edges(Protocol):
    """Edges (i, j) that follow positions; some may lead from n to n, and are no pairs."""

    @property
    def overflow(self) -> Array:
        """Whether edges are missing, shape [], bool."""
        ...

    @property
    def rebuild_count(self) -> Array:
        """How often they were made anew, shape [], int32."""
        ...

    def update(self, positions: Array, *, active: Array | None = None) -> Any:  # noqa: ANN401
        """Return the edges at these positions [m], shape [n, d]."""
        ...

    def sum(self, fn: Callable[[Array, Any, Any], Any], positions: Array, values: Any) -> Any:  # noqa: ANN401
        """Sum fn(r, values of i, values of j) over the edges of each i, leaves [n, ...]."""
        ...


Neighbors = jfrnn.NeighborList | Edges | None
"""Where pairs come from: a list, edges, or, of None, a search by each sum."""


class Pair:
    """What terms ask about a pair (i, j): each quantity is computed when it is asked for, and once.

    Attributes:
        r: Displacement x_j - x_i [length], shape [d].
        h: Smoothing length.
    """

    def __init__(self, r: Array, kernel: Kernel, h: float | Array) -> None:
        """Hold the displacement of a pair, and the kernel."""
        self.r, self.kernel, self.h = r, kernel, h

    @cached_property
    def square(self) -> Array:
        """Squared distance [length²]."""
        return jnp.sum(self.r * self.r)

    @cached_property
    def distance(self) -> Array:
        """Distance [length], and its derivative 0 instead of NaN where two particles coincide."""
        apart = self.square > 0
        return jnp.where(apart, jnp.sqrt(jnp.where(apart, self.square, 1)), 0)

    @cached_property
    def weight(self) -> Array:
        """W(r, h)."""
        return self.kernel.value(self.distance, self.h, self.r.shape[0])

    @cached_property
    def pull(self) -> Array:
        """F = (dW/dr)/r, not positive, finite where two particles coincide: the gradient of W(x_i - x_j) at i is -F·r."""
        return self.kernel.pull(self.distance, self.h, self.r.shape[0])


def reach(kernel: Kernel, h: Length) -> Length:
    """Return the cutoff [length] of pairs: a little more than the kernel's support, where all terms are 0."""
    return kernel.support * _BEYOND * h


def total(
    term: Term,
    x: Array,
    values: Values,
    kernel: Kernel,
    h: float,
    nbrs: Neighbors = None,
    **options: Any,  # noqa: ANN401
) -> Any:  # noqa: ANN401
    """Sum a term over the neighbors of each particle: (pair, values of i, values of j) -> a pytree of arrays; leaves [n, ...].

    Positions are [n, d], values arrays [n, ...], the smoothing length [length] is static, and the cutoff is the kernel's support.
    Pairs are those of a list or of edges; where none is given, `jfrnn.pair_sum` finds them, with `options` of it: box, active.
    """

    def fn(r: Array, i: Values, j: Values) -> Any:  # noqa: ANN401
        return term(Pair(r, kernel, h), i, j)

    if isinstance(nbrs, jfrnn.NeighborList):
        return jfrnn.pair_sum(fn, x, None, values, neighbors=nbrs)
    if nbrs is not None:
        return nbrs.sum(fn, x, values)
    return jfrnn.pair_sum(fn, x, reach(kernel, h), values, **options)


def total_of_own(
    term: OwnTerm,
    x: Array,
    values: Values,
    kernel: Kernel,
    h: Array,
    rule: Literal["gather", "either"],
    backend: Any = "auto",  # noqa: ANN401
) -> Any:  # noqa: ANN401
    """Sum a term over the neighbors of each particle, where each has its own smoothing length h [length], shape [n].

    The term reads the pair as i weighs it, with h_i, and as j does, with h_j, then the values of i and j. By the rule "gather" j is
    a neighbor of i within the support of i, by "either" within that of i or of j. Differentiable in x, values and h.
    """

    def fn(r: Array, i: Values, j: Values) -> Any:  # noqa: ANN401
        return term(Pair(r, kernel, i["h"]), Pair(r, kernel, j["h"]), i, j)

    cutoffs = reach(kernel, jax.lax.stop_gradient(h))
    return jfrnn.pair_sum(fn, x, cutoffs, values | {"h": h}, radius_rule=rule, backend=backend)
