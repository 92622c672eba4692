"""Scenes of fluids and gases by name: positions, velocities, masses, and what acts on them.

>>> fluid("four").positions.tolist()
[[0.505, 0.5], [0.515, 0.5], [0.51, 0.45], [0.5, 0.45]]
"""

from collections.abc import Callable
from typing import TypeVar

from ._fluid import WORDS, FluidScene, Gas, GasScene, Periodic, Physics, Scene, Solid, Tank, Turning, inflow, lattice
from ._fluid_flows import SCENES as _FLOWS
from ._fluid_free import SCENES as _FREE
from ._fluid_gas import SCENES as _GASES
from ._fluid_gear import SCENES as _GEAR
from ._fluid_source import SCENES as _SOURCE

__all__ = [
    "FLUIDS", "GASES", "WORDS", "FluidScene", "Gas", "GasScene", "Periodic", "Physics", "Scene", "Solid", "Tank", "Turning",
    "fluid", "gas", "inflow", "lattice",
]  # fmt: skip

_Make = TypeVar("_Make", bound=Callable[..., Scene])

FLUIDS = {**_SOURCE, **_FLOWS, **_FREE, **_GEAR}
"""Functions that make scenes of fluids, by name."""
GASES = {**_GASES}
"""Functions that make scenes of gases, by name."""


def fluid(name: str, **settings: float) -> FluidScene:
    """Return a scene of a fluid by its name.

    Args:
        name: One of `FLUIDS`.
        **settings: Of that scene: its function says which.

    Raises:
        ValueError: There is no such scene.
    """
    return _named(FLUIDS, "fluid scene", name)(**settings)


def gas(name: str, **settings: float) -> GasScene:
    """Return a scene of a gas by its name.

    Args:
        name: One of `GASES`.
        **settings: Of that scene: its function says which.

    Raises:
        ValueError: There is no such scene.
    """
    return _named(GASES, "scene of a gas", name)(**settings)


def _named(scenes: dict[str, _Make], kind: str, name: str) -> _Make:
    if name not in scenes:
        raise ValueError(f"name must be a known {kind}, got {name!r}: take one of {', '.join(scenes)}.")
    return scenes[name]
