"""ASE's classes of neighbor lists with our pairs, and ASE's calculators on them."""

import contextlib
import sys
import types
from typing import Any

import numpy as np
from ase import Atoms
from ase import neighborlist as theirs
from ase.cell import Cell

from jfrnn._ase.pairs import half_of, neighbor_list, primitive_neighbor_list

Given = Any  # what users pass: numbers, arrays, lists


class NewPrimitiveNeighborList(theirs.NewPrimitiveNeighborList):
    """`ase.neighborlist.NewPrimitiveNeighborList` with exact pairs.

    Arguments and methods are ASE's. Without `bothways`, of (i, j, S) and (j, i, -S) the one is listed whose S has a positive number
    first, and of S = 0 the one with i <= j. With `sorted`, neighbors ascend by j, then S.
    """

    def build(self, pbc: Given, cell: Given, positions: Given, numbers: Given = None) -> None:
        """Find the pairs within cutoffs and skin."""
        self.pbc, self.cell, self.positions = (np.array(x) for x in (pbc, cell, positions))
        more = numbers, self.self_interaction, self.use_scaled_positions
        found = primitive_neighbor_list("ijS", pbc, cell, positions, np.asarray(self.cutoffs), *more)
        if not self.bothways:
            used = half_of(*found)
            found = [x[used] for x in found]
        if self.sorted:
            order = np.lexsort((*found[2].T[::-1], found[1], found[0]))
            found = [x[order] for x in found]
        self.pair_first, self.pair_second, self.offset_vec = found
        self.first_neigh = np.searchsorted(self.pair_first, np.arange(len(positions) + 1))
        self.nupdates += 1

    def get_neighbors(self, a: Given) -> tuple[np.ndarray, np.ndarray]:
        """Return the neighbors of an atom, -1 being the last, and by how many lattice vectors they are moved."""
        return super().get_neighbors(range(len(self.positions))[a])

    @property
    def neighbors(self) -> list[np.ndarray]:
        """Neighbors of each atom."""
        return np.split(self.pair_second, self.first_neigh[1:-1])[: len(self.positions)]

    @property
    def displacements(self) -> list[np.ndarray]:
        """By how many lattice vectors the neighbors of each atom are moved."""
        return np.split(self.offset_vec, self.first_neigh[1:-1])[: len(self.positions)]


class PrimitiveNeighborList(NewPrimitiveNeighborList, theirs.PrimitiveNeighborList):
    """`ase.neighborlist.PrimitiveNeighborList` with the pairs of `NewPrimitiveNeighborList`."""

    def update(self, pbc: Given, cell: Given, coordinates: Given) -> bool:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Find the pairs anew where an atom moved by more than the skin; return whether that was so."""
        return super().update(pbc, cell, coordinates)

    def build(self, pbc: Given, cell: Given, coordinates: Given, numbers: Given = None) -> None:  # pyright: ignore
        """Find the pairs within cutoffs and skin."""
        super().build(pbc, cell, coordinates, numbers)
        self.cell, self.coordinates = Cell(self.cell), self.positions


class NeighborList(theirs.NeighborList):
    """`ase.neighborlist.NeighborList` with exact pairs: arguments, methods and meaning are ASE's."""

    def __init__(self, cutoffs: Given, *args: Given, primitive: Given = PrimitiveNeighborList, **kwargs: Given) -> None:
        super().__init__(cutoffs, *args, primitive=primitive, **kwargs)


def build_neighbor_list(atoms: Atoms, cutoffs: Given = None, **kwargs: Given) -> theirs.NeighborList:
    """Make a list of ASE's and update it; arguments are those of `ase.neighborlist.build_neighbor_list`."""
    return theirs.build_neighbor_list(atoms, cutoffs, **{"primitive": PrimitiveNeighborList} | kwargs)


def use() -> contextlib.ExitStack:
    """Let ASE's calculators, and all that has been imported, search by jfrnn.

    From this call on, `ase.neighborlist` has our functions and classes under its own names, also where they have been imported from
    there by now, and where they are defaults of arguments, as in a new `NeighborList` of ASE. Lists and calculators that exist stay
    as they are. The call may stand alone; what it returns undoes it, at the end of a `with` or by `close()`.

    Returns:
        A context manager.
    """
    undo = contextlib.ExitStack()
    pairs = [(theirs.neighbor_list, neighbor_list), (theirs.primitive_neighbor_list, primitive_neighbor_list)]
    pairs += [(theirs.PrimitiveNeighborList, PrimitiveNeighborList), (theirs.NewPrimitiveNeighborList, NewPrimitiveNeighborList)]
    new = {id(old): ours for old, ours in pairs}
    for module in [module for name, module in sys.modules.items() if name.partition(".")[0] != "jfrnn"]:
        names = getattr(module, "__dict__", {})
        for name in [name for name, value in names.items() if id(value) in new]:
            undo.callback(names.__setitem__, name, names[name])
            names[name] = new[id(names[name])]
        kinds = [names, *(vars(value) for value in names.values() if issubclass(type(value), type))]
        for function in [value for kind in kinds for value in kind.values() if type(value) is types.FunctionType]:
            old = function.__defaults__ or ()
            if any(id(value) in new for value in old):
                undo.callback(setattr, function, "__defaults__", old)
                function.__defaults__ = tuple(new.get(id(value), value) for value in old)
    return undo
