"""Adapters: one file per method, found by its file name (`scipy_kdtree.py` is the method `scipy-kdtree`).

An adapter is a module with

- `prepare(positions, cutoff)`: do what is needed once (compile, say) and return the search, a callable without arguments whose
  every call goes from the raw positions to the finished result, waits for it, and builds whatever structure it needs anew; on a
  GPU positions are there already, as in a simulation (`at_hand`);
- `read(result)`: return what the search found, a `Found`; not timed;
- optionally `allocate(positions, cutoff)`: return the capacity that the scene needs; `prepare` then takes it as third argument;
- optionally `follow(positions, cutoff, motion)` instead of `prepare`, for methods that keep something between searches: a callable
  that moves every particle by `motion` `STEPS` times and searches after each, as `_moving` says; times are per search;
- optionally `plan(positions, cutoff, capacity)`: what `jfrnn.memory_plan` says of the search;
- optionally `MAX_POINTS`: larger scenes are skipped, with a row that says so;
- optionally `PACKAGES`: names of distributions whose versions the row shall hold besides the usual ones.

Positions come as NumPy array, shape [n, d], float32 or float64; the cutoff is a float, already rounded to that dtype. An adapter
that cannot be imported makes a row with status `missing`, one that raises makes a row with status `failed`.
"""

import ast
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

HOW_TO_INSTALL = "make peers; apt-get install g++ libann-dev libnanoflann-dev"


@dataclass(frozen=True)
class Found:
    """What a method found, for the comparison with the oracle.

    Attributes:
        list_bytes: Size of the result itself [bytes].
        pairs: Indices (i, j) of the pairs, as the method gives them.
        directed: Whether `pairs` holds both (i, j) and (j, i).
        counts: Neighbors of each particle without itself, shape [n]; for methods that give no pairs.
        device: Where it ran.
        parts: Median seconds of the parts of a search, by name; empty where they cannot be told apart.
        density: Sums of a poly6 kernel that the method made itself, `_accuracy` says which; shape [n].
        rebuilt: Share of the searches that made a list anew, of methods that keep one.
        positions: Where the particles were at last, if the method moved them; shape [n, d].
        total: How many pairs there are, where `pairs` holds those of the compared particles alone.
    """

    list_bytes: int
    pairs: tuple[np.ndarray, np.ndarray] | None = None
    directed: bool = False
    counts: np.ndarray | None = None
    device: str = "cpu"
    parts: dict[str, float] = field(default_factory=dict)
    density: np.ndarray | None = None
    rebuilt: float | None = None
    positions: np.ndarray | None = None
    total: int | None = None


class Adapter(Protocol):
    """The shape of an adapter module."""

    def prepare(self, positions: np.ndarray, cutoff: float, *capacity: int) -> Callable[[], Any]:
        """Return the search over these positions."""
        ...

    def read(self, result: object) -> Found:
        """Return what a search found."""
        ...


def names() -> list[str]:
    """Return the names of all methods, without importing any."""
    return sorted(file.stem.replace("_", "-") for file in Path(__file__).parent.glob("[!_]*.py"))


def lacks(name: str) -> str | None:
    """Say what a method needs that is not installed, None where nothing is missing: found out without importing the method.

    A name of no method is that of a package.
    """
    return _lacks(f"{__name__}.{name.replace('-', '_')}") if name in names() else _lacks_package(name)


@cache
def _lacks(module: str) -> str | None:
    """Look at what a module imports and loads, and at what the modules beside it that it imports do."""
    text = (Path(__file__).parent / f"{module.rpartition('.')[2]}.py").read_text(encoding="utf-8")
    for node in ast.parse(text).body:
        named = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else named
        reasons = [_lacks(each) if each.startswith(f"{__name__}.") else _lacks_package(each) for each in named]
        if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("_native.load("):
            reasons.append(_lacks_native(node.value))
        if any(reasons):
            return next(filter(None, reasons))
    return None


def _lacks_package(imported: str) -> str | None:
    package = imported.partition(".")[0]
    return None if find_spec(package) else f"no module named {package!r}"


def _lacks_native(call: ast.expr) -> str | None:
    """Say why the adapter of a call of `_native.load` cannot be compiled, None where it can, or has been."""
    from experiments import _native

    assert isinstance(call, ast.Call), "as the caller has seen"
    try:
        _native.load(*map(ast.literal_eval, call.args))
    except ImportError as error:
        return str(error)
    return None


def load(name: str) -> Adapter:
    """Import the adapter of a method; its ImportError is the caller's."""
    return cast(Adapter, import_module(f"{__name__}.{name.replace('-', '_')}"))


def at_hand(positions: np.ndarray) -> Any:  # noqa: ANN401
    """Return positions where JAX works, so that no search brings them to a GPU: at a million that takes longer than to search."""
    import jax

    return positions if jax.default_backend() == "cpu" else jax.device_put(positions)
