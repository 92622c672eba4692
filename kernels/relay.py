"""A native function that lets another thread answer what arrives on Python's main thread, which waits outside Python meanwhile.

Python runs the handlers of signals on its main thread, between any two of its instructions. XLA calls from whatever thread it runs
a program on, the main thread included: there, a handler that raises would end a call at any point.
"""

import warp as wp
from jfrnn.kernels._text import fill, read_part

# Places in the array of words that is given: addresses of functions and locks, and numbers.
_PLACES = ("ANSWER_HERE", "THREAD", "MAIN_THREAD", "ACQUIRE", "RELEASE", "ASKED", "ANSWERED", "FRAME", "ANSWER")
WORDS = len(_PLACES)
ANSWER_HERE, THREAD, MAIN_THREAD, ACQUIRE, RELEASE, ASKED, ANSWERED, FRAME, ANSWER = range(WORDS)

_TEXT = fill(read_part("relay.h", "relay"), **{name: str(place) for place, name in enumerate(_PLACES)})

_Words = wp.array(dtype=wp.uint64)


@wp.func_native(_TEXT)
def _open_native(words: _Words, address_out: _Words): ...


@wp.kernel(enable_backward=False)
def open_relay(words: _Words, address_out: _Words):
    """Tell the address of the relay that reads these words, which stay where they are. Launched with dim = 1 on the CPU."""
    _open_native(words, address_out)
