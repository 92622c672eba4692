"""Particles brought near a periodic box, and how many of its vectors lie between, one text for CPU and CUDA."""

import functools

from jfrnn.kernels._native import SKEWED, Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel

POINTS_AT_ONCE = 1024  # that a thread of the CPU takes
_BLOCK, _BLOCKS = 256, 6  # of CUDA, and how many share a multiprocessor


def threads(n: int, multiprocessors: int) -> int:
    """Return how many threads look at n points: all are at work at once."""
    return min(n, _BLOCKS * _BLOCK * multiprocessors)


@functools.lru_cache(64)
def near_kernel(dim: int, double: bool, skewed: bool, told: tuple[tuple[str, int], ...], cuda: bool) -> Kernel:
    """Return the kernel that writes rows of particles for those of cells; `told` are constants that other floors decide."""
    entry = Entry("NearRows.run", _BLOCK if cuda else 1, _BLOCKS)
    constants = {"CHUNK": POINTS_AT_ONCE, **dict(told)}
    name = f"near_{'cuda' if cuda else 'cpu'}"
    kind = Kind(dim, double, periodic=1 + SKEWED * skewed)
    return declare_kind(kind, name, "near_rows.cuh" if cuda else "near_rows_cpu.h", entry, cuda=cuda, constants=constants)[0]
