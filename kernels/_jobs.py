"""Who works when: the lock of all that starts, loads and lays plans, and the threads that compile beside each other."""

import os
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

_MOST = 8  # compilers at once: each takes some 100 MB
Result = TypeVar("Result")
# The lock of all that starts, loads and lays plans, one thread at a time.
one_at_a_time = threading.RLock()
_begins = threading.RLock()  # a handler of a signal may fork while its thread holds it
_jobs: dict[Hashable, Future[Any]] = {}


def _make_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(2, min(_MOST, os.cpu_count() or 1)), thread_name_prefix="jfrnn-compile")


def begin(key: Hashable, work: Callable[[], Result]) -> Future[Result]:
    """Let another thread do work, unless one is at the work of this key; return what waits for it.

    Where no thread can begin any more, as the main one has ended, this one does it.
    """
    with _begins:
        job = _jobs.get(key)
        if job is not None and not job.done():
            return job
        try:
            job = _jobs[key] = _pool.submit(work)
            return job
        except RuntimeError:
            job = _jobs[key] = Future()
    try:
        job.set_result(work())
    except BaseException as error:
        job.set_exception(error)
    return job


def _hold() -> None:
    """Let no work be under way while a process forks: locks that a thread of it held would stay taken in the new one."""
    one_at_a_time.acquire()
    _begins.acquire()
    wait(_jobs.values())


def _go_on() -> None:
    _begins.release()
    one_at_a_time.release()


def _begin_anew() -> None:
    global _pool
    _pool = _make_pool()  # its threads stay behind
    _jobs.clear()
    _go_on()


_pool = _make_pool()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_go_on, after_in_child=_begin_anew)
