"""The neighbor list of vesin, by those of `jfrnn.ase`: `NeighborList` and `ase_neighbor_list`. vesin need not be installed.

>>> from jfrnn.vesin import NeighborList
>>> box, points = [[3, 0, 0], [0, 3, 0], [0, 0, 3]], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
>>> NeighborList(cutoff=1.5, full_list=False).compute(points, box, False, "P")
(array([[0, 1]], dtype=uint64),)
"""

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from jfrnn._ase import check_number, half_of, neighbor_list, primitive_neighbor_list

__all__ = ["NeighborList", "ase_neighbor_list"]

Given = Any  # what users pass: numbers, arrays, lists
_NAMES = {"positions": "points", "cell": "box", "pbc": "periodic"}  # what vesin calls the arguments of ASE
_DTYPES = {"i": np.uint64, "j": np.uint64, "P": np.uint64, "S": np.int32}


class NeighborList:
    """A search with one cutoff, as `vesin.NeighborList`."""

    def __init__(
        self,
        *,
        cutoff: float,
        full_list: bool,
        sorted: bool = False,
        algorithm: str = "auto",
        skin: float = 0.0,
        n_threads: int = 0,
    ) -> None:
        """Say what is searched.

        Args:
            cutoff: The cutoff [length].
            full_list: Whether pairs stand both ways; else of (i, j, S) and (j, i, -S) the one whose S has a positive number first,
                and of S = 0 the one with i < j.
            sorted: Not used: pairs always ascend by i.
            algorithm: Not used: "auto", "brute_force" or "cell_list".
            skin: Not used: each search is a new one.
            n_threads: Not used; at least 0.
        """
        self.cutoff, self.full_list, self.sorted = check_number(cutoff), bool(full_list), bool(sorted)
        self.algorithm, self.skin, self.n_threads = algorithm.lower(), float(skin), int(n_threads)
        if not 0 <= self.cutoff < math.inf:
            raise ValueError(f"cutoff must be finite and at least 0, got {cutoff!r}.")
        if self.n_threads < 0:
            raise ValueError(f"n_threads must be at least 0, got {n_threads!r}.")
        if self.algorithm not in ("auto", "brute_force", "cell_list"):
            raise ValueError(f"algorithm must be 'auto', 'brute_force' or 'cell_list', got {algorithm!r}.")

    def compute(
        self, points: Given, box: Given, periodic: Given, quantities: str = "ij", copy: bool = True
    ) -> tuple[np.ndarray, ...]:
        """Find the pairs of a structure.

        Args:
            points: Positions [length], shape [n, 3], of NumPy; tensors of PyTorch and arrays of CuPy are refused.
            box: Lattice vectors [length], one per row, shape [3, 3].
            periodic: Whether axes are periodic, a bool or three.
            quantities: Letters of "ijSDd", as in `jfrnn.ase.neighbor_list`, and "P", i and j side by side, [pairs, 2].
            copy: Not used: what is returned is the caller's.

        Returns:
            A tuple of arrays: i, j and P uint64, S int32, D and d of the dtype of points if they are floats, or else float64.

        Raises:
            TypeError, ValueError: an argument is of the wrong kind, shape or range.
        """
        if type(points).__module__.split(".")[0] in ("torch", "cupy"):
            raise TypeError(
                f"points must be an array of NumPy, got {type(points).__name__}: pass points.cpu().numpy(), or use vesin."
            )
        given = np.asarray(points).dtype
        real = given if given.kind == "f" else np.dtype(np.float64)

        def find(names: str) -> Given:
            try:
                return primitive_neighbor_list(names, periodic, box, points, self.cutoff)
            except (TypeError, ValueError) as error:
                told = re.sub(rf"\b({'|'.join(_NAMES)})\b", lambda name: _NAMES[name[0]], str(error))
                raise type(error)(told) from error

        return _arrays(quantities, find, real, self.full_list)


def ase_neighbor_list(quantities: str, *args: Given, **kwargs: Given) -> tuple[np.ndarray, ...]:
    """Find pairs as `jfrnn.ase.neighbor_list` does, with the same arguments; the result is as that of `NeighborList.compute`."""
    return _arrays(quantities, lambda names: neighbor_list(names, *args, **kwargs), np.dtype(np.float64))


def _arrays(quantities: Given, find: Callable[[str], Given], real: np.dtype, full_list: bool = True) -> tuple[np.ndarray, ...]:
    """Return arrays as vesin has them, of pairs that are found by letters."""
    if set(quantities) - set("ijPSDd"):
        raise ValueError(f"quantities must be letters of 'ijPSDd', as in 'ijS', got {quantities!r}.")
    names = "".join(dict.fromkeys(("i", "j", "S", *quantities))).replace("P", "")
    found = dict(zip(names, find(names), strict=True))
    if not full_list:
        used = half_of(found["i"], found["j"], found["S"])
        found = {name: x[used] for name, x in found.items()}
    found["P"] = np.stack([found["i"], found["j"]], axis=1)
    return tuple(found[name].astype(_DTYPES.get(name, real), copy=False) for name in quantities)
