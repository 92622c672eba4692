"""Names of layouts, and scenes by name with errors for the command line."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from experiments._errors import UsageError

if TYPE_CHECKING:
    from jfrnn.cases import Scene  # pyright: ignore[reportMissingImports]


def names() -> list[str]:
    """Return what a layout may be called; the N of `clustersN` and the like stands for any number of tiles per axis."""
    from jfrnn import cases  # pyright: ignore[reportAttributeAccessIssue]

    return [*(name for name in cases.LAYOUTS if not name.startswith("clusters")), *(f"{family}N" for family in cases.FAMILIES)]


def is_layout(name: str) -> bool:
    """Whether a scene of this name can be made."""
    from jfrnn import cases  # pyright: ignore[reportAttributeAccessIssue]

    return bool(re.fullmatch(rf"({'|'.join(cases.FAMILIES)})[1-9]\d*", name)) or name in cases.LAYOUTS


def make(name: str, **options: float | str | None) -> "Scene":
    """Return a scene of `jfrnn.cases`.

    Raises:
        UsageError: There is no such layout, or it cannot be made with these options.
    """
    from jfrnn import cases  # pyright: ignore[reportAttributeAccessIssue]

    if not is_layout(name):
        raise UsageError(f"unknown layout {name!r}; allowed: {', '.join(names())}")
    try:
        return cases.scene(name, **options)
    except ValueError as error:
        raise UsageError(f"layout {name!r}: {error}") from error


def ordered(scene: "Scene", order: str, seed: int) -> "Scene":
    """Return the scene with its particles as the layout has them, "shuffled", or "sorted" by cells of a cutoff, x slowest."""
    from jfrnn import cases  # pyright: ignore[reportAttributeAccessIssue]

    if order == "shuffled":
        return cases.shuffle(scene, seed)
    if order == "layout":
        return scene
    import numpy as np  # not before it is needed: the command line imports this module

    cells = np.floor(scene.positions.astype(np.float64) / scene.cutoff)
    place = np.lexsort(cells.T[::-1])
    return replace(scene, positions=scene.positions[place], exact=None)
