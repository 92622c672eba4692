"""A scene: particles, and the numbers that a neighbor search needs to know about them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ._check import float_dtype, positive, vector, whole


@dataclass(frozen=True, eq=False)
class Scene:
    """Hold particles together with the lengths that describe them.

    Args:
        name: Name of the layout.
        positions: Particle positions [m], float32 or float64, shape [n, d].
        cutoff: Interaction radius [m].
        spacing: Particle distance [m] that the scene is built on.
        lengths: Lengths of the domain [m], shape [d].
        fill: Points / points of the full domain.
        origin: Lower corner of the domain [m], shape [d]; left out, it is zero.
        exact: The positions before they were rounded to their dtype, float64, shape [n, d]; left out, the positions
            themselves. `moved` starts from them, so that a scene is rounded once, however it got where it is.

    Raises:
        ValueError: A shape, a dtype or a number does not fit.
    """

    name: str
    positions: np.ndarray
    cutoff: float
    spacing: float
    lengths: tuple[float, ...]
    fill: float
    origin: tuple[float, ...] = ()
    exact: np.ndarray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        float_dtype("dtype of positions", self.positions.dtype)
        if self.positions.ndim != 2:
            shape = list(self.positions.shape)
            raise ValueError(f"positions must have shape [n, d], got {shape}: pass one row per particle.")
        if not self.origin:
            object.__setattr__(self, "origin", (0.0,) * self.dim)
        for name, given in (("lengths", len(self.lengths)), ("origin", len(self.origin))):
            if given != self.dim:
                raise ValueError(f"{name} must have one entry per axis, {self.dim}, got {given}: match positions.")
        if self._unrounded.shape != self.positions.shape:
            raise ValueError(
                f"exact must have the shape of positions, {list(self.positions.shape)}, "
                f"got {list(self._unrounded.shape)}: pass both from the same scene."
            )

    @property
    def n(self) -> int:
        """Number of particles."""
        return self.positions.shape[0]

    @property
    def dim(self) -> int:
        """Number of axes."""
        return self.positions.shape[1]

    @property
    def _unrounded(self) -> np.ndarray:
        return self.positions.astype(np.float64) if self.exact is None else self.exact

    def moved(self, offset: float | Sequence[float] | np.ndarray = 0.0, scale: float = 1.0) -> "Scene":
        """Return the scene scaled about the coordinate origin and then shifted: x' = scale · x + offset.

        Computed in float64 from the unrounded positions, then rounded once to the dtype of this scene. Cutoff,
        spacing, lengths and origin go along, so that the pairs are the same up to that rounding.

        Args:
            offset: Shift [m], one number or one per axis.
            scale: Factor on every length, above 0.

        Raises:
            TypeError: `scale` is not a number.
            ValueError: An argument is not finite or has the wrong shape, `scale` is not above 0, or the moved
                positions leave the range of the dtype.
        """
        shift = vector("offset", offset, self.dim)
        factor = positive("scale", scale)
        with np.errstate(over="ignore"):
            exact = factor * self._unrounded + shift
            positions = exact.astype(self.positions.dtype)
        if not np.isfinite(positions).all():
            raise ValueError(f"offset={offset!r} with scale={scale!r} leaves the range of {positions.dtype}: pass smaller values.")
        return replace(
            self,
            positions=positions,
            exact=exact,
            cutoff=factor * self.cutoff,
            spacing=factor * self.spacing,
            lengths=tuple(factor * length for length in self.lengths),
            origin=tuple((factor * np.array(self.origin) + shift).tolist()),
        )


def shuffle(scene: Scene, seed: int = 0) -> Scene:
    """Return the scene with its particles in random order.

    Args:
        scene: The scene.
        seed: Seed of the order; the same seed gives the same order.

    Raises:
        TypeError: `seed` is not an integer.
        ValueError: `seed` is negative.
    """
    order = np.random.default_rng(whole("seed", seed, 0)).permutation(scene.n)
    return replace(scene, positions=scene.positions[order], exact=scene._unrounded[order])
