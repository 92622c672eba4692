"""Which values the settings of a scene may have: of its function, and of its physics."""

import types
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import Field, TypeAdapter, ValidationError

Bounds = dict[str, float]
MANY: Bounds = {"ge": 1, "le": 1_000_000}
"""Of snapshots, and of lines for each."""
SKIN: Bounds = {"ge": 0.01, "le": 100}
"""Of a list, in particle spacings."""

_ABOVE_0: Bounds = {"gt": 0}
_FROM_0: Bounds = {"ge": 0}
_POSITIVE = (
    *("duration", "step", "reynolds", "radius", "side", "width", "height", "depth", "diameter", "plate", "module", "speed"),
    *("top_speed", "density", "sound_speed", "smoothing", "energy"),
)
_NOT_NEGATIVE = (
    *("viscosity", "artificial", "density_diffusion", "pressure_diffusion", "transport", "shifting", "tension"),
    *("surface_tension", "damping", "damped_until", "settling"),
)
RANGES: dict[str, Bounds] = {
    **{key: _ABOVE_0 for key in _POSITIVE},
    **{key: _FROM_0 for key in _NOT_NEGATIVE},
    **{key: {"ge": 1, "le": 10_000} for key in ("nx", "layers")},
    "ny": {"ge": 2, "le": 10_000},
    "exponent": {"ge": 1, "le": 1000},
    "heat_ratio": {"gt": 1, "lt": 2},
    "smoothing_ratio": {"ge": 1, "le": 4},
    "hot": {"ge": 1, "le": 100},
    "dim": {"ge": 2, "le": 3},
    "seed": {"ge": 0, "lt": 2**31},
    "teeth": {"ge": 5, "le": 1000},
    "faces": {"ge": 100, "le": 10_000_000},
    "jitter": {"ge": 0, "le": 0.5},
    "cfl": {"gt": 0, "le": 1},
    "restitution": {"ge": 0, "le": 1},
    "tank": {"ge": 1, "le": 1000},
    "spacing": {"ge": 0.002, "le": 1},
    **{key: {} for key in ("rate", "offset", "gravity")},
}
"""Of every number; a setting that several scenes have means the same in all of them."""
OF_SCENES: dict[tuple[str, str], Bounds] = {
    key: _ABOVE_0 for key in (("poiseuille", "viscosity"), ("couette", "viscosity"), ("square-drop", "surface_tension"))
}
"""Where a scene is stricter: what it divides by."""
_SIGNS = {"gt": "above", "ge": "from", "lt": "below", "le": "to"}


def read(kind: Any, value: object, bounds: Bounds | None, strict: bool = False) -> Any:  # noqa: ANN401
    """Return a value, as JSON has it or a text, as its annotation says, within bounds of `RANGES`; None for what is no number.

    Where `strict`, a text is no number and no bool, nor is a bool a number.

    Raises:
        ValueError: In a line, what the value is not, and its range.
    """
    try:
        return TypeAdapter(_within(kind, bounds)).validate_python(value, strict=strict)
    except ValidationError as error:
        message = error.errors()[0]["msg"].lower()
        raise ValueError(message + (f" ({in_words(bounds)})" if bounds is not None else "")) from error


def of(scene: str, key: str) -> Bounds | None:
    """Return the bounds of a setting of a scene, None where it is no number."""
    return OF_SCENES.get((scene, key), RANGES.get(key))


def in_words(bounds: Bounds) -> str:
    """Return bounds as a reader says them."""
    return " ".join(f"{_SIGNS[sign]} {number:,}".replace(",", " ") for sign, number in bounds.items()) or "finite"


def _within(kind: Any, bounds: Bounds | None) -> Any:  # noqa: ANN401
    """Return an annotation whose numbers are finite and within bounds."""
    if kind in (int, float):
        return Annotated[kind, Field(**(bounds or {}), **({"allow_inf_nan": False} if kind is float else {}))]  # pyright: ignore
    if get_origin(kind) in (Union, types.UnionType):
        return Union[tuple(_within(part, bounds) for part in get_args(kind))]  # noqa: UP007 - of parts made here
    if get_origin(kind) is tuple:
        return tuple[tuple(part if part is ... else _within(part, bounds) for part in get_args(kind))]  # pyright: ignore
    return kind
