"""The domain of the thesis: a box, the lattice in it, and the cutoff."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._check import INDEX_LIMIT, positive, whole

LENGTHS = (0.005, 0.01, 0.005)  # [m]


@dataclass(frozen=True)
class Domain:
    """Hold the box 0.005 m × 0.01 m × 0.005 m that every layout is drawn in, and its lattice of sites.

    The box is fixed; `spacing` sets how finely it is resolved. An axis of length L has round(L / spacing) sites, at
    index · spacing: 50 × 100 × 50 sites at 1e-4 m, 25 × 50 × 25 at 2e-4 m. In 2D the z axis does not exist.

    Args:
        spacing: Distance of neighboring sites [m].
        cutoff_ratio: Cutoff in units of the spacing.
        dim: 3, or 2 for the x-y plane alone.

    Raises:
        TypeError: An argument is not a number.
        ValueError: An argument is out of range, or the lattice has no site, or more than int32 can count.

    Source: Peifle (2019), the domain of its benchmark.
    """

    spacing: float = 1e-4
    cutoff_ratio: float = 3.0
    dim: int = 3

    def __post_init__(self) -> None:
        spacing = positive("spacing", self.spacing)
        object.__setattr__(self, "spacing", spacing)  # a float, so that a float32 given here does not spread
        object.__setattr__(self, "cutoff_ratio", positive("cutoff_ratio", self.cutoff_ratio))
        whole("dim", self.dim, 2, 3)
        shortest = min(self.lengths)
        if spacing > shortest:
            raise ValueError(
                f"spacing must not exceed the shortest side of the domain, {shortest} m, got {spacing}: "
                "pass a smaller spacing, or scale the finished scene with `moved(scale=...)`."
            )
        if self.size > INDEX_LIMIT:
            least = (math.prod(self.lengths) / INDEX_LIMIT) ** (1 / self.dim)
            raise ValueError(
                f"spacing={spacing} gives {self.size} lattice sites, more than int32 indices can count: "
                f"pass a spacing above {least:.3g} m."
            )

    @property
    def lengths(self) -> tuple[float, ...]:
        """Lengths of the box [m], shape [dim]."""
        return LENGTHS[: self.dim]

    @property
    def sites(self) -> tuple[int, ...]:
        """Number of lattice sites along each axis, shape [dim]."""
        return tuple(round(length / self.spacing) for length in self.lengths)

    @property
    def size(self) -> int:
        """Number of lattice sites of the whole box: the points of a full domain."""
        return math.prod(self.sites)

    @property
    def cutoff(self) -> float:
        """Cutoff [m]."""
        return self.cutoff_ratio * self.spacing

    def at(self, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the positions of the chosen sites, in lexicographic order, x slowest.

        Args:
            chosen: Whether a site belongs to the layout, shape `sites`.

        Returns:
            Positions [m], float64, shape [n, dim].
        """
        return np.argwhere(chosen).astype(np.float64) * self.spacing
