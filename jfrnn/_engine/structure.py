"""One structure of atoms after another, on the CPU: NumPy in, NumPy out, in float64, without a program for each number of atoms."""

import ctypes
import functools
import itertools
import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jfrnn._engine.launch import begins_cold
from jfrnn._engine.problem import Inputs, Options
from jfrnn._engine.start import compiler, finish, warn_of_folders
from jfrnn._geometry import Box, Cutoff
from jfrnn.kernels.structure import INTS_PER_ATOM, MORE_INTS, REALS_PER_ATOM, RULES, WRONG, structure_kernel

_FIRST_ROOM = 1 << 14  # pairs
_MOST_PAIRS = 2**31 - 1
_MOST_KEPT = 1 << 18  # pairs whose room is kept for later calls
_COLUMNS = {"first": ("i", (), np.int32), "second": ("j", (), np.int32), "shifts": ("S", (3,), np.int32)}
_COLUMNS |= {"vectors": ("D", (3,), np.float64), "distances": ("d", (), np.float64)}
_kept = threading.local()
_MOST = 4096  # particles that are counted by it
_TIMES = 8  # that a shape comes before it is worth a program
_SHAPES = 4096  # whose times are counted
_asks = itertools.count()  # of counts in a process that was the first to compile any
_seen: "OrderedDict[Any, int]" = OrderedDict()


class Structure(NamedTuple):
    """Atoms in a cell, checked.

    Attributes:
        positions: [n, 3] float64, contiguous, like all arrays here.
        cell: [3, 3] float64 lattice vectors, one per row.
        periodic: [3] int32.
        cutoffs: [1], or [n] radii, or [kinds, kinds], float64.
        rule: Which of these ("one", "radii", "table").
        species: [n] int32 with a table, or None.
    """

    positions: np.ndarray
    cell: np.ndarray
    periodic: np.ndarray
    cutoffs: np.ndarray
    rule: str
    species: np.ndarray | None = None


def find_structure_pairs(given: Structure, with_self: bool, wanted: Collection[str]) -> dict[str, np.ndarray]:
    """Find all pairs of a structure closer than their cutoff, exactly, in ascending order of i; each atom is its own `with_self`.

    Those of the arrays that are wanted come by name: i, j and S [pairs, 3] int64, D [pairs, 3] and d float64. A ValueError says why
    positions or cell cannot be searched.
    """
    n, room = len(given.positions), getattr(_kept, "room", _FIRST_ROOM)
    scratch = np.empty(REALS_PER_ATOM * n), np.empty(INTS_PER_ATOM * n + MORE_INTS, np.int32)
    info = np.zeros(2, np.int64)
    while True:
        columns = _make_room(wanted, room)
        arrays = (given.positions, given.cell, given.cutoffs, given.periodic, given.species, *columns, *scratch, info)
        addresses = (0 if x is None else x.ctypes.data for x in arrays)
        kinds = given.cutoffs.shape[-1] if given.rule == "table" else 0
        function, layout, _ = _function()
        function(layout.pack(*addresses, n, room, RULES[given.rule], kinds, with_self))
        found, wrong = info.tolist()
        if wrong:
            raise ValueError(_SAYS[WRONG[wrong]])
        if found > _MOST_PAIRS:
            raise ValueError(f"the structure has {found} pairs, and at most {_MOST_PAIRS} can be listed: take a smaller cutoff.")
        if found <= room:
            break
        room = found
    names = zip(_COLUMNS.values(), columns, strict=True)
    return {name: x[:found].astype(np.int64 if dtype is np.int32 else dtype) for (name, _, dtype), x in names if x is not None}


def _make_room(wanted: Collection[str], room: int) -> list[np.ndarray | None]:
    """Return arrays for pairs, of which small ones are kept by each thread."""
    if getattr(_kept, "room", -1) != room:
        _kept.columns, _kept.room = {}, min(room, _MOST_KEPT)
    made: list[np.ndarray | None] = []
    for name, shape, dtype in _COLUMNS.values():
        column = _kept.columns.get(name) if room == _kept.room else None
        if column is None and name in wanted:
            column = np.empty((room, *shape), dtype)
            if room == _kept.room:
                _kept.columns[name] = column
        made.append(column if name in wanted else None)
    return made


_SAYS = {
    "not finite": "positions must be finite: remove what is NaN or infinite.",
    "too far": "positions and cutoffs must span at most 1 048 576 cells, whole numbers of lattice vectors between atoms below "
    "2³⁰, and coordinates at most 1e140: wrap positions into the cell, give shorter vectors, or take a smaller cutoff.",
    "degenerate": "lattice vectors of periodic axes must be finite and linearly independent: pass others, or pbc=False.",
}


@functools.cache
def _begin() -> Future[Path] | None:
    """Let another thread compile the kernel; return what waits for it, or None if a file of it is kept."""
    return compiler().begin(structure_kernel().program)


def _is_there() -> bool:
    """Say whether a count may take the kernel: where kernels were compiled by no process before, only when it is compiled.

    Who asks first does so in a first search, which waits for others: it begins with the second.
    """
    if not begins_cold():
        return True
    if next(_asks) == 0:
        return False
    begun = _begin()
    return begun is None or begun.done()


@functools.cache
def _function() -> tuple[Callable[[bytes], Any], struct.Struct, Any]:
    """Return what runs the kernel, given the bytes of its arguments, how these are packed, and what has to live as long."""
    kernel = structure_kernel()
    finish(_begin)
    library = compiler().load(kernel.program)
    warn_of_folders()
    pointers = sum(field.is_array for field in kernel.fields)
    layout = struct.Struct(f"={pointers}q{len(kernel.fields) - pointers}i")
    return ctypes.CFUNCTYPE(None, ctypes.c_char_p)(library.address_of(kernel.name)), layout, library


# --- how many neighbors few particles have ----------------------------------------------------------------------------
# A compiled count takes a tenth of a second to make and hardly any time to run. For shapes that come a few times, as in a data set
# of crystals, it would be compiled for nothing.


def count_few(inputs: Inputs, options: Options) -> np.ndarray | None:
    """Return the number of neighbors of each particle, [n] int64; None where a compiled program is to count.

    It counts in plain searches of few concrete particles by an engine whose kernels run here, once the kernel is compiled.
    """
    sources, queries, active, box, cutoff, batch, exclude, *_ = inputs
    n = sources.shape[0]
    plain = queries is None and active is None and batch is None and exclude is None
    if (
        not plain
        or not isinstance(cutoff, Cutoff)
        or not options.engine.native
        or options.closed
        or not 0 < n <= _MOST
        or (box is not None and box.per_system)
    ):
        return None
    shape = n, sources.shape[1], sources.dtype.name, options
    _seen[shape] = times = _seen.pop(shape, 0) + 1
    while len(_seen) > _SHAPES:
        _seen.popitem(last=False)
    if times > _TIMES or not _is_there():
        return None
    known = [np.asarray(jax.device_get(x)) for x in (sources, *([] if box is None else [box.vectors]))]
    try:
        found = find_structure_pairs(_structure(known, box, float(cutoff.radius)), not options.filter.drop_self, "ijS")
    except ValueError:  # positions that are not finite, or a box that is none: a program sets the bit
        return None
    i, j, shifts = found["i"], found["j"], found["S"]
    if options.filter.later_only:
        ahead = np.sign(shifts) @ np.array([4, 2, 1]) >= 0  # the first number that is not 0 decides
        i = i[(j > i) | ((j == i) & ahead)]
    return np.bincount(i, minlength=n)


def _structure(known: list[Any], box: Box | None, radius: float) -> Structure:
    x = known[0].astype(np.float64)
    more = 3 - x.shape[1]
    vectors, periodic = np.eye(3), np.zeros(3, np.int32)
    if box is not None:
        given = known[1].astype(np.float64)
        vectors[: box.dim, : box.dim] = np.diag(given) if box.orthogonal else given
        periodic[: box.dim] = box.periodic
    x = np.pad(x, ((0, 0), (0, more)))
    return Structure(np.ascontiguousarray(x), vectors, periodic, np.array([radius]), "one")
