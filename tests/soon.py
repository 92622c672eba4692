"""What kernels for the CPU are compiled with in tests.

To optimize takes Clang most of its time, which on a machine that keeps no kernels is most of the time of the tests; kernels that
are not optimized are slower, but the scenes are small. The floats that come out are the same: none of the options lets a compiler
calculate otherwise than it is told. Hard cases run optimized kernels all the same, by the mark `kernels`.
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
