"""Names of layouts, and scenes by name with errors for the command line.

`cases` is taken from the repository, not as `jfrnn.cases`: with that comes JAX, for which processes would wait that need none.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np

import cases
from cases import Scene
from experiments._errors import UsageError


def names() -> list[str]:
    """Return what a layout may be called; the N of `clustersN` and the like stands for any number of tiles per axis."""
    return [*(name for name in cases.LAYOUTS if not name.startswith("clusters")), *(f"{family}N" for family in cases.FAMILIES)]


def is_layout(name: str) -> bool:
    """Whether a scene of this name can be made."""
    return bool(re.fullmatch(rf"({'|'.join(cases.FAMILIES)})[1-9]\d*", name)) or name in cases.LAYOUTS


def make(name: str, **options: Any) -> Scene:  # noqa: ANN401 - those of `cases.scene`
    """Return a scene of `jfrnn.cases`; refuse a layout that there is not, or that cannot be made with these options."""
    if not is_layout(name):
        raise UsageError(f"unknown layout {name!r}; allowed: {', '.join(names())}")
    try:
        return cases.scene(name, **options)
    except ValueError as error:
        raise UsageError(f"layout {name!r}: {error}") from error


def order_scene(scene: Scene, order: str, seed: int) -> Scene:
    """Return the scene with its particles as the layout has them, "shuffled", or "sorted" by cells of a cutoff, x slowest."""
    if order == "shuffled":
        return cases.shuffle(scene, seed)
    if order == "layout":
        return scene
    cells = np.floor(scene.positions.astype(np.float64) / scene.cutoff)
    place = np.lexsort(cells.T[::-1])
    return replace(scene, positions=scene.positions[place], exact=None)
