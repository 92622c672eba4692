"""Where particles are: the layouts of the thesis and scenes that are harder than they look. NumPy only."""

from ._build import FAMILIES, LAYOUTS, scene
from ._domain import Domain
from ._scatter import clump, filament, jitter, random, sheet, two_blobs
from ._scene import Scene, shuffle
from ._thesis import clusters, corners, diagonal, full
from ._turned import cut, grown, tumbled, turned

__all__ = [
    "FAMILIES",
    "LAYOUTS",
    "Domain",
    "Scene",
    "clump",
    "clusters",
    "corners",
    "cut",
    "diagonal",
    "filament",
    "full",
    "grown",
    "jitter",
    "random",
    "scene",
    "sheet",
    "shuffle",
    "tumbled",
    "turned",
    "two_blobs",
]
