"""The pairs of one structure of atoms, on the CPU, in float64: called on arrays of NumPy, without JAX."""

import functools

from jfrnn.kernels._native import Kind, program
from jfrnn.kernels._program import Kernel, declare

INTS_PER_ATOM, REALS_PER_ATOM, MORE_INTS = 9, 6, 64  # of scratch
RULES = {"one": 0, "radii": 1, "table": 2}  # whose cutoff is that of a pair
WRONG = {1: "not finite", 2: "too far", 4: "degenerate"}


@functools.cache
def structure_kernel() -> Kernel:
    """Return the kernel, which one thread runs."""
    text = program(Kind(3, True, periodic=4), "structure_cpu.h", constants={"SUM": 1})
    return declare("structure_cpu", text, "Structure.run")[0]
