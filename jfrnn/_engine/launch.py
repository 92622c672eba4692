"""Where compiled programs call the library: one target of XLA for all kernels, registered when the library is imported.

A call names its kernel and says what it was made of. So a program also runs in a process that has not traced it: one that was
exported, or that comes from JAX's persistent compilation cache.

XLA calls from any thread, the main one included, on which Python runs the handlers of signals between any two instructions. No
Python of the library ever runs there: a native relay (`jfrnn.kernels.relay`) lets another thread answer. An exception that a
handler raises comes up as itself when the call has ended, and nothing that was begun is left unfinished.
"""

import _thread
import atexit
import contextlib
import ctypes
import functools
import hashlib
import importlib
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from jfrnn._engine.ffi import EXECUTE, CallFrame
from jfrnn._engine.start import apart, kernels_of, load_warp

TARGET = "jfrnn"  # what programs call; jax.export wants to be told that it stays
Serve = Callable[[CallFrame], None]
Static = Any  # what a kernel is made of, and a program carries: NamedTuples of the library, tuples, texts, numbers
CFunction = Any  # a function that ctypes can call, or that can be called from C


class Kernel(NamedTuple):
    """What XLA calls by a name: Warp's types of its arrays, of which the last ones are outputs, and what serves a call."""

    name: str
    types: dict[str, Any]
    outputs: int
    serve: Serve


_makers: dict[str, Callable[..., Any]] = {}
_MOST = 512  # kernels that are kept, as many as compiled programs: what a program calls that is gone is made again
_served: dict[bytes, Serve] = {}  # by names, those that were made last at the end
_keeping = threading.Lock()


def kernel(make: Callable[..., Kernel]) -> Callable[..., Callable[..., Any]]:
    """Make a function that XLA calls of what makes a kernel of static arguments, once for each of them.

    Programs carry the arguments: NamedTuples of the library, tuples, texts, numbers.
    """
    place = f"{make.__module__}.{make.__name__}"

    @functools.wraps(make)
    def made(*arguments: Static) -> Callable[..., Any]:
        return apart(functools.partial(_made, make, place, arguments))

    _makers[place] = made
    return functools.lru_cache(_MOST)(made)


def _made(make: Callable[..., Kernel], place: str, arguments: tuple[Any, ...]) -> Callable[..., Any]:
    open_relay()
    _finish_before_exit()
    found = make(*arguments)
    name = f"{found.name}@{_sources()}"
    recipe = json.dumps([place, _encode(arguments)])
    _keep(name.encode(), found.serve)
    return functools.partial(_call, found, name, recipe)


def _keep(name: bytes, serve: Serve) -> None:
    with _keeping:
        _served.pop(name, None)
        _served[name] = serve
        while len(_served) > _MOST:
            _served.pop(next(iter(_served)))


def _call(found: Kernel, name: str, recipe: str, *inputs: Array, output_dims: dict[str, Any]) -> Sequence[Array]:
    wp, kind = load_warp(), _varying(inputs)
    results = {key: wp.dtype_to_numpy(found.types[key].dtype) for key in list(found.types)[-found.outputs :]}
    shapes = [jax.ShapeDtypeStruct(_shape(output_dims[key]), results[key], **kind) for key in results]
    return jax.ffi.ffi_call(TARGET, shapes, vmap_method="sequential")(*inputs, kernel=name, recipe=recipe)


def _shape(dims: int | tuple[int, ...]) -> tuple[int, ...]:
    return dims if isinstance(dims, tuple) else (dims,)


def _varying(inputs: Sequence[Array]) -> dict[str, Any]:
    """Return what types of results say inside `jax.shard_map`: they vary along the axes along which an input does."""
    kinds = [getattr(jax.typeof(x), "manual_axis_type", None) for x in inputs]
    axes = frozenset().union(*(kind.varying for kind in kinds if kind is not None))
    if not axes:
        return {}
    mesh, everywhere = jax.sharding.get_abstract_mesh(), jax.sharding.PartitionSpec()
    kind = jax.sharding.ManualAxisType(varying=axes)  # pyright: ignore[reportAttributeAccessIssue]
    return {"manual_axis_type": kind, "sharding": jax.sharding.NamedSharding(mesh, everywhere)}


# --- what a program carries -------------------------------------------------------------------------------------------


def _encode(value: Static) -> Static:
    if not isinstance(value, tuple):
        return value
    parts = [_encode(part) for part in value]
    return {f"{type(value).__module__}.{type(value).__name__}": parts} if hasattr(value, "_fields") else parts


def _decode(value: Static) -> Static:
    if isinstance(value, list):
        return tuple(_decode(part) for part in value)
    if not isinstance(value, dict):
        return value
    ((name, parts),) = value.items()
    module, _, kind = name.rpartition(".")
    if not module.startswith("jfrnn."):
        raise ValueError(f"no type of the library: {name}")
    return getattr(importlib.import_module(module), kind)(*map(_decode, parts))


@functools.cache
def _sources() -> str:
    """Return a name of the sources that decide what a kernel is given, so that it is never given what was made for another."""
    texts = [path.read_bytes() for package in ("jfrnn", "jfrnn.kernels") for path in _files(files(package))]
    return hashlib.sha256(b"".join(texts)).hexdigest()[:12]


def _files(folder: Traversable) -> Iterator[Traversable]:
    """Yield the sources in a folder and below it; packages that are installed beneath the library are asked for by themselves."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name):
        if path.is_dir() and path.name not in ("cases", "kernels"):
            yield from _files(path)
        elif path.name.endswith((".py", ".h", ".cuh")):
            yield path


def _server_of(frame: CallFrame) -> Serve:
    known = _served.get(frame.first_text())  # names of kernels look like no other attribute
    if known is not None:
        return known
    name = frame.text(b"kernel")
    while (known := _served.get(name)) is None:
        _make_again(name.decode(), frame.text(b"recipe").decode())
    return known


def _make_again(name: str, recipe: str) -> None:
    """Make a kernel of a program that this process has not traced, or that was not among the last ones."""
    if not name.endswith(f"@{_sources()}"):
        raise RuntimeError("this program was made with another version of jfrnn. Export or compile it again with this one.")
    place, arguments = json.loads(recipe)
    _makers[place](*_decode(arguments))


# --- what XLA calls ---------------------------------------------------------------------------------------------------

_Answer = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)  # address of a call frame -> address of an error, or none
_starting = threading.Lock()
_kept: list[Any] = []  # functions live as long as programs that call them: as long as the process


def _answer(address: int) -> int | None:
    """Serve a call; XLA raises what goes wrong."""
    frame = CallFrame.from_address(address)
    try:
        if frame.tell_version():
            return None
        serve = _server_of(frame)  # before anything runs, where XLA makes the program ready
        if frame.stage == EXECUTE:
            serve(frame)
    except BaseException as error:
        return frame.failure(f"{_name_in(frame)}: {type(error).__name__}: {error}")
    return None


def _name_in(frame: CallFrame) -> str:
    try:
        return frame.text(b"kernel").decode().partition("@")[0]
    except Exception:
        return TARGET


def _answer_first(address: int) -> int | None:
    """Serve a call where there is no relay yet, of a program that this process has not traced."""
    frame = CallFrame.from_address(address)
    if frame.tell_version():
        return None
    once, done, answers = threading.Lock(), threading.Event(), list[int | None]()

    def work() -> None:
        if not once.acquire(blocking=False):
            return
        with contextlib.suppress(BaseException):  # the call itself says what is wrong
            open_relay()
            _finish_before_exit()
        answers.append(_answer(address))
        done.set()

    _finish_whatever_comes(work, done)
    return answers[0]


def _finish_whatever_comes(work: Callable[[], None], done: threading.Event) -> None:
    """Let another thread work; what a handler of a signal raises here meanwhile is raised again when the call has ended."""
    raised, begun = None, 0
    while not done.is_set():
        try:
            begun = begun or _thread.start_new_thread(work, ())
            done.wait()
        except RuntimeError:  # while the interpreter exits, no thread can be started
            work()
        except BaseException as error:
            raised = error
    if raised is not None:
        main = ctypes.c_ulong(threading.main_thread().ident or 0)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(main, ctypes.py_object(type(raised)))


_behind_door = _Answer(_answer_first)
_door = ctypes.cast(_behind_door, _Answer)  # its address is exchanged for the relay's
_entrance = _Answer(_door)  # calls a function that is not Python: nothing runs in between


def open_relay() -> None:
    """Start Warp and the thread that answers in place of the main thread, and lead all calls there."""
    with _starting:
        if not _kept:
            _kept.extend(_relay())
            address = ctypes.c_void_p(_kept[0])
            ctypes.memmove(ctypes.addressof(_door), ctypes.addressof(address), ctypes.sizeof(address))


def _relay() -> list[Any]:
    """Return the address of the relay, and what it needs; without Warp's compiler for CPUs, calls are answered where they come."""
    wp, here = load_warp(), _Answer(_answer)
    if not wp.is_cpu_available():
        return [_address(here), here]
    relay, python = kernels_of("relay"), ctypes.CDLL(None, handle=ctypes.pythonapi._handle)  # lets others run Python meanwhile
    acquire, release, allocate = python.PyThread_acquire_lock, python.PyThread_release_lock, python.PyThread_allocate_lock
    acquire.argtypes, release.argtypes, allocate.restype = (ctypes.c_void_p, ctypes.c_int), (ctypes.c_void_p,), ctypes.c_void_p
    asked, answered = allocate(), allocate()
    for lock in (asked, answered):
        acquire(lock, 1)
    words = np.zeros(relay.WORDS, np.uint64)
    words[relay.ANSWER_HERE], words[relay.THREAD] = _address(here), _address(python.PyThread_get_thread_ident)
    words[relay.ACQUIRE], words[relay.RELEASE] = _address(acquire), _address(release)
    words[relay.MAIN_THREAD], words[relay.ASKED], words[relay.ANSWERED] = threading.main_thread().ident or 0, asked, answered

    def work() -> None:
        while True:
            acquire(asked, 1)
            words[relay.ANSWER] = _answer(int(words[relay.FRAME])) or 0
            release(answered)

    address = np.zeros(1, np.uint64)
    given = [wp.array(array, dtype=wp.uint64, device="cpu", copy=False) for array in (words, address)]
    kernels_of("_load").load_module(relay.open_relay.module, "cpu")
    wp.launch(relay.open_relay, dim=1, inputs=given, device="cpu")
    threading.Thread(target=work, name="jfrnn-relay", daemon=True).start()
    return [int(address[0]), here, words, given]


def _address(function: CFunction) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


@functools.cache
def _finish_before_exit() -> None:
    """Let the interpreter wait for results that are under way: what computes them needs it, and would wait for ever."""

    def finish() -> None:
        for array in jax.live_arrays():
            with contextlib.suppress(Exception):  # it has nobody left to be told to
                array.block_until_ready()

    atexit.register(finish)


def _register() -> None:
    capsule = jax.ffi.pycapsule(_address(_entrance))
    for platform in ("cpu", "CUDA"):
        jax.ffi.register_ffi_target(TARGET, {"instantiate": capsule, "execute": capsule}, platform=platform)


_register()
