"""What kernels for the CPU are compiled with in tests.

To optimize takes Clang most of its time, which on a machine that keeps no kernels is most of the time of the tests; kernels that
are not optimized are slower, but the scenes are small. The floats that come out are the same: none of the options lets a compiler
calculate otherwise than it is told. Hard cases run optimized kernels all the same, by the mark `kernels`. And garbage is rarely
looked for: tracing makes many objects that stay.
"""

import gc
import os

from jfrnn.kernels import _clang

AS_USERS_DO, SOON = _clang.OPTIONS, ("-march=native", "-O0")
ASKED = "JAX_DISABLE_MOST_OPTIMIZATIONS"  # in the environment of processes that tests start, but for slow tests
SELDOM = (50_000, 20, 20)  # thresholds of the garbage collector: with those of Python it takes a tenth of the time
# How a program begins that runs in a process of its own.
PROGRAM = f"""
import gc, os
from jfrnn.kernels import _clang
_clang.OPTIONS = {SOON} if {ASKED!r} in os.environ else _clang.OPTIONS
gc.freeze()
gc.set_threshold{SELDOM}
"""


def compile_soon():
    """Leave out what takes Clang long, in a process that a test started, if XLA's compiler does, too."""
    collect_seldom()
    if ASKED in os.environ:
        _clang.OPTIONS = SOON


def collect_seldom():
    """Look through the objects that there are now never again for garbage, and rarely through others."""
    gc.freeze()
    gc.set_threshold(*SELDOM)
