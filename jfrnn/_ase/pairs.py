"""Pairs of one structure of atoms after another, from and to arrays of NumPy, with the arguments of ASE's functions."""

import importlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np

from jfrnn._engine import Structure, find_structure_pairs

Given = Any  # what users pass: numbers, arrays, lists
Arrays = np.ndarray | tuple[np.ndarray, ...]
_SYMBOLS = (
    "X H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb Mo "
    "Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl "
    "Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og"
)
_FARTHEST = 1e145  # as good as infinite: coordinates are below 1e140
_NUMBERS = {symbol: number for number, symbol in enumerate(_SYMBOLS.split())}


def neighbor_list(
    quantities: str,
    a: Given = None,
    cutoff: Given = None,
    self_interaction: bool = False,
    max_nbins: Given = None,
    *,
    atoms: Given = None,
    positions: Given = None,
    cell: Given = None,
    pbc: Given = None,
    numbers: Given = None,
) -> Arrays:
    """Find all pairs of a structure closer than a cutoff, as `ase.neighborlist.neighbor_list` and matscipy's `neighbour_list` do.

    A structure is given as atoms, or as positions with a cell.

    Args:
        quantities: Letters of what is returned, in this order, or none: "i" and "j" the atoms of a pair, [pairs] int64; "S" by how
            many lattice vectors j is moved, [pairs, 3] int64; "D" positions[j] - positions[i] + S @ cell [length], [pairs, 3]
            float64; "d" its length, [pairs].
        a: `ase.Atoms`, or anything with `positions` [n, 3], `cell` [3, 3], `pbc` and `numbers` [n]. Vectors of axes that are not
            periodic may be anything, also 0. Atoms may lie outside the cell, which may have any skew or handedness.
        cutoff: A number [length]; or a dictionary of cutoffs of pairs of species, {("H", "O"): 1.2, (6, 6): 2.0}, in which absent
            pairs have none; or radii of all atoms, an array [n]: pairs are then closer than the sum of their radii. Nothing is
            closer than a negative cutoff; one that is infinite finds all pairs of an open structure.
        self_interaction: List each atom as its own neighbor, with S = 0, where a pair of its kind may be neighbors at all.
        max_nbins: Not used; it stands here as ASE has it.
        atoms: The name that matscipy has for a.
        positions: In place of atoms: positions [length], shape [n, 3].
        cell: With positions: lattice vectors [length], one per row, shape [3, 3]; or edge lengths, shape [3]; None: open space.
        pbc: With positions: whether axes are periodic, a bool or three; default: none is.
        numbers: With positions: species of the atoms, shape [n], integers; for a dictionary of cutoffs.

    Returns:
        A tuple of arrays, or one array for one letter. Pairs stand both ways, (i, j) and (j, i), in ascending order of i.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range.
        ImportError: warp-lang is not installed. RuntimeError: its compiler does not run here.

    Memory: what is returned, the same once more, and 100 B per atom. Source: cell lists (Hockney & Eastwood 1981, ch. 8); short
    lattice vectors (Semaev 2001, doi:10.1007/3-540-44670-2_13).
    """
    arrays = {"positions": positions, "cell": cell, "pbc": pbc, "numbers": numbers}
    given = [name for name, x in {"a": a, "atoms": atoms, **arrays}.items() if x is not None]
    if cutoff is None:
        raise TypeError("cutoff must be given: a number, a dictionary, or radii of all atoms.")
    if a is None and atoms is None and positions is not None:
        periodic = False if pbc is None else pbc
        if cell is None and np.any(np.asarray(periodic)):
            raise ValueError(f"pbc={pbc!r} needs cell, the lattice vectors of the periodic axes.")
        vectors = np.eye(3) if cell is None else cell
        return primitive_neighbor_list(quantities, periodic, vectors, positions, cutoff, numbers, self_interaction)
    if len(given) != 1 or positions is not None:
        told = ", ".join(given) or "nothing"
        raise TypeError(f"pass atoms, or positions= with cell=, pbc= and numbers= of the same structure, got {told}.")
    a = atoms if a is None else a
    missing = [name for name in ("positions", "cell", "pbc", "numbers") if not hasattr(a, name)]
    if missing:
        raise TypeError(
            f"a must be ase.Atoms, or have positions, cell, pbc and numbers; {type(a).__name__} lacks {', '.join(missing)}."
        )
    return primitive_neighbor_list(quantities, a.pbc, a.cell, a.positions, cutoff, a.numbers, self_interaction)


def primitive_neighbor_list(
    quantities: str,
    pbc: Given,
    cell: Given,
    positions: Given,
    cutoff: Given,
    numbers: Given = None,
    self_interaction: bool = False,
    use_scaled_positions: bool = False,
    max_nbins: Given = None,
) -> Arrays:
    """Find all pairs of a structure that is given by arrays, as `ase.neighborlist.primitive_neighbor_list` does.

    Args:
        quantities: As in `neighbor_list`.
        pbc: Whether axes are periodic: a bool, or three.
        cell: Lattice vectors [length], one per row, shape [3, 3]; or edge lengths, shape [3].
        positions: Positions [length], shape [n, 3].
        cutoff: As in `neighbor_list`.
        numbers: Atomic numbers, or any other numbers of species, shape [n], integers; for a dictionary of cutoffs.
        self_interaction: As in `neighbor_list`.
        use_scaled_positions: Positions count lattice vectors; what is searched is positions @ cell.
        max_nbins: Not used.

    Returns:
        As `neighbor_list`.

    Raises:
        TypeError, ValueError: as `neighbor_list`.
    """
    if not isinstance(quantities, str | list | tuple) or set(quantities) - set("ijdDS"):
        raise ValueError(f"quantities must be letters of 'ijdDS', as in 'ijS', got {quantities!r}.")
    x = _array("positions", positions, "real numbers of shape [n, 3]")
    x = x.reshape(0, 3) if x.shape == (0,) else x
    vectors = _array("cell", cell, "real numbers of shape [3, 3]")
    vectors = np.diag(vectors) if vectors.ndim == 1 else vectors
    if x.ndim != 2 or x.shape[1] != 3 or vectors.shape != (3, 3):
        raise ValueError(
            f"positions must have shape [n, 3] and cell [3, 3] or [3], got {list(x.shape)} and {list(np.shape(cell))}: atoms in 2D "
            "take a third coordinate of 0."
        )
    x = x @ vectors if use_scaled_positions else x
    cutoffs, rule, species = _cutoffs(cutoff, len(x), numbers)
    periodic = _flags(pbc) * (len(x) > 0)  # where there are no atoms, any cell will do
    structure = Structure(x, np.ascontiguousarray(vectors), periodic, np.minimum(cutoffs, _FARTHEST), rule, species)
    found = find_structure_pairs(structure, bool(self_interaction), quantities)
    arrays = tuple(found[name] for name in quantities)
    return arrays[0] if len(arrays) == 1 else arrays


def half_of(i: np.ndarray, j: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Say of which pairs (i, j, S) the other way is not listed: those whose S has a positive number first, or S = 0 and i <= j."""
    x, y, z = shifts.T
    ahead = np.where(x != 0, x, np.where(y != 0, y, z))
    return np.where(ahead != 0, ahead > 0, i <= j)


def check_number(cutoff: Given, pair: Given = None) -> float:
    """Return one cutoff, of a pair of species if that is given.

    Raises:
        TypeError, ValueError: it is no number.
    """
    of_pair = "" if pair is None else f" for {pair!r}"
    value = _array("cutoff", cutoff, f"a number [length]{of_pair}")
    if value.ndim:
        raise TypeError(f"cutoff must be a number [length]{of_pair}, got shape {list(value.shape)}.")
    if np.isnan(value):
        raise ValueError(f"cutoff must be a number [length], got {cutoff!r}{of_pair}.")
    return float(value)


def _array(name: str, value: Given, what: str) -> np.ndarray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"dtype {array.dtype}")
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be {what}, got {type(value).__name__} ({error}).") from error
    return np.asarray(array, np.float64, order="C")


def _flags(pbc: Given) -> np.ndarray:
    flags = np.asarray(pbc)
    if flags.shape not in ((), (3,)) or flags.dtype.kind not in "biuf":
        raise ValueError(f"pbc must be one bool or three, got {pbc!r}.")
    return np.ascontiguousarray(np.broadcast_to(flags.astype(bool), 3), np.int32)


def _cutoffs(cutoff: Given, n: int, numbers: Given) -> tuple[np.ndarray, str, np.ndarray | None]:
    """Return cutoffs, the rule by which pairs have them, and species with a table of cutoffs."""
    if isinstance(cutoff, defaultdict) and cutoff.default_factory is not None:
        made = cutoff.default_factory()
        if any(value != made for value in cutoff.values()):  # matscipy reads the default alone, ASE the values alone
            raise ValueError(
                f"cutoff must not be a defaultdict of {made!r} with other values, got {dict(cutoff)!r}: pass a dict of all pairs."
            )
        cutoff = made
    if isinstance(cutoff, Mapping):
        return _table(cutoff, n, numbers)
    values = _array("cutoff", cutoff, "a number [length], a dictionary of numbers, or radii of all atoms")
    if not values.ndim:
        return np.array([check_number(cutoff)]), "one", None
    if values.shape != (n,):
        raise ValueError(
            f"cutoff must be a number, a dictionary, or radii of shape [{n}], one per atom, got shape {list(values.shape)}."
        )
    if len(bad := np.flatnonzero(np.isnan(values))):
        raise ValueError(f"cutoff must hold numbers, got {values[bad[0]]:g} for atom {bad[0]}.")
    return values, "radii", None


def _table(cutoff: Mapping, n: int, numbers: Given) -> tuple[np.ndarray, str, np.ndarray]:
    given = np.asarray(numbers) if numbers is not None else np.zeros(0)
    if given.shape != (n,) or (n and given.dtype.kind not in "iuf"):
        raise ValueError(
            f"a dictionary of cutoffs needs numbers, integers of shape [{n}], the species of each atom, got {numbers!r}."
        )
    kinds, species = np.unique(given, return_inverse=True)
    places = {kind: place for place, kind in enumerate(kinds.tolist())}
    table = np.zeros((len(kinds), len(kinds)))
    for pair, value in cutoff.items():
        names = tuple(pair) if isinstance(pair, Iterable) else ()
        if len(names) != 2 or not all(isinstance(x, Real) or x in _NUMBERS for x in names):
            raise ValueError(f"keys of cutoff must be pairs of symbols or numbers, as in ('C', 'H') or (6, 1), got {pair!r}.")
        number = check_number(value, pair)
        a, b = (places.get(_NUMBERS.get(x, x), -1) for x in names)
        if min(a, b) >= 0:
            table[a, b] = table[b, a] = number
    return table, "table", np.ascontiguousarray(species, np.int32)


# --- what `jfrnn.ase` has besides its two functions, where ASE is installed -------------------------------------------

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
