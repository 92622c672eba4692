"""What the command line knows by name: scenes with their settings."""

import inspect
import re
import textwrap
from functools import partial
from typing import Any

from jfrnn.cases import fluids
from jfrnn.sph import ranges, settings
from jfrnn.sph.errors import SceneError

WIDTH = 80


def names() -> str:
    """Return the names of all scenes, with a line each."""
    lines = [f"  {name:<14}{_title(settings.SCENES[name], WIDTH - 16)}" for name in settings.SCENES]
    return "\n".join(["Scenes (list SCENE says what --set takes):", *lines])


def scene(name: str) -> str:
    """Return what a scene is, and its settings: default, meaning, range.

    Raises:
        SceneError: There is no such scene.
    """
    if name not in settings.SCENES:
        raise SceneError(f"list {name}: no such scene; there are {', '.join(settings.SCENES)}")
    make = settings.SCENES[name]
    physics = make().physics  # pyright: ignore[reportAttributeAccessIssue]
    of_scene = {key: inspect.signature(make).parameters[key].default for key in settings.parameters(name)}
    of_physics = {key: getattr(physics, key) for key in settings.physics_of(name) if key not in of_scene}
    lines = [f"{name}: {_title(make)}", "", "--set of the scene:", *_settings(name, of_scene, _meanings(make))]
    return "\n".join([*lines, "", "--set of its physics:", *_settings(name, of_physics, _meanings(type(physics)))])


def _settings(scene: str, defaults: dict[str, Any], meanings: dict[str, str]) -> list[str]:
    """Return a line or more for each setting; what its function does not tell, another scene's does."""
    lines, others = [], {}
    alike = sorted(settings.SCENES, key=lambda name: name[:4] != scene[:4])
    for make in (*(settings.SCENES[name] for name in alike), fluids.Scene):
        others = _meanings(make) | others
    for key, default in defaults.items():
        bounds = ranges.of(scene, key)
        shown = f"{default:.6g}" if isinstance(default, float) else "none" if default is None else str(default)
        shown = str(list(default)) if isinstance(default, tuple) else shown
        said = [(others | meanings).get(key, ""), "" if bounds is None else f"({ranges.in_words(bounds)})"]
        lines.append(f"  {key}={shown}")
        margin: Any = dict.fromkeys(("initial_indent", "subsequent_indent"), 6 * " ")
        lines += [textwrap.fill(" ".join(filter(None, said)), WIDTH, break_on_hyphens=False, **margin)] if any(said) else []
    return lines


def _function(make: Any) -> Any:  # noqa: ANN401
    return make.func if isinstance(make, partial) else make


def _title(make: Any, most: int | None = None) -> str:  # noqa: ANN401
    """Return the first line of a docstring, without its "Return"."""
    text = (inspect.getdoc(_function(make)) or "").partition("\n")[0].removeprefix("Return ")
    return text if most is None else textwrap.shorten(text, most, placeholder=" …")


def _meanings(documented: Any) -> dict[str, str]:  # noqa: ANN401
    """Return what a docstring says of each of its arguments, units included."""
    text = (inspect.getdoc(_function(documented)) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", text, re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in found}
