"""Names of layouts, and scenes by name with errors for the command line."""

import re
from typing import TYPE_CHECKING

from experiments._errors import UsageError

if TYPE_CHECKING:
    from jfrnn.cases import Scene  # pyright: ignore[reportMissingImports]

NUMBERED = "clustersN"


def names() -> list[str]:
    """Return what a layout may be called; `clustersN` stands for any number N of tiles per axis."""
    from jfrnn import cases  # pyright: ignore[reportAttributeAccessIssue]

    return [*(name for name in cases.LAYOUTS if not name.startswith("clusters")), NUMBERED]


def is_layout(name: str) -> bool:
    """Whether a scene of this name can be made."""
    return bool(re.fullmatch(r"clusters[1-9]\d*", name)) or (name != NUMBERED and name in names())


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
