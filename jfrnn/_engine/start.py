"""Warp, started where it is needed: the one module that imports it. Whoever waits may be interrupted, what is started may not."""

import contextlib
import functools
import importlib
import inspect
import logging
import os
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import ModuleType
from typing import Any, TypeVar

from jfrnn.kernels import _clang, one_at_a_time

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
_LINUX = sys.platform == "linux"
Result = TypeVar("Result")
_LONG = 2.0  # seconds
_said = False
_log = logging.getLogger("jfrnn")  # which shows warnings on standard error, unless users say otherwise
INSTALL = "pip install 'warp-lang==1.19.*'"


def alone(work: Callable[[], Result]) -> Callable[[], Result]:
    """Make work of which no thread does any while another does."""

    @functools.wraps(work)
    def whole() -> Result:
        with one_at_a_time:
            return work()

    return whole


@functools.cache
def load_warp() -> ModuleType:
    """Import Warp and start it, without a word of its own; warn once where it takes a temporary folder for its kernels.

    An ImportError says that it is not installed, or another version is, a RuntimeError that it cannot start.
    """
    warp, warning = apart(_load_warp)
    if warning is not None:
        warnings.warn(warning, RuntimeWarning, stacklevel=level_of_caller())
    return warp


@functools.cache
def check_warp() -> None:
    """Look for Warp, without importing it.

    Raises:
        ImportError: It is not installed, or another version is.
    """
    try:
        version = _clang.warp_version()
    except ImportError as error:
        raise ImportError(f"the backends 'warp' and 'hashgrid' need the package warp-lang (1.18 or 1.19): {INSTALL}") from error
    if version.split(".")[:2] not in (["1", "18"], ["1", "19"]):
        raise ImportError(f"the backends 'warp' and 'hashgrid' need warp-lang 1.18 or 1.19, found {version}: {INSTALL}")


@alone
def _load_warp() -> tuple[Any, str | None]:
    """Return Warp, and what is to be said of the folder in which it keeps kernels."""
    check_warp()
    fresh = "warp" not in sys.modules
    import warp

    level, warp.config.log_level = warp.config.log_level, warp.LOG_WARNING
    try:
        with _without_a_word_of_drivers():
            return warp, _init(warp)
    finally:
        if not fresh:
            warp.config.log_level = level


def _init(warp: ModuleType) -> str | None:
    given, warning = warp.config.kernel_cache_dir, None
    try:
        try:
            warp.init()
        except OSError:
            warning = None if compiler().keeps_no_programs() else compiler().temporary_folder()
            warp.config.kernel_cache_dir = str(compiler().kernel_folder() / "warp")  # it wonders about others' files beside its own
            warp.init()
    except RuntimeError:
        warp.config.kernel_cache_dir = given  # what it makes of the path, it would make again of that
        raise
    except Exception as error:
        raise RuntimeError(f"Warp cannot start: {type(error).__name__}: {error}") from error
    return warning


@contextlib.contextmanager
def _without_a_word_of_drivers() -> Iterator[None]:
    """Leave out Warp's complaint that there is no CUDA driver, which it writes past Python: whoever asks for a GPU is told."""
    with contextlib.ExitStack() as stack:
        try:
            opened = os.fdopen(os.memfd_create("stderr"), "w+b") if _LINUX else tempfile.TemporaryFile()  # noqa: SIM115
            written = stack.enter_context(opened)
            kept = os.dup(2)
        except OSError:  # no standard error, no folder for temporary files
            yield
            return
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            written.seek(0)
            lines = [line for line in written.read().splitlines(keepends=True) if _NO_DRIVER not in line]
            os.write(2, b"".join(lines))


@functools.cache
def compiler() -> ModuleType:
    """Return `jfrnn.kernels._compile`, which needs the compilers that Warp ships, but does not import it."""
    check_warp()
    return apart(functools.partial(importlib.import_module, "jfrnn.kernels._compile"))


def wait_for(begun: Iterable[Future[Any]]) -> None:
    """Wait for programs that threads compile; say once what one waits for, where that is long."""
    global _said
    ends = time.monotonic() + _LONG
    for job in begun:
        if not (_said or wait([job], max(ends - time.monotonic(), 0)).done or _said):
            _said = True
            _log.warning("jfrnn compiles kernels, which are kept in %s for later processes", compiler().kernel_folder())
        job.result()


def finish(begin: Any) -> None:  # noqa: ANN401
    """Wait for what a cached function has begun, if anything; where that has failed, it begins anew next time."""
    begun = begin()
    try:
        wait_for([] if begun is None else [begun])
    except BaseException:
        begin.cache_clear()
        raise


def warn_of_folders() -> None:
    """Warn of a folder in which programs cannot be kept."""
    notes = compiler().notes
    while notes:
        warnings.warn(notes.pop(0), RuntimeWarning, stacklevel=level_of_caller())


def apart(work: Callable[[], Result]) -> Result:
    """Do work that must not stop midway where no handler of a signal runs, in another thread than the main one, and wait for it."""
    holds = one_at_a_time._is_owned()  # pyright: ignore[reportAttributeAccessIssue]  # another thread would wait for this one
    if holds or threading.current_thread() is not threading.main_thread():
        return work()
    try:
        begun = _others.submit(work)
    except RuntimeError:  # while the interpreter exits
        return work()
    return begun.result()


def _begin_anew() -> None:
    global _others
    _others = ThreadPoolExecutor(thread_name_prefix="jfrnn-start")


_begin_anew()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)  # its threads stay behind


def level_of_caller() -> int:
    """Return the stacklevel that makes a warning name the caller of the library, also where JAX stands between them."""
    frame, level = inspect.currentframe(), 0
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("jfrnn", "jax"):
        frame, level = frame.f_back, level + 1
    return level
