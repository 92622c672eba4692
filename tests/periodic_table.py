"""Decide the whole table of periodic hard cases with one engine, in many processes: `python tests/periodic_table.py jax 14`.

Cases with one program, those with the same images, dtype and comparison, are decided by one process, so that each program is
compiled once. Prints the cases that are wrong, and how many there are.
"""

import itertools
import multiprocessing
import os
import sys
from collections import defaultdict
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def groups():
    """Return lists of (name, dtype, dim, closed) whose searches share a program; the longest come first."""
    import jfrnn
    from jfrnn._geometry.images import images_of
    from jfrnn.cases.periodic import PERIODIC_CASES

    found = defaultdict(list)
    for name, dtype, dim, closed in itertools.product(PERIODIC_CASES, ("float32", "float64"), (2, 3), (False, True)):
        given = PERIODIC_CASES[name].build(dtype, dim)
        box = jfrnn.Box(given.matrix, given.periodic) if any(given.periodic) else None
        images = None if box is None else images_of(box, given.cutoff, np.dtype(dtype), 304)
        found[images, dtype, dim, closed, given.queries is None].append((name, dtype, dim, closed))
    return sorted(found.values(), key=len, reverse=True)


def decide(backend, cases):
    """Decide cases; return what is wrong with those that are, and the seconds that it took."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import test_box

    wrong, begin = [], perf_counter()
    for name, dtype, dim, closed in cases:
        try:
            test_box.assert_case(name, np.dtype(dtype).type, dim, backend, closed=closed)
        except Exception as error:  # what an engine raises is its answer
            wrong.append((name, dtype, dim, closed, f"{type(error).__name__}: {error}"[:200]))
    return len(cases), wrong, perf_counter() - begin


def main(backend, workers):
    """Decide the table and print what is wrong."""
    begin, count, wrong, busy = perf_counter(), 0, [], 0.0
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        work = pool.apply(groups)  # this process holds no device
        for many, found, seconds in pool.starmap(decide, [(backend, cases) for cases in work], chunksize=1):
            count, wrong, busy = count + many, wrong + found, busy + seconds
    for case in wrong:
        print(*case)
    print(
        f"{count} periodic cases, {len(work)} programs by {backend}: {len(wrong)} wrong; {workers} processes,"
        f" {perf_counter() - begin:.0f} s in all, {busy:.0f} s of work"
    )
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
