"""Neighbor lists as ASE users call them: structures of atoms, one after another, in NumPy.

A search runs on the CPU in float64, whatever JAX is set to, and compiles nothing anew for another number of atoms or another cell.
Pairs are exact: (i, j, S) is one iff |positions[j] - positions[i] + S @ cell| < cutoff in real arithmetic on the given numbers. ASE
need not be installed for the two functions; its classes are here where it is, with these pairs, and so is every other name of
`ase.neighborlist`, which is ASE's own. The kernel is compiled once on a machine, by the compiler of the package warp-lang, which is
needed. Users of matscipy and vesin find their forms in `jfrnn.matscipy` and `jfrnn.vesin`.

>>> import numpy as np
>>> from jfrnn.ase import primitive_neighbor_list
>>> i, j, d = primitive_neighbor_list("ijd", True, np.eye(3) * 4.0, [[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]], 3.5)
>>> len(i), bool(np.allclose(d, 12**0.5))
(16, True)
"""

from typing import Any

from jfrnn._ase import name_of_ase, neighbor_list, primitive_neighbor_list

__all__ = ["neighbor_list", "primitive_neighbor_list"]


def __getattr__(name: str) -> Any:  # noqa: ANN401
    return name_of_ase(name)
