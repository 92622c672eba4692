"""The neighbor lists of matscipy, by those of `jfrnn.ase`: `neighbour_list` and `coordination`.

matscipy need not be installed. Where it is, every other name of `matscipy.neighbours` is found here, too: it is matscipy's own.
Its `first_neighbours` and `triplet_list` work on these lists.

>>> from jfrnn.matscipy import neighbour_list
>>> neighbour_list("ij", positions=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], cutoff=1.5)
(array([0, 1], dtype=int32), array([1, 0], dtype=int32))
"""

import importlib
from typing import Any

import numpy as np

from jfrnn._ase import neighbor_list

__all__ = ["coordination", "neighbour_list"]

Given = Any  # what users pass: numbers, arrays, lists


def neighbour_list(
    quantities: str,
    atoms: Given = None,
    cutoff: Given = None,
    positions: Given = None,
    cell: Given = None,
    pbc: Given = None,
    numbers: Given = None,
    cell_origin: Given = None,
) -> np.ndarray | tuple[np.ndarray, ...]:
    """Find all pairs of a structure closer than a cutoff, as `matscipy.neighbours.neighbour_list` does.

    Args:
        quantities: As in `jfrnn.ase.neighbor_list`, and so are atoms, cutoff, positions, cell, pbc and numbers.
        atoms: Or else positions.
        cutoff: A number [length], a dictionary of cutoffs of pairs of species, or radii of all atoms.
        positions: [length], shape [n, 3].
        cell: Lattice vectors [length], one per row, shape [3, 3]; default: open space.
        pbc: Whether axes are periodic; default: none is.
        numbers: Species of the atoms, shape [n], integers; default: all 1.
        cell_origin: A corner of the cell, which changes no pair.

    Returns:
        As `jfrnn.ase.neighbor_list`; indices and shifts are int32, as in matscipy.

    Raises:
        TypeError, ValueError: as `jfrnn.ase.neighbor_list`.
    """
    if positions is not None and numbers is None:
        numbers = np.ones(len(positions), np.int32)
    given = {"atoms": atoms, "positions": positions, "cell": cell, "pbc": pbc, "numbers": numbers}
    found = neighbor_list(quantities, cutoff=cutoff, **given)
    parts = [x.astype(np.int32) if x.dtype.kind == "i" else x for x in (found if isinstance(found, tuple) else (found,))]
    return parts[0] if len(parts) == 1 else tuple(parts)


def coordination(structure: Given, cutoff: Given) -> np.ndarray:
    """Return how many neighbors each atom has within a cutoff, up to the last atom that has any, [n] int64."""
    return np.bincount(neighbour_list("i", structure, cutoff))


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if not name.startswith("__"):
        try:
            return getattr(importlib.import_module("matscipy.neighbours"), name)
        except ImportError as error:
            raise AttributeError(
                f"module 'jfrnn.matscipy' has {name!r} only if matscipy is installed and has it: {error}"
            ) from error
    raise AttributeError(name)
