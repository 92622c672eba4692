"""What the array engine chooses by platform. Results are the same with any of these numbers; time and scratch memory are not."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
from jax import lax

from jfrnn._geometry import Sorting
from jfrnn._tracing import Internal, Tree, on_platform

WORD_BYTES = 24  # what a word of 16 candidates takes while it is tested
SLOT_BYTES = 16  # what a slot of a row takes while it is filled
_SHARE = 8  # scratch is at most one of so many parts of a device's memory

Operands = TypeVar("Operands")


class Tuning(NamedTuple):
    """How the array engine divides its work.

    Attributes:
        scratch: Memory of a block of queries [B], apart from the sorted particles.
        words: Most words of 16 candidates in a block.
        few_pairs: Up to so many pairs of a query and an image of a source, all are tested, and nothing is sorted;
        plain_pairs: the same in open space without systems, if the sources are one chunk of words on a CPU.
        sorting: How particles are sorted. On a CPU, XLA sorts single words several times faster than pairs. XLA of jax 0.11.2
            sorted 17 408 pairs of words on an H200 by a chain of its own kernels, and 33 792 by CUB, which takes less time.
        by_gathers: Whether what a slot needs to know of a group of words, and a word of its run, is gathered, instead of chosen by
            looking at every group or run.
        group: Slots of a row that are filled at a time.
        at_once: A block of up to so many queries, in open space, is processed without any loop unless a query has more words of
            candidates than are usual, more doubtful ones than one, or more neighbors than `fold_group`: the host of an accelerator
            waits before each turn of a loop whose length the data decide. Doubts are then decided for all rows at once.
        fold_group: Slots of a row that are summed at a time, where `at_once` allows it.
    """

    scratch: int
    words: int
    few_pairs: int
    plain_pairs: int
    sorting: Sorting
    by_gathers: bool
    group: int
    at_once: int = 0
    fold_group: int = 32


CPU = Tuning(  # a block fits into the caches, and loops cost little
    scratch=48_000_000,
    words=1 << 16,
    few_pairs=1 << 14,
    plain_pairs=1 << 20,
    sorting=Sorting(packed=True),
    by_gathers=False,
    group=160,
)
ACCELERATOR = Tuning(  # few large kernels, in at most 1 GB
    scratch=900_000_000,
    words=1 << 26,
    few_pairs=1 << 24,
    plain_pairs=1 << 24,
    sorting=Sorting(least=33 << 10, searched=1 << 18),
    by_gathers=True,
    group=256,
    at_once=1 << 16,
    fold_group=128,
)


def by_platform(make: Callable[[Tuning], Callable[[Operands], Tree]], operands: Operands) -> Tree:
    """Call make(tuning)(operands) with the numbers of the platform for which the program is compiled.

    Operands that are known while tracing, such as cutoffs, are hidden from the compiler, which would else make another program of
    another size where they are constants than where they are arguments.
    """
    return on_platform(lax.optimization_barrier(operands), cpu=make(CPU), default=make(_fit_memory(ACCELERATOR)))


def _fit_memory(tuning: Tuning) -> Tuning:
    """Limit the scratch to a share of the smallest accelerator's memory, where JAX has one and knows its memory."""
    limits = [_limit_of(device) for device in jax.local_devices() if device.platform != "cpu"]
    return tuning._replace(scratch=min([tuning.scratch, *(limit // _SHARE for limit in limits if limit > 0)]))


def _limit_of(device: Internal) -> int:
    """Return the memory of a device [B]; what is not above 0 is not known."""
    try:
        return (device.memory_stats() or {}).get("bytes_limit", 0)
    except jax.errors.JaxRuntimeError:  # its platform does not tell
        return 0
