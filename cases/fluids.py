"""Fluid scenes by name: positions, velocities, masses, and what acts on them.

>>> fluid("four").positions.tolist()
[[0.505, 0.5], [0.515, 0.5], [0.51, 0.45], [0.5, 0.45]]
"""

from ._fluid import WORDS, FluidScene, Periodic, Physics, Solid, Tank, Turning
from ._fluid_flows import SCENES as _FLOWS
from ._fluid_free import SCENES as _FREE
from ._fluid_gear import SCENES as _GEAR
from ._fluid_source import SCENES as _SOURCE

__all__ = ["FLUIDS", "WORDS", "FluidScene", "Periodic", "Physics", "Solid", "Tank", "Turning", "fluid"]

FLUIDS = {**_SOURCE, **_FLOWS, **_FREE, **_GEAR}
"""Functions that make scenes, by name."""


def fluid(name: str, **settings: float) -> FluidScene:
    """Return a scene by its name.

    Args:
        name: One of `FLUIDS`.
        **settings: Of that scene: its function says which.

    Raises:
        ValueError: There is no such scene.
    """
    if name not in FLUIDS:
        raise ValueError(f"name must be a known fluid scene, got {name!r}: take one of {', '.join(FLUIDS)}.")
    return FLUIDS[name](**settings)
