"""Smoothing kernels W(r, h) of SPH, each normalized to 1 in two and in three dimensions.

With q = r/h a kernel is norm/h^d · shape(q), zero from q = support on. Kernels and their derivatives are written with truncated
polynomials, so that they need no branches and are differentiable wherever the kernel is.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class Kernel(NamedTuple):
    """A smoothing kernel.

    Attributes:
        support: The q = r/h from which on it is zero.
        norm: Its factor in two and in three dimensions.
        shape: q -> shape(q).
        derivative: q -> shape'(q).
        source: Author, year, DOI.
        over_q: q -> shape'(q)/q, where that is a polynomial.
    """

    support: float
    norm: tuple[float, float]
    shape: Callable[[Array], Array]
    derivative: Callable[[Array], Array]
    source: str
    over_q: Callable[[Array], Array] | None = None

    def value(self, r: Array, h: float | Array, dim: int) -> Array:
        """Return W(r, h) [1/length^dim] at distances r [length], any shape."""
        return self.norm[dim - 2] / h**dim * self.shape(r / h)

    def slope(self, r: Array, h: float | Array, dim: int) -> Array:
        """Return dW/dr [1/length^(dim+1)] at distances r [length], any shape."""
        return self.norm[dim - 2] / h ** (dim + 1) * self.derivative(r / h)

    def pull(self, r: Array, h: float | Array, dim: int) -> Array:
        """Return dW/dr / r [1/length^(dim+2)] at distances r [length], any shape; where that has no limit at r = 0, 0 there."""
        if self.over_q is not None:
            return self.norm[dim - 2] / h ** (dim + 2) * self.over_q(r / h)
        apart = r > 0
        return jnp.where(apart, self.slope(r, h, dim) / jnp.where(apart, r, 1), 0)


def below(edge: float, q: Array) -> Array:
    """Return edge - q where that is positive, else 0."""
    return jnp.maximum(edge - q, 0.0)


def _wendland(norm: tuple[float, float], shape: Callable[[Array], Array], over_q: Callable[[Array], Array]) -> Kernel:
    return Kernel(2.0, norm, shape, lambda q: q * over_q(q), _WENDLAND, over_q)


_MONAGHAN = "Monaghan (1992), doi:10.1146/annurev.aa.30.090192.002551"
_SCHOENBERG = "Schoenberg (1946) B-spline; Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776"
_WENDLAND = "Wendland (1995), doi:10.1007/BF02123482; Dehnen & Aly (2012), doi:10.1111/j.1365-2966.2012.21439.x"
_MUELLER = "Müller, Charypar & Gross (2003), doi:10.2312/SCA03/154-159"
# q -> shape(q), and q -> shape'(q), of Wendland's kernels over q
_SHAPES: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "cubic": (lambda q: 0.25 * below(2, q) ** 3 - below(1, q) ** 3, lambda q: -0.75 * below(2, q) ** 2 + 3 * below(1, q) ** 2),
    "quintic": (
        lambda q: below(3, q) ** 5 - 6 * below(2, q) ** 5 + 15 * below(1, q) ** 5,
        lambda q: -5 * below(3, q) ** 4 + 30 * below(2, q) ** 4 - 75 * below(1, q) ** 4,
    ),
    "wendland2": (lambda q: (below(2, q) / 2) ** 4 * (2 * q + 1), lambda q: -5 * (below(2, q) / 2) ** 3),
    "wendland4": (
        lambda q: (below(2, q) / 2) ** 6 * (35 / 12 * q**2 + 3 * q + 1),
        lambda q: -(7 / 3) * (2 + 5 * q) * (below(2, q) / 2) ** 5,
    ),
    "wendland6": (
        lambda q: (below(2, q) / 2) ** 8 * (4 * q**3 + 25 / 4 * q**2 + 4 * q + 1),
        lambda q: -(11 / 4) * (2 + 7 * q + 8 * q**2) * (below(2, q) / 2) ** 7,
    ),
    "poly6": (lambda q: jnp.maximum(1 - q**2, 0.0) ** 3, lambda q: -6 * q * jnp.maximum(1 - q**2, 0.0) ** 2),
    "spiky": (lambda q: below(1, q) ** 3, lambda q: -3 * below(1, q) ** 2),
}
KERNELS = {
    "cubic": Kernel(2.0, (10 / (7 * math.pi), 1 / math.pi), *_SHAPES["cubic"], _MONAGHAN),
    "quintic": Kernel(3.0, (7 / (478 * math.pi), 1 / (120 * math.pi)), *_SHAPES["quintic"], _SCHOENBERG),
    "wendland2": _wendland((7 / (4 * math.pi), 21 / (16 * math.pi)), *_SHAPES["wendland2"]),
    "wendland4": _wendland((9 / (4 * math.pi), 495 / (256 * math.pi)), *_SHAPES["wendland4"]),
    "wendland6": _wendland((78 / (28 * math.pi), 1365 / (512 * math.pi)), *_SHAPES["wendland6"]),
    "poly6": Kernel(1.0, (4 / math.pi, 315 / (64 * math.pi)), *_SHAPES["poly6"], _MUELLER),
    "spiky": Kernel(1.0, (10 / math.pi, 15 / math.pi), *_SHAPES["spiky"], _MUELLER),
}
