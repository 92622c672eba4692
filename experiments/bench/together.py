"""Searches at once: four threads of a process beside four processes, each with a compiled function of its own.

`python together.py N THREADS CALLS` is such a process: it compiles, prints a line, waits for one, makes its calls, prints another.
"""

import math
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

SIZES = 1000, 20_000
AT_ONCE = 4
NEIGHBORS = 30  # about so many each, away from the faces of the unit cube
SECONDS = 0.8  # that the calls of all may take
REPEATS = 5  # rounds, in which all take turns
KINDS = {"one": (1, 1), "four threads": (1, AT_ONCE), "four processes": (AT_ONCE, 1)}  # processes, and threads of each
COLUMNS = (
    *("platform", "n", "what", "calls", "call_us", "calls_per_s", "ratio", "repeats", "others_cores", "device", "jax", "warp"),
    *("commit", "dirty"),
)
SHOWN = ("n", "what", "calls", "call_us", "calls_per_s", "ratio", "others_cores")


def make_rows(n: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each kind: the calls per second of all together, medians over rounds in which all kinds take turns.

    `ratio` is to four processes.
    """
    from experiments._measure import Bystanders

    around, calls = Bystanders(), 10
    calls = max(int(SECONDS / AT_ONCE / (_run(n, 1, 1, calls) / calls)), 10)
    rates: dict[str, list[float]] = {what: [] for what in KINDS}
    for _ in range(REPEATS):
        for what, (processes, threads) in KINDS.items():
            rates[what].append(processes * threads * calls / _run(n, processes, threads, calls))
    medians = {what: float(np.median(each)) for what, each in rates.items()}
    for what, (processes, threads) in KINDS.items():
        times = {"calls_per_s": medians[what], "call_us": 1e6 * processes * threads / medians[what]}
        ratio = round(medians[what] / medians["four processes"], 2)
        yield {"n": n, "what": what, "calls": calls, "repeats": REPEATS, "ratio": ratio, "others_cores": around.cores()} | times


def _run(n: int, processes: int, threads: int, calls: int) -> float:
    """Return the seconds from when all may begin until the last one has ended."""
    words = [sys.executable, __file__, str(n), str(threads), str(calls)]
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    with ExitStack() as stack:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
        made: list[Any] = [stack.enter_context(subprocess.Popen(words, **pipes)) for _ in range(processes)]
        _hear(made)
        begin = perf_counter()
        for each in made:
            each.stdin.write("\n")
            each.stdin.flush()
        _hear(made)
        seconds = perf_counter() - begin
        if any(each.wait() for each in made):
            raise RuntimeError("a process failed, or found a wrong answer")
        return seconds


def _hear(made: list[Any]) -> None:
    for each in made:
        if not each.stdout.readline():
            raise RuntimeError(f"a process ended with {each.wait()} before it had answered")


def main(n: int, threads: int, calls: int) -> None:
    """Compile a search for each thread, and when a line comes, let each make its calls, waiting for every one.

    The first and the last answer of each must be the same, and their counts those of another program.
    """
    import jax

    searches, found = [_compile(jax, n, k) for k in range(threads)], dict[int, Any]()
    expected = [search() for search in searches]
    start = threading.Barrier(threads + 1)

    def work(k: int) -> None:
        start.wait()
        for _ in range(calls):
            found[k] = searches[k]()

    workers = [threading.Thread(target=work, args=(k,)) for k in range(threads)]
    for worker in workers:
        worker.start()
    print("ready", flush=True)
    sys.stdin.readline()
    start.wait()
    for worker in workers:
        worker.join()
    print("done", flush=True)
    for k in range(threads):
        if not all(np.array_equal(*pair) for pair in zip(found[k], expected[k], strict=True)):
            raise RuntimeError(f"the answer of thread {k} changed")


def _compile(jax: Any, n: int, k: int) -> Callable[[], Any]:  # noqa: ANN401
    import jfrnn

    x = jax.numpy.asarray(np.random.default_rng(k).random((n, 3)), jax.numpy.float32)
    cutoff = (3 * NEIGHBORS / (4 * math.pi * n)) ** (1 / 3)
    known = jfrnn.search(x, cutoff)

    @jax.jit
    def search(x: Any) -> Any:  # noqa: ANN401
        nbrs = jfrnn.search(x, cutoff, capacity=known.capacity)
        return nbrs.idx, nbrs.count

    def call() -> Any:  # noqa: ANN401
        return jax.block_until_ready(search(x))

    if not np.array_equal(call()[1], known.count):
        raise RuntimeError("counts differ from those of an eager search")
    return call


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
