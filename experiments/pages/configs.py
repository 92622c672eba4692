"""The keys of a sweep's config, in words, from the types that check it: tables of them, and a config to begin with."""

import json
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel

from experiments._config import Config, Scenes
from experiments.pages.rows import markdown

_BOUNDS = (("minimum", "at least"), ("exclusiveMinimum", "above"), ("maximum", "at most"), ("exclusiveMaximum", "below"))
_CHOSEN = {"methods": ["warp", "pair-sum", "scipy-kdtree"], "layouts": ["corners", "clusters2"], "fills": [0.02, 0.11]}


def keys(kind: type[BaseModel]) -> list[list[str]]:
    """Return of each key of a table: its name, type, default and meaning, in words."""
    schema = kind.model_json_schema()
    required = schema.get("required", ())
    made = [
        [name, _type(of), "" if name in required else json.dumps(of["default"]), " ".join(of.get("description", "").split())]
        for name, of in schema["properties"].items()
    ]
    return sorted(made, key=lambda key: key[0] not in required)


def _type(of: dict[str, Any]) -> str:
    """Say in words what a JSON schema allows."""
    if "$ref" in of:
        return "table"
    if "enum" in of:
        return " or ".join(json.dumps(value) for value in of["enum"])
    if of["type"] == "array":
        return f"list: {_type(of['items'])}"
    return " ".join([of["type"], *(f"{words} {of[name]:.10g}" for name, words in _BOUNDS if name in of)])


def example() -> str:
    """Return a config of a small sweep that says every key, those with defaults as comments."""
    return "\n".join(
        [
            "# A sweep: every method on every scene, each in a process of its own.",
            *_lines(Config, skip="scenes"),
            "",
            "# Every layout at every fill, and at whatever else is given several times; there may be several such tables.",
            "[[scenes]]",
            *_lines(Scenes),
            "",
        ]
    )


def _lines(kind: type[BaseModel], skip: str = "") -> list[str]:
    lines = []
    for name, words, default, meaning in keys(kind):
        if name != skip:
            given = f"{name} = {json.dumps(_CHOSEN[name])}" if name in _CHOSEN else f"# {name} = {default}"
            lines += [f"# {meaning} ({words})", given]
    return lines


def _table(kind: type[BaseModel]) -> str:
    lines = [
        [f"`{name}`", words, f"`{default}`" if default else "must be given", meaning]
        for name, words, default, meaning in keys(kind)
    ]
    return markdown(("key", "type", "default", "meaning"), lines)


TABLES: dict[str, Callable[[], str]] = {"config-keys": lambda: _table(Config), "config-scenes": lambda: _table(Scenes)}
