"""Where compiled programs call the library: one target of XLA for all kernels, registered when the library is imported.

A call names its kernel, for the shapes of its arrays, and says what the kernel was made of. So a program also runs in a process
that has not traced it: one that was exported, or that comes from JAX's persistent compilation cache.

A call runs native code (`native/launch/launch.h`), on the thread on which XLA calls, and no Python. Python is asked once for each
kernel, by name: it compiles what is launched, and lays down in what order, with which arguments (`jfrnn._engine.plans`).
"""

import atexit
import contextlib
import ctypes
import functools
import importlib
import json
import mmap
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import Array

from jfrnn._engine.ffi import CallFrame
from jfrnn._engine.plans import MOST_WORDS, Desk, LaidPlan, Plan, begin_programs, lay_plan, multiprocessors_of, open_desk
from jfrnn._engine.start import alone, apart, compiler, finish, wait_for, warn_of_folders
from jfrnn._tracing import check_version, decode, encode, name_of_version
from jfrnn.kernels import Program, one_at_a_time

TARGET = "jfrnn"  # what programs call; jax.export wants to be told that it stays
Static = Any  # what a kernel is made of, and a program carries: NamedTuples of the library, tuples, texts, numbers
Shapes = Mapping[str, tuple[int, ...]]
CFunction = Any


class Call(NamedTuple):
    """What XLA calls by a name.

    Attributes:
        name: Tells the kernel from all others, apart from shapes.
        inputs: The names of the arrays that are given.
        results: The dtypes of those that are written, by name.
        plan: Shapes of all arrays, by name, and the multiprocessors of the device (the CPU: 1) -> what is launched.
        instead: The names of inputs in whose place results are written, by those of the results.
    """

    name: str
    inputs: Sequence[str]
    results: Mapping[str, Any]
    plan: Callable[[Shapes, int], Plan]
    instead: Mapping[str, str] = {}


_calls: dict[str, Callable[..., Call]] = {}
_MOST = 512  # plans that are kept, as many as compiled programs: what a program calls that is gone is made again


def kernel(make: Callable[..., Call]) -> Callable[..., Callable[..., Any]]:
    """Make a function that XLA calls of what makes a call of static arguments, once for each of them.

    Programs carry the arguments: NamedTuples of the library, tuples, texts, numbers.
    """
    place = f"{make.__module__}.{make.__name__}"

    @functools.wraps(make)
    def made(*arguments: Static) -> Callable[..., Any]:
        found = make(*arguments)
        return functools.partial(_call, found, json.dumps([place, encode(arguments)]))

    _calls[place] = make
    return functools.lru_cache(_MOST)(made)


def _call(found: Call, recipe: str, *inputs: Array, output_dims: dict[str, Any]) -> Sequence[Array]:
    begins_cold()
    dims = [output_dims[key] for key in found.results]
    written = [shape if isinstance(shape, tuple) else (shape,) for shape in dims]
    kinds = [getattr(jax.typeof(x), "manual_axis_type", None) for x in inputs]
    axes, more = frozenset().union(*(kind.varying for kind in kinds if kind is not None)), {}
    if axes:  # inside `jax.shard_map`, results vary along the axes along which an input does
        mesh, everywhere = jax.sharding.get_abstract_mesh(), jax.sharding.PartitionSpec()
        kind = jax.sharding.ManualAxisType(varying=axes)  # pyright: ignore[reportAttributeAccessIssue]
        more = {"manual_axis_type": kind, "sharding": jax.sharding.NamedSharding(mesh, everywhere)}
    results = [jax.ShapeDtypeStruct(shape, dtype, **more) for shape, dtype in zip(written, found.results.values(), strict=True)]
    shapes = "_".join("x".join(map(str, shape)) for shape in (*(x.shape for x in inputs), *written))
    name = f"{found.name}@{name_of_version()}@{shapes}"
    names = list(found.inputs), list(found.results)
    aliases = {names[0].index(given): names[1].index(result) for result, given in found.instead.items()}
    call = jax.ffi.ffi_call(TARGET, results, vmap_method="sequential", input_output_aliases=aliases)
    return call(*inputs, kernel=name, recipe=recipe)


# --- what a program carries -------------------------------------------------------------------------------------------


def _read_call(name: str, recipe: str) -> tuple[Call, Shapes]:
    """Return what a program calls, and with which shapes.

    Raises:
        RuntimeError: Another version of the library made the program.
    """
    _, sources, shapes = name.split("@")
    check_version(sources)
    place, arguments = json.loads(recipe)
    module = place.rpartition(".")[0]
    if place not in _calls and module.startswith("jfrnn."):
        importlib.import_module(module)
    found = _calls[place](*decode(arguments))
    numbers = [tuple(map(int, filter(None, shape.split("x")))) for shape in shapes.split("_")]
    return found, dict(zip([*found.inputs, *found.results], numbers, strict=True))


# --- what native code asks of Python ----------------------------------------------------------------------------------

_Text = ctypes.c_void_p, ctypes.c_longlong
_MakePlan = ctypes.CFUNCTYPE(None, *_Text, *_Text, ctypes.c_int, ctypes.c_void_p)
_plans: dict[tuple[str, int], LaidPlan] = {}  # by name and device, those that were made last at the end


_COMPILED_BEFORE = (0, 3)  # the latest version of XLA's foreign function interface with which this was tested
_CPU, _CUDA_SOON, _CPU_SOON = -1, -2, -3  # in place of a CUDA device; SOON: of a program that is made, for the first device


def _keep_plan(name: str, recipe: str, device: int) -> None:
    """Let calls find a plan; of a program that is being made, only begin to compile what nobody has compiled yet."""
    made, device = device not in (_CUDA_SOON, _CPU_SOON), _number_of(device)
    if (name, device) in _plans:
        return
    plan, shapes, begun = _begin_plan(name, recipe, device)
    if begun and not made:
        return
    wait_for(begun)
    desk = _open()
    with one_at_a_time:
        if (name, device) in _plans:
            return
        laid = lay_plan(name, plan, shapes, device)
        while len(_plans) >= _MOST:
            desk.drop(_plans.pop(next(iter(_plans))))
        _plans[name, device] = laid
        desk.keep(laid)


def _number_of(device: int) -> int:
    if device == _CUDA_SOON:
        return jax.local_devices(backend="cuda")[0].local_hardware_id  # there may be others, that are not for this process
    return _CPU if device == _CPU_SOON else device


def _begin_plan(name: str, recipe: str, device: int) -> tuple[Plan, Shapes, list[Future[Path]]]:
    """Return a plan, the shapes for which it is made, and what waits for those programs of it that nobody has compiled yet."""
    found, shapes = _read_call(name, recipe)
    plan = found.plan(shapes, multiprocessors_of(device))
    return plan, shapes, begin_programs(plan, device)


def _make_plan(name: int, name_size: int, recipe: int, recipe_size: int, device: int, wrong: int) -> None:
    """Keep a plan, and write down what goes wrong, for native code to read."""
    try:
        _keep_plan(ctypes.string_at(name, name_size).decode(), ctypes.string_at(recipe, recipe_size).decode(), device)
        message = b""
    except BaseException as error:
        message = _describe(error).encode(errors="replace")[: MOST_WORDS - 1].decode(errors="ignore").encode()
    ctypes.memmove(wrong, message + b"\0", len(message) + 1)


def _describe(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


# --- what XLA calls ---------------------------------------------------------------------------------------------------

_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)  # address of a call frame -> address of an error, or none
_PLATFORMS = {"cpu": _CPU_SOON, "CUDA": _CUDA_SOON}
# Instructions that jump to an address that stands behind them, by processor.
_JUMPS = {"x86_64": b"\xff\x25\x02\x00\x00\x00\x90\x90", "aarch64": b"\x50\x00\x00\x58\x00\x02\x1f\xd6"}


class _Door:
    """What XLA is told to call: leads to Python until native code is there, and from then on to that."""

    def __init__(self, soon: int) -> None:
        self._soon = soon  # in place of a device, where a program is made
        # XLA's call becomes that of a class, which changes what it leads to: native code is then called without Python between,
        # on which a handler of a signal could raise
        self._way: Any = type("Way", (), {"__call__": staticmethod(self._enter)})
        self._python = _Handler(self._way())
        self.address = _address(self._python)
        with contextlib.suppress(OSError, ValueError, AttributeError, KeyError):  # Python goes on to lead there
            code = _JUMPS[platform.machine()]
            kind = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS  # processes that fork lead elsewhere
            room = mmap.mmap(-1, mmap.PAGESIZE, kind, mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
            room[: len(code)] = code
            self._goal = ctypes.c_uint64.from_buffer(room, len(code))
            self._goal.value = self.address
            self.address = ctypes.addressof(self._goal) - len(code)

    def lead_to(self, address: int) -> None:
        """Lead to native code."""
        self._native = self._way.__call__ = _Handler(address)
        if hasattr(self, "_goal"):
            self._goal.value = address

    def _enter(self, address: int) -> int | None:
        frame = CallFrame.from_address(address)
        try:
            if frame.tell_version():
                return None
            if frame.instantiates and begins_cold():  # what is called compiles beside the native code
                name, recipe = frame.text("kernel"), frame.text("recipe")
                apart(lambda: _begin_plan(name, recipe, _number_of(self._soon)))
                return None
            apart(_open)
            return self._native(address)
        except BaseException as error:
            return frame.fail(f"{TARGET}: {_describe(error)}")


def _address(function: CFunction) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


_doors = {name: _Door(soon) for name, soon in _PLATFORMS.items()}
_behind_desk = _MakePlan(_make_plan)


def _open() -> Desk:
    """Compile the native code, once, and lead all calls there."""
    finish(_begun)
    return _opened()


@functools.cache
def _launcher() -> Program:
    return compiler().launcher((Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text("utf-8"))


@functools.cache
def _begun() -> Future[Path] | None:
    """Begin to compile the native code; return what waits for it, or None if a file of it is kept."""
    return compiler().begin(_launcher())


@functools.cache
def begins_cold() -> bool:
    """Begin to compile the native code, while the program that calls it is traced; say whether no file of it was kept.

    Who needs the native code learns of errors.
    """
    with contextlib.suppress(Exception):
        return apart(_begun) is not None
    return False


@alone
@functools.cache
def _opened() -> Desk:
    desk = open_desk(compiler().load(_launcher()), _address(_behind_desk), _MOST)
    for name, address in zip(_PLATFORMS, desk.handlers, strict=True):
        _doors[name].lead_to(address)
    atexit.register(desk.close)  # who asks while the interpreter exits would wait for it, and it for them; no result is waited for
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=desk.begin_anew)
    return desk


def open_native() -> None:
    """Compile what stands between XLA and the kernels, if it is not yet there.

    Where that begins in this process, and nothing is known that could keep it from ending, this does not wait: calls do.

    Raises:
        RuntimeError: It cannot be compiled.
    """
    if not (begins_cold() and _will_compile()):
        apart(_open)
    warn_of_folders()


@functools.cache
def _will_compile() -> bool:
    """Say whether the native code is sure to compile: a compiler is there, and XLA's interface is one that was compiled before."""
    known = re.findall(r"^#define XLA_FFI_API_(?:MAJOR|MINOR) (\d+)", _launcher().text, re.MULTILINE)
    return compiler().can_compile() and (0, 0) < tuple(map(int, known)) <= _COMPILED_BEFORE


for _name, _door in _doors.items():
    _capsule = jax.ffi.pycapsule(_door.address)
    jax.ffi.register_ffi_target(TARGET, {"instantiate": _capsule, "execute": _capsule}, platform=_name)
