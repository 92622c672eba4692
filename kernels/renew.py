"""Lists with a skin: whether they are stale, and what stands on CUDA around the search that renews them without the host."""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, declare_kind, program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.cells_cuda import place_words

BLOCK = 256
_MOST_BLOCKS = 1024
POINTS_AT_ONCE, POINTS_PER_THREAD = 256, 1 << 14  # that a thread of the CPU looks at, and for which one is worth it
MOST_TURNS = (0, *((1 << k) - 1 for k in range(1, 10)))  # how far rounding goes is known for each of them, and one is chosen


class RenewKernels(NamedTuple):
    """What says whether a list is stale; what comes before a search, and behind it; and what lets a graph go on if it is stale."""

    check: Kernel
    prepare: Kernel
    settle: Kernel
    keep: Kernel
    decide: Kernel


def blocks(n: int) -> int:
    """Return how many blocks look at n points."""
    return min(-(-n // BLOCK), _MOST_BLOCKS)


@functools.lru_cache(64)
def renew_kernels(dim: int, double: bool, periodic: bool, ordered: bool, told: tuple[tuple[str, int], ...]) -> RenewKernels:
    """Return the kernels for a dimension, a dtype and a space; `told` are constants that other floors decide, with their names."""
    kind = Kind(dim, double, periodic=periodic)
    first, words, word = place_words(2 if double else 1)
    constants = {"ORDERED": ordered, "FIRST_PLACE": first, "PLACE_WORDS": words, "PLACE_WORD": word, "BLOCK": BLOCK, **dict(told)}
    name = f"renew_cuda_{kind.name}{'_ordered' * ordered}"
    check, *rest = (Entry(f"Renew.{method}", BLOCK, 4) for method in RenewKernels._fields[:-1])

    def text(conditional: bool) -> str:
        return program(kind, "renew.cuh", constants=constants | {"CONDITIONAL": conditional})

    around = declare(name, text(conditional=False), check, *rest, cuda=True)
    decide = declare(f"{name}_conditional", text(conditional=True), check, cuda=True, linked=True)
    return RenewKernels(*around, *decide)


@functools.lru_cache(64)
def moved_kernel(dim: int, double: bool, periodic: bool, told: tuple[tuple[str, int], ...]) -> Kernel:
    """Return the kernel that says on the CPU whether a point has moved too far, with what `renew_kernels` is told."""
    constants = {"QUERY_CHUNK": POINTS_AT_ONCE, **dict(told)}
    return declare_kind(Kind(dim, double, periodic=periodic), "moved_cpu", "moved_cpu.h", "Moved.run", constants=constants)[0]
