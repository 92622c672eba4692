"""Raise from signal handlers while searches run, and compare what comes back; `test_interrupts.py` runs it in a process of its own.

Each try ends with an exception of a handler: within a search, or in the wait behind it. A result that a search hands back before
must be the right one, bit for bit, and the exception must arrive as the very object that the handler raised.
"""

import gc
import mmap
import os
import signal
import statistics
import sys
import threading
import time
import traceback
from pathlib import Path

import jax
import numpy as np

if "unmapped" in sys.argv:  # as where a process may not have memory that it both writes and executes
    del mmap.PROT_EXEC
import jfrnn

RANDOM = np.random.default_rng(0)
MANY = RANDOM.random((20_000, 3), np.float32)
FEW = MANY[:16]
CORNERS = RANDOM.random((60, 3), np.float32)
FACES = RANDOM.integers(0, 60, (100, 3)).astype(np.int32)
raised = []
dropped = []  # by Python, which tells nobody what is raised in a finalizer or in a callback of a weak reference


def density(r, i, j):
    return 1 - r @ r


class Stopped(KeyboardInterrupt):
    """What a handler of SIGUSR1 raises."""


def handle(number, _):
    kind = {signal.SIGALRM: TimeoutError, signal.SIGUSR1: Stopped, signal.SIGINT: KeyboardInterrupt}[number]
    raised.append(kind(len(raised)))
    raise raised[-1]


def note(unraisable):
    """Note what Python drops where no function of the library is at work; where one is, it counts as lost."""
    files = [frame.filename for frame in traceback.extract_tb(unraisable.exc_traceback)]
    print(f"dropped in {unraisable.object}: {unraisable.exc_value!r}, {files}", file=sys.stderr)
    if not any(os.sep + "jfrnn" + os.sep in file for file in files):
        dropped.append(unraisable.exc_value)


def listed(x):
    nbrs = jfrnn.search(x, 0.06, capacity=64, backend="warp")
    return nbrs.idx, nbrs.count, nbrs.status


def counted(x):
    return (jfrnn.count(x, 0.06, backend="warp"),)


def summed(x):
    return (jfrnn.pair_sum(density, x, 0.06, backend="warp"),)


def near_walls(x):
    tri = jfrnn.search_triangles(x, CORNERS, FACES, 0.1, capacity=64, backend="warp")
    return tri.idx, tri.count


def results(work, x):
    return b"".join(np.asarray(part).tobytes() for part in work(x))


def send(number, delay):
    """Let a signal come in a while; SIGALRM from the timer, others from a thread."""
    if number == signal.SIGALRM:
        signal.setitimer(signal.ITIMER_REAL, delay)
    else:
        threading.Timer(delay, os.kill, (os.getpid(), number)).start()


def interrupt(work, x, number, delay):
    """Return what a search handed back (None: it was interrupted), and whether the exception arrived as itself."""
    before, answer = len(raised), None
    try:
        send(number, delay)
        answer = results(work, x)
        while len(raised) == before:
            time.sleep(1e-4)
    except (KeyboardInterrupt, TimeoutError) as error:
        return answer, error is raised[-1] and len(raised) == before + 1
    except UnboundLocalError as error:  # of `jax.tree.map`, which asks for a name that it has not bound, whatever is raised in it
        return answer, error.__context__ is raised[-1]
    return answer, raised[-1] in dropped or was_dropped_by_jax(raised[-1])


def was_dropped_by_jax(error):
    """Say whether JAX caught an exception and went on, as `FlatTree.paths` does with any: a traceback begins where that was."""
    frames = traceback.extract_tb(error.__traceback__)
    print(f"caught: {error!r}, {[f'{frame.filename} {frame.name}' for frame in frames]}", file=sys.stderr)
    return Path(jax.__file__).parent in Path(frames[0].filename).parents


def main(tries):
    works = [(f, x) for work in (listed, counted, summed, near_walls) for f in (work, jax.jit(work)) for x in (FEW, MANY)]
    expected = [results(*case) for case in works]
    for number in (signal.SIGALRM, signal.SIGUSR1, signal.SIGINT):
        signal.signal(number, handle)
    sys.unraisablehook = note
    gc.disable()  # Python drops what is raised while it collects garbage
    wrong = lost = interrupted = finished = 0
    for case, right in zip(works, expected, strict=True):
        seconds = []
        for _ in range(5):
            begin = time.perf_counter()
            results(*case)
            seconds.append(time.perf_counter() - begin)
        for k in range(tries):
            delay = RANDOM.random() * 1.5 * statistics.median(seconds) + 1e-6
            answer, arrived = interrupt(*case, (signal.SIGALRM, signal.SIGUSR1, signal.SIGINT)[k % 3], delay)
            wrong += answer is not None and answer != right
            lost += not arrived
            interrupted += answer is None
            finished += answer is not None
        wrong += results(*case) != right
    print(f"wrong {wrong} lost {lost} interrupted {interrupted} finished {finished}")


if __name__ == "__main__":
    main(int(sys.argv[1]))
