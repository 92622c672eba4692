"""Warp, started where it is needed: the one module that imports it. Whoever waits may be interrupted, what is started may not."""

import functools
import importlib
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

INSTALL = 'pip install "jfrnn[warp]"'


@functools.cache
def load_warp() -> Any:  # noqa: ANN401
    """Import Warp, quietly if nobody did before, or say what to install."""
    return apart(_load_warp)


def _load_warp() -> Any:  # noqa: ANN401
    fresh = "warp" not in sys.modules
    try:
        import warp
    except ImportError as error:
        raise ImportError(f"the backends 'warp' and 'hashgrid' need the package warp-lang (1.18 or 1.19): {INSTALL}") from error
    if fresh:
        warp.config.log_level = warp.LOG_WARNING
    if not hasattr(warp, "jax_callable"):
        raise ImportError(f"the backends 'warp' and 'hashgrid' need warp-lang 1.18 or 1.19, found {warp.__version__}: {INSTALL}")
    return warp


def kernels_of(name: str) -> Any:  # noqa: ANN401
    """Return a module of jfrnn.kernels, which imports Warp."""
    return sys.modules.get(f"jfrnn.kernels.{name}") or _import_kernels(name)


@functools.cache
def _import_kernels(name: str) -> Any:  # noqa: ANN401
    load_warp()
    return apart(functools.partial(importlib.import_module, f"jfrnn.kernels.{name}"))


def apart(work: Callable[[], Any]) -> Any:  # noqa: ANN401
    """Do work that must not stop midway where no handler of a signal runs, in another thread than the main one, and wait for it."""
    if threading.current_thread() is not threading.main_thread():
        return work()
    try:
        begun = _others().submit(work)
    except RuntimeError:  # while the interpreter exits
        return work()
    return begun.result()


@functools.cache
def _others() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="jfrnn-start")
