"""What a run may be told: the name of a scene, and `--set key=value` for it."""

import hashlib
import inspect
import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import jax
import numpy as np

from jfrnn.cases import fluids
from jfrnn.cases.fluids import Scene
from jfrnn.sph import ranges
from jfrnn.sph.check import PHYSICS, PHYSICS_OF_GASES, check_scene
from jfrnn.sph.errors import SceneError

SCENES: dict[str, Callable[..., Scene]] = {**fluids.FLUIDS, **fluids.GASES}


def make_scene(name: str, settings: list[str]) -> Scene:
    """Return a scene with settings "key=value": of the scene's function, or of its physics.

    Raises:
        SceneError: There is no such scene or key, the value is out of its range, or values do not go together.
    """
    of_scene, of_physics = parameters(name), physics_of(name)
    chosen: dict[str, dict[str, Any]] = {"scene": {}, "physics": {}}
    for setting in settings:
        key, sign, text = setting.partition("=")
        if not sign:
            raise SceneError(f"--set {setting}: expected key=value")
        if key not in of_scene and key not in of_physics:
            raise SceneError(f"--set {key}: unknown; of {name}: {', '.join(of_scene)}; physics: {', '.join(of_physics)}")
        kind = "scene" if key in of_scene else "physics"
        chosen[kind][key] = _value(name, key, text, of_scene.get(key, of_physics.get(key)))
    said = "".join(f" --set {setting}" for setting in settings)
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused below
            scene: Any = SCENES[name](**chosen["scene"])
    except (ValueError, ZeroDivisionError, OverflowError, MemoryError) as error:
        raise SceneError(f"scene {name!r}{said}: cannot be made ({error})") from error
    scene = replace(scene, physics=replace(scene.physics, **chosen["physics"]))
    try:
        check_scene(scene)
    except SceneError as error:
        raise SceneError(f"scene {name!r}{said}: {error}") from error
    return scene


def parameters(name: str) -> dict[str, Any]:
    """Return the settings of a scene's function with their annotations.

    Raises:
        SceneError: There is no such scene.
    """
    if name not in SCENES:
        raise SceneError(f"unknown fluid scene {name!r}; allowed: {', '.join(SCENES)}")
    return {key: item.annotation for key, item in inspect.signature(SCENES[name]).parameters.items() if key != "name"}


def physics_of(name: str) -> dict[str, Any]:
    """Return the settings of the physics of a scene, by its name, with their annotations."""
    return PHYSICS_OF_GASES if name in fluids.GASES else PHYSICS


def _value(scene: str, key: str, text: str, kind: Any) -> Any:  # noqa: ANN401
    try:
        value = json.loads(text)
    except ValueError:
        value = None if text.lower() == "none" else text
    try:
        return ranges.read(kind, value, ranges.of(scene, key), strict=isinstance(value, bool))
    except ValueError as error:
        raise SceneError(f"--set {key}: got {text!r}; {error}") from error


def describe(scene: Scene) -> dict[str, Any]:
    """Return what a run must have in common with one that it goes on with: all of a scene but what pictures show."""
    return {"particles": scene.n} | _describe(replace(scene, bounds=None))


def _describe(value: Any) -> Any:  # noqa: ANN401
    """Return a value as JSON holds it: 12 hex digits stand for what is in an array."""
    if is_dataclass(value):
        return {item.name: _describe(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, tuple | list):
        return [_describe(part) for part in value]
    if not isinstance(value, np.ndarray | np.generic | jax.Array):
        return value
    known = np.ascontiguousarray(value)
    return known.item() if np.ndim(value) == 0 else hashlib.sha256(known.tobytes()).hexdigest()[:12]
