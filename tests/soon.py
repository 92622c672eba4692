"""What kernels for the CPU are compiled with in tests.

Clang without optimizations takes a sixth of the time, and what it makes three to five times as long. The floats that come out are
the same: none of the options lets a compiler calculate otherwise than it is told.
"""

from jfrnn.kernels import _clang

AS_USERS_DO, SOON = _clang.OPTIONS, ("-march=native", "-O0")
PROGRAM = f"from jfrnn.kernels import _clang\n_clang.OPTIONS = {SOON}\n"  # the beginning of one that runs in a process of its own
