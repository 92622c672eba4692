"""What kernels for the CPU are compiled with in tests.

Clang without optimizations takes a sixth of the time, and what it makes three to five times as long. The floats that come out are
the same: none of the options lets a compiler calculate otherwise than it is told.
"""

import os

from jfrnn.kernels import _clang

AS_USERS_DO, SOON = _clang.OPTIONS, ("-march=native", "-O0")
ASKED = "JAX_DISABLE_MOST_OPTIMIZATIONS"  # in the environment of processes that tests start, but for slow tests
# How a program begins that runs in a process of its own.
PROGRAM = f"""
import os
from jfrnn.kernels import _clang
_clang.OPTIONS = {SOON} if {ASKED!r} in os.environ else _clang.OPTIONS
"""


def compile_soon():
    """Leave out what takes Clang long, in a process that a test started, if XLA's compiler does, too."""
    if ASKED in os.environ:
        _clang.OPTIONS = SOON
