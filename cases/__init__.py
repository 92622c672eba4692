"""Where particles are: the layouts of the thesis and scenes that are harder than they look. NumPy only."""

from ._build import LAYOUTS, scene
from ._domain import Domain
from ._scatter import clump, filament, jitter, random, sheet, two_blobs
from ._scene import Scene, shuffle
from ._thesis import clusters, corners, diagonal, full

__all__ = [
    "LAYOUTS",
    "Domain",
    "Scene",
    "clump",
    "clusters",
    "corners",
    "diagonal",
    "filament",
    "full",
    "jitter",
    "random",
    "scene",
    "sheet",
    "shuffle",
    "two_blobs",
]
