"""Particles brought near a periodic box whose vectors lie along the axes, and how many of these lie between, one text for all."""

import functools

from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel

POINTS_AT_ONCE = 1024  # that a thread of the CPU takes
_BLOCK = 256


@functools.lru_cache(64)
def near_kernel(dim: int, double: bool, told: tuple[tuple[str, int], ...], cuda: bool) -> Kernel:
    """Return the kernel that writes rows of particles for those of cells; `told` are constants that other floors decide."""
    entry = Entry("NearRows.run", _BLOCK if cuda else 1, 6)
    constants = {"CHUNK": POINTS_AT_ONCE, **dict(told)}
    name = f"near_{'cuda' if cuda else 'cpu'}"
    return declare_kind(Kind(dim, double, periodic=1), name, "near_rows.h", entry, cuda=cuda, constants=constants)[0]
