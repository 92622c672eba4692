"""Time and memory of one search in this process."""

import ctypes
import functools
import gc
import math
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import psutil


class PeakMemory:
    """Peak resident memory since the moment of creation.

    Attributes:
        start: Resident memory then [bytes]; the peak of the process so far, where the system cannot forget it.
        source: VmHWM, or ru_maxrss where the peak cannot be reset.
    """

    def __init__(self) -> None:
        """Return freed memory to the system, forget the peak so far where the system allows it, and note the start."""
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
        try:
            Path("/proc/self/clear_refs").write_text("5")
            self.source = "VmHWM"
        except OSError:
            self.source = "ru_maxrss"
        self.start = self.peak()

    def peak(self) -> int:
        """Return the peak [bytes]."""
        if self.source == "VmHWM":
            lines = Path("/proc/self/status").read_text().splitlines()
            return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
        unit = 1 if sys.platform == "darwin" else 1024
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def keep_freed_memory() -> None:
    """Let no call wait for the system to clear pages that the call before it gave back, as none does in a compiled loop.

    Else arrays of more than 32 MB, and by turns shorter ones, go back to the system when they are freed. Where the C library is
    another than glibc, nothing changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        trim_threshold, mmap_most = -1, -4  # of malloc.h
        mallopt(trim_threshold, 2**31 - 1)
        mallopt(mmap_most, 0)


def forget_freed_memory() -> None:
    """Let the system have back at once, from now on, what is freed: nothing hides in a later peak.

    What was freed before goes with the next call that takes and frees memory, in each of its threads. Where the C library is
    another than glibc, nothing changes. Calls are slower afterwards: time them before.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        trim_threshold, mmap_threshold = -1, -3  # of malloc.h
        mallopt(mmap_threshold, 1 << 16)
        mallopt(trim_threshold, 0)


class DeviceMemory:
    """Peak memory of the accelerator since the moment of creation, of what JAX and Warp take; not their programs."""

    def __init__(self) -> None:
        """Note what is held now."""
        self._start = self._read("bytes_in_use", "get_mempool_used_mem_current")

    def peak(self) -> int | None:
        """Return the peak over the start [bytes], None where JAX runs on a CPU or has not been imported.

        A peak is never forgotten: ask in a process that did nothing else.
        """
        peak = self._read("peak_bytes_in_use", "get_mempool_used_mem_high")
        return None if peak is None else peak - (self._start or 0)

    @staticmethod
    def _read(of_jax: str, of_warp: str) -> int | None:
        jax, warp = (sys.modules.get(name) for name in ("jax", "warp"))
        if jax is None or jax.default_backend() != "gpu":
            return None
        own = getattr(warp, of_warp)("cuda:0") if warp is not None and warp.is_cuda_available() else 0
        return int((jax.devices()[0].memory_stats() or {}).get(of_jax, 0)) + int(own)


class Bystanders:
    """What other processes of the machine do since the moment of creation: a search on all cores is slower beside them."""

    SHORTEST = 0.2  # [s]; the system counts in ticks of 0.01 s for each core

    def __init__(self) -> None:
        """Note the start."""
        self._start = self._read()

    def cores(self) -> float | None:
        """Return how many cores others kept busy, on average; None after too short a time to tell."""
        wall, busy, own = (now - then for now, then in zip(self._read(), self._start, strict=True))
        return max(busy - own, 0.0) / wall if wall >= self.SHORTEST else None

    def _read(self) -> tuple[float, float, float]:
        """Return wall time, busy time of all cores, and time of this process and of those that it has waited for [s]."""
        times, kinds = psutil.cpu_times(), ("user", "nice", "system", "irq", "softirq", "steal")
        own = process_time() + os.times().children_user + os.times().children_system
        return perf_counter(), sum(getattr(times, kind, 0.0) for kind in kinds), own


def repeat(
    search: Callable[[], Any], repeats: int, min_seconds: float, max_repeats: int, most_seconds: float = math.inf
) -> tuple[Any, list[float]]:
    """Run a search again and again; return its last result and the time of each run [s].

    There are at least `repeats` runs, and more until they took `min_seconds` together or are `max_repeats`; none begins after
    `most_seconds`. Each result is dropped before the next run, so that memory holds one.
    """
    seconds: list[float] = []
    while True:
        begin = perf_counter()
        result = search()
        seconds.append(perf_counter() - begin)
        enough = len(seconds) >= repeats and (sum(seconds) >= min_seconds or len(seconds) >= max_repeats)
        if enough or sum(seconds) >= most_seconds:
            return result, seconds
        del result


def compile_scan(
    function: Callable[[Any], Any] | None,
    x: Any,  # noqa: ANN401
    steps: int,
    made: Any = None,  # noqa: ANN401
) -> Callable[[], Any]:
    """Return a compiled scan whose steps move x and call a function of it, or only move x; it keeps what the last step makes.

    The compiler cannot leave out a step, because the scan carries all that the step makes, and the velocity, which is 0, is an
    argument. `made` is what the function makes of x, if that is known: then it is compiled in the scan alone.
    """
    import jax
    import jax.numpy as jnp

    def step(carry: Any, _: None, velocity: Any) -> tuple[Any, None]:  # noqa: ANN401
        moved = carry[0] + velocity
        return (moved, None if function is None else function(moved)), None

    def run(x: Any, velocity: Any, made: Any) -> Any:  # noqa: ANN401
        return jax.lax.scan(functools.partial(step, velocity=velocity), (x, made), None, length=steps)[0]

    compiled = jax.jit(run)
    if made is None and function is not None:
        made = jax.jit(function)(x)
    rest = jnp.zeros((), x.dtype)
    jax.block_until_ready(compiled(x, rest, made))
    return lambda: compiled(x, rest, made)


def time_in_turns(calls: dict[str, Callable[[], Any]], rounds: int, burst: int = 1) -> tuple[dict[str, list[float]], float | None]:
    """Time compiled and warm calls in turns, so that all suffer alike from what else the machine does.

    Each run follows one call that is not timed: it is its own data that the caches hold, not what another call left there. It is a
    burst of calls, of which the last is waited for: what a device takes, where the host need not wait for each. Return the times
    of each [s], and how many cores others kept busy meanwhile.
    """
    import jax

    seconds: dict[str, list[float]] = {name: [] for name in calls}
    bystanders = Bystanders()
    for _ in range(rounds):
        for name, call in calls.items():
            jax.block_until_ready(call())
            begin, result = perf_counter(), None
            for _ in range(burst):
                result = call()
            jax.block_until_ready(result)
            seconds[name].append((perf_counter() - begin) / burst)
    others = bystanders.cores()
    return seconds, None if others is None else round(others, 2)


def burst() -> int:
    """Return how many calls of a device are timed as one: of one alone, much of the time is the host's."""
    import jax

    return 20 if jax.default_backend() == "gpu" else 1


def summarize(seconds: list[float]) -> dict[str, Any]:
    """Return count, median and the 10th and 90th percentile of the repeats, named as in a row."""
    p10, median, p90 = (float(value) for value in np.percentile(seconds, (10, 50, 90)))
    return {"repeats": len(seconds), "seconds": seconds, "median_s": median, "p10_s": p10, "p90_s": p90}
