"""Kernels: each is declared in Python, and its C++ or CUDA stands in `native`. No import compiles or starts anything."""

from jfrnn.kernels._kind import Kind
from jfrnn.kernels._program import Entry, Field, Kernel, Program, declare
from jfrnn.kernels._turns import one_at_a_time

__all__ = ["Entry", "Field", "Kernel", "Kind", "Program", "declare", "one_at_a_time"]
