"""What is launched when XLA calls: plans, and how they are laid down for native code (`kernels/native/launch/desk.h`)."""

import ctypes
import dataclasses
import functools
import math
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jfrnn._engine.start import compiler, warn_of_folders
from jfrnn.kernels import Kernel, Program, _driver
from jfrnn.kernels._native import EXCLUDED, TABLE

if TYPE_CHECKING:
    from jfrnn.kernels._compile import Library

PLACES_PER_THREAD = 512  # below, a second thread costs more than it saves
_HUGE = 1 << 22  # bytes from which an array is worth a request for huge pages
_MOST_BYTES, _MOST_ARRAYS, MOST_WORDS, _MOST_RECORDED, _MOST_ASKED = 1024, 48, 1024, 32, 1024  # those of the native code
_ONCE, _SHARED, _CUDA, _CUDA_BESIDE, _CLEAR, _HUGE_PAGES = range(6)
# arguments that kernels name, and some of them do not read
_MAY_LACK = (*EXCLUDED, *TABLE, "radii", "query_radii", "grids", "longest")
_STREAM = "stream"  # the name of an argument that gets the stream of the call, as if that were an array


class Launch(NamedTuple):
    """A kernel is launched.

    Attributes:
        kernel: Its arguments are the arrays and numbers of the plan that have their names.
        threads: On CUDA in all; on the CPU, so many may share the work.
        numbers: Arguments of this launch alone, by name.
        beside: Whether it may run while the launch before it does (CUDA).
    """

    kernel: Kernel
    threads: int = 1
    numbers: Mapping[str, int] = {}
    beside: bool = False


class Clear(NamedTuple):
    """Zeros are written to an array, of so many bytes."""

    array: str
    size: int


class HugePages(NamedTuple):
    """The operating system is asked to back an array of so many bytes with huge pages."""

    array: str
    size: int


class Kept(NamedTuple):
    """Addresses by the names of arguments, and what has to live as long as they are used."""

    addresses: Mapping[str, int]
    held: Any


class Plan(NamedTuple):
    """What is launched.

    Attributes:
        steps: Launches, in order. One of a kernel for the CPU runs on the host, also among those on CUDA.
        numbers: Arguments of kernels, by name.
        absent: Arrays that no kernel touches, though it names them.
        keep: The number of a CUDA device, or -1 -> what is kept there for all calls, which take turns then.
        asked: The name of an array of int32, on CUDA: the first step writes it, and others are launched if a word is not 0.
        decide: With `asked`, the first step as one that sets its argument `condition`, that of a graph.
        same: The names of arguments that are other arrays of the call, by the names of these.
    """

    steps: Sequence[Launch | Clear | HugePages]
    numbers: Mapping[str, int]
    absent: Sequence[str] = ()
    keep: Callable[[int], Kept] | None = None
    asked: str | None = None
    decide: Launch | None = None
    same: Mapping[str, str] = {}


def share(kernel: Kernel, places: int, each: int = PLACES_PER_THREAD) -> Launch:
    """Return the launch of a kernel of the CPU whose work threads share, at least `each` places a thread."""
    return Launch(kernel, -(-places // each))


def ask_for_huge_pages(array: str, size: int) -> list[HugePages]:
    """Return the request for a large array; a small one is not worth it."""
    return [HugePages(array, size)] if size >= _HUGE else []


def begin_programs(plan: Plan, device: int) -> list[Future[Path]]:
    """Let threads compile what a plan launches on a device, and no file keeps; return what waits for them."""
    # what is launched last takes longest to compile
    steps = [*reversed(plan.steps), *([] if plan.decide is None else [plan.decide])]
    programs = dict.fromkeys(step.kernel.program for step in steps if isinstance(step, Launch))
    begun = [compiler().begin(program, _place(program, device)) for program in programs]
    return [job for job in begun if job is not None]


def _place(program: Program, device: int) -> str:
    """Return on what a program runs whose calls are on a device, as Warp names it."""
    return f"cuda:{device}" if device >= 0 and program.cuda else "cpu"


# --- as native code reads them ----------------------------------------------------------------------------------------


class _Step(ctypes.Structure):
    _fields_ = (
        ("function", ctypes.c_void_p),
        ("arguments", ctypes.c_void_p),
        ("arrays", ctypes.c_void_p),
        ("size", ctypes.c_int),
        ("array_count", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("block", ctypes.c_int),
        ("threads", ctypes.c_longlong),
    )


class _Recorded(ctypes.Structure):
    _fields_ = (
        ("arrays", ctypes.c_void_p * _MOST_ARRAYS),
        ("count", ctypes.c_int),
        ("times", ctypes.c_int),
        ("met", ctypes.c_uint),
        ("graph", ctypes.c_void_p),
    )


class _Recorder(ctypes.Structure):
    _fields_ = (
        ("stream", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("decide", ctypes.c_void_p),
        ("condition", ctypes.c_int),
        ("recorded", _Recorded * _MOST_RECORDED),
        ("turn", ctypes.c_uint),
        ("locked", ctypes.c_int),
        ("fails", ctypes.c_int),
    )


class _Plan(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_char_p),
        ("name_size", ctypes.c_longlong),
        ("hash", ctypes.c_ulonglong),
        ("users", ctypes.c_longlong),
        ("steps", ctypes.c_void_p),
        ("side", ctypes.c_void_p),
        ("begun", ctypes.c_void_p),
        ("ended", ctypes.c_void_p),
        ("device", ctypes.c_int),
        ("step_count", ctypes.c_int),
        ("in_turns", ctypes.c_int),
        ("asked", ctypes.c_int),
        ("asked_words", ctypes.c_int),
        ("recorder", ctypes.c_void_p),
    )


_OF_PYTHON = {
    "is_alive": "Py_IsInitialized",
    "has_lock": "PyGILState_Check",
    "this_thread": "PyThread_get_thread_ident",
    "start_thread": "PyThread_start_new_thread",
    "make_lock": "PyThread_allocate_lock",
    "take_lock": "PyThread_acquire_lock",
    "give_lock": "PyThread_release_lock",
    "free_lock": "PyThread_free_lock",
}


_OF_DRIVER = {
    "launch": "cuLaunchKernel",
    "clear": "cuMemsetD32Async",
    "record": "cuEventRecord",
    "wait": "cuStreamWaitEvent",
    "read": "cuMemcpyDtoHAsync_v2",
    "finish": "cuStreamSynchronize",
}


class _Desk(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("make_plan", "yield", "advise", *_OF_DRIVER, *_driver.GRAPHS)),
        *((name, ctypes.c_void_p) for name in _OF_PYTHON),
        ("plans", ctypes.c_void_p),
        ("plan_count", ctypes.c_longlong),
        ("main_thread", ctypes.c_ulong),
        ("locked", ctypes.c_int),
        ("forking", ctypes.c_int),
        ("asking", ctypes.c_int),
        ("closed", ctypes.c_int),
        ("turn", ctypes.c_void_p),
    )


class LaidPlan(NamedTuple):
    """A plan as native code reads it, and all that has to live as long."""

    plan: _Plan
    held: list[Any]


def lay_plan(name: str, plan: Plan, shapes: Mapping[str, tuple[int, ...]], device: int) -> LaidPlan:
    """Compile what a plan launches, and lay it down.

    Args:
        name: By which it is found.
        plan: What is launched.
        shapes: Those of the arrays that a call brings, in order, by name.
        device: The number of a CUDA device, or -1 for the CPU.
    """
    arrays = list(shapes)
    if len(arrays) > _MOST_ARRAYS:
        raise ValueError(f"{name} takes {len(arrays)} arrays, more than {_MOST_ARRAYS}")
    held: list[Any] = [text := name.encode()]
    if plan.keep is not None:
        kept = plan.keep(device)
        held.append(kept)
        plan = plan._replace(numbers={**plan.numbers, **kept.addresses}, absent=[*plan.absent, *kept.addresses])
    places = {array: k for k, array in enumerate([*arrays, _STREAM])}
    places |= {argument: places[array] for argument, array in plan.same.items()}
    lay = functools.partial(_lay_step, plan, places, device, held)
    laid = [lay(step) for step in plan.steps]
    warn_of_folders()
    steps = (_Step * len(laid))(*laid)
    found = _Plan(name=text, name_size=len(text), steps=ctypes.addressof(steps), device=device, step_count=len(laid))
    found.in_turns = plan.keep is not None
    found.asked = -1 if plan.asked is None else arrays.index(plan.asked)
    found.asked_words = 0 if plan.asked is None else math.prod(shapes[plan.asked])
    if found.asked_words > _MOST_ASKED:
        raise ValueError(f"{name} asks {found.asked_words} words, more than {_MOST_ASKED}")
    # a graph of a single launch would take less of the host, but longer on the device
    if device >= 0 and plan.keep is None and len(laid) > 1 and all(step.kind in (_CUDA, _CUDA_BESIDE, _CLEAR) for step in laid):
        held.append(recorder := _make_recorder(device))
        if recorder is not None and plan.decide is not None:
            held.append(step := lay(plan.decide))
            recorder.decide = ctypes.addressof(step)
            recorder.condition = next(field.place for field in plan.decide.kernel.fields if field.name == "condition")
        found.recorder = recorder and ctypes.addressof(recorder)
    if any(step.kind == _CUDA_BESIDE for step in laid):
        found.side, found.begun, found.ended = _second_stream(device)
    elif plan.keep is not None and device >= 0:
        found.ended = _end_of_turn(device)
    return LaidPlan(found, [*held, steps])


def _lay_step(plan: Plan, places: dict[str, int], device: int, held: list[Any], step: Launch | Clear | HugePages) -> _Step:
    if not isinstance(step, Launch):
        arrays = (ctypes.c_int * 2)(0, places[step.array])
        held.append(arrays)
        kind = _CLEAR if isinstance(step, Clear) else _HUGE_PAGES
        return _Step(arrays=ctypes.addressof(arrays), array_count=1, kind=kind, threads=step.size)
    kernel, numbers = step.kernel, {**plan.numbers, **step.numbers}
    if kernel.size > _MOST_BYTES:
        raise ValueError(f"{kernel.name} takes {kernel.size} bytes of arguments, more than {_MOST_BYTES}")
    left_out = {*plan.absent, *(name for name in _MAY_LACK if name not in places)}
    arrays = [field for field in kernel.fields if field.is_array and field.name not in left_out]
    pairs = [number for field in arrays for number in (field.place, places[field.name])]
    given = kernel.pack(numbers)
    library = compiler().load(kernel.program, place := _place(kernel.program, device))
    template, places_of_arrays = (ctypes.c_ubyte * len(given)).from_buffer(given), (ctypes.c_int * len(pairs))(*pairs)
    held += [library, template, places_of_arrays]
    return _Step(
        function=library.address_of(kernel.name),
        arguments=ctypes.addressof(template),
        arrays=ctypes.addressof(places_of_arrays),
        size=len(given),
        array_count=len(arrays),
        kind=(_CUDA_BESIDE if step.beside else _CUDA) if place != "cpu" else _SHARED if step.threads > 1 else _ONCE,
        block=kernel.block,
        threads=step.threads,
    )


@dataclasses.dataclass(frozen=True)
class Desk:
    """What both sides know of each other: `handlers` are the addresses of what XLA calls, on the CPU and on CUDA."""

    handlers: tuple[int, int]
    _desk: _Desk
    _held: list[Any]
    _keep: Callable[[int], None]
    _drop: Callable[[int], None]
    _begin_anew: Callable[[int], None]
    close: Callable[[], None]  # let Python end: waits for what it was asked, and answers other threads than the main one no more

    def keep(self, laid: LaidPlan) -> None:
        """Let calls find a plan."""
        if laid.plan.device >= 0 and not self._desk.launch:
            for name, function in (_OF_DRIVER | _driver.GRAPHS).items():
                setattr(self._desk, name, _address(_driver.driver(), function))
        self._keep(ctypes.addressof(laid.plan))

    def drop(self, laid: LaidPlan) -> None:
        """Let no call find a plan any longer, and wait for those that have found it."""
        self._drop(ctypes.addressof(laid.plan))

    def begin_anew(self) -> None:
        """Forget what threads were at, in a process that has begun by a fork."""
        self._begin_anew(threading.main_thread().ident or 0)


def open_desk(library: "Library", make_plan: int, most: int) -> Desk:
    """Open the native code.

    Args:
        library: The compiled program.
        make_plan: The address of what is asked for plans.
        most: How many plans are kept.
    """
    plans, c = (ctypes.c_void_p * (most + 1))(), _c_library()
    desk = _Desk(make_plan=make_plan, plans=ctypes.addressof(plans))
    setattr(desk, "yield", _address(c, "sched_yield") or _address(ctypes.pythonapi, "PyThread_get_thread_ident"))
    for key, function in _OF_PYTHON.items():
        setattr(desk, key, _address(ctypes.pythonapi, function))
    desk.main_thread = threading.main_thread().ident or 0
    desk.advise = _address(c, "madvise") if sys.platform.startswith("linux") else None
    size = ctypes.c_longlong
    take = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, size, size, size)(library.address_of("open_desk"))
    if not take(ctypes.addressof(desk), *map(ctypes.sizeof, (_Desk, _Plan, _Step))):
        raise RuntimeError("native code and Python lay plans in different ways")
    change = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    keep, drop = (change(library.address_of(name)) for name in ("keep_plan", "drop_plan"))
    begin_anew = ctypes.CFUNCTYPE(None, ctypes.c_ulong)(library.address_of("begin_anew"))
    handlers = library.address_of("answer_on_cpu"), library.address_of("answer_on_cuda")
    close = ctypes.CFUNCTYPE(None)(library.address_of("close_desk"))
    return Desk(handlers, desk, [library, plans], keep, drop, begin_anew, close)


def _address(library: ctypes.CDLL, name: str) -> int | None:
    function = getattr(library, name, None)
    return None if function is None else ctypes.cast(function, ctypes.c_void_p).value


def _c_library() -> ctypes.CDLL:
    return ctypes.CDLL("ucrtbase" if os.name == "nt" else None)


def multiprocessors_of(device: int) -> int:
    """Return how many multiprocessors a CUDA device has; the CPU, -1, counts as one."""
    return 1 if device < 0 else _driver.find_device(device).multiprocessors


@functools.cache
def _second_stream(device: int) -> tuple[int, int, int]:
    """Return a stream of a CUDA device, and two events, for launches that run beside others."""
    found = _driver.find_device(device)
    return _driver.make_stream(found), _driver.make_event(found), _driver.make_event(found)


def _make_recorder(device: int) -> _Recorder | None:
    """Return what records launches on a CUDA device; None where its driver cannot."""
    if not _driver.has_graphs():
        return None
    return _Recorder(stream=_recording_stream(device), context=_driver.find_device(device).context)


@functools.cache
def _recording_stream(device: int) -> int:
    """Return a stream of a CUDA device on which nothing ever runs."""
    return _driver.make_stream(_driver.find_device(device))


@functools.cache
def _end_of_turn(device: int) -> int:
    """Return an event of a CUDA device, for calls that take turns."""
    return _driver.make_event(_driver.find_device(device))
