"""What `jfrnn.ase` has besides its two functions, where ASE is installed."""

import importlib
from typing import Any

_OURS = "NeighborList", "NewPrimitiveNeighborList", "PrimitiveNeighborList", "build_neighbor_list", "use"


def name_of_ase(name: str) -> Any:  # noqa: ANN401
    """Return a class of lists with our pairs, or what `ase.neighborlist` calls by a name."""
    if name.startswith("__"):
        raise AttributeError(name)
    try:
        theirs = importlib.import_module("ase.neighborlist")
    except ImportError as error:
        raise AttributeError(f"module 'jfrnn.ase' has {name!r} only if ASE is installed, which has it: {error}") from error
    module = importlib.import_module("jfrnn._ase.lists") if name in _OURS else theirs
    if not hasattr(module, name):
        raise AttributeError(f"neither 'jfrnn.ase' nor 'ase.neighborlist' has an attribute {name!r}.")
    return getattr(module, name)
