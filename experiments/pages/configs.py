"""The tables of what a config of a sweep may say, made from the types that check it."""

from collections.abc import Callable

from pydantic import BaseModel

from experiments._config import Config, Scenes
from experiments._keys import keys
from experiments.pages.rows import markdown


def _table(kind: type[BaseModel]) -> str:
    lines = [
        [f"`{name}`", words, f"`{default}`" if default else "must be given", meaning]
        for name, words, default, meaning in keys(kind)
    ]
    return markdown(("key", "type", "default", "meaning"), lines)


TABLES: dict[str, Callable[[], str]] = {"config-keys": lambda: _table(Config), "config-scenes": lambda: _table(Scenes)}
