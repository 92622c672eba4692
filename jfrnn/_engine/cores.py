"""Kernels on the CPU, on one core or on all of them."""

import contextlib
import ctypes
import functools
import os
import sys
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from jfrnn._engine.start import WarpKernel, WarpModule, kernels_of, load_warp

PLACES_PER_THREAD = 2048  # below, a second thread costs more than it saves
_HUGE = 1 << 22  # bytes from which a buffer is worth a request for huge pages


def on_one_core(kernel: WarpKernel, inputs: list[Any]) -> None:
    """Launch a kernel once on the CPU."""
    load_on_cpu(kernel.module)
    load_warp().launch(kernel, dim=1, inputs=inputs, device="cpu")


def on_every_core(kernel: WarpKernel, inputs: list[Any], most: int) -> None:
    """Launch a kernel once per core, at most `most` times; a launch releases the interpreter's lock while it runs."""
    launch = functools.partial(on_one_core, kernel, inputs)
    if most <= 1:
        launch()
        return
    load_on_cpu(kernel.module)
    others: list[Future[None]] = []
    try:
        with contextlib.suppress(RuntimeError):  # while the interpreter exits, nothing can be submitted: this core does the rest
            for _ in range(min(_cores(), most) - 1):
                others.append(_pool().submit(launch))
        launch()
    finally:  # they write to memory that XLA takes back when the call ends, however it ends
        wait(others)
    for other in others:
        other.result()


@functools.cache
def load_on_cpu(module: WarpModule) -> None:
    """Compile a module before several threads launch from it, and always in the same one: each has its own precompiled headers."""
    load = functools.partial(kernels_of("_load").load_module, module, "cpu")
    try:
        compiled = _compiler().submit(load)
    except RuntimeError:  # while the interpreter exits
        load()
    else:
        compiled.result()


@functools.cache
def _compiler() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="jfrnn-compiler")


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(_cores() - 1, 1), thread_name_prefix="jfrnn")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ask_for_huge_pages(address: int, size: int) -> None:
    """Let Linux back a large output with huge pages: its first touch then costs a few faults instead of one per 4 KiB."""
    if size < _HUGE or not sys.platform.startswith("linux"):
        return
    page = 4096
    start = -(-address // page) * page
    _libc().madvise(ctypes.c_void_p(start), ctypes.c_size_t((address + size - start) // page * page), 14)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)
