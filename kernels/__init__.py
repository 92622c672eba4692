"""Kernels: each is declared in Python, and its C++ or CUDA stands in `native`. No import compiles or starts anything."""

from jfrnn.kernels._jobs import one_at_a_time
from jfrnn.kernels._native import Kind
from jfrnn.kernels._program import Entry, Field, Kernel, Program, declare

__all__ = ["Entry", "Field", "Kernel", "Kind", "Program", "declare", "one_at_a_time"]
