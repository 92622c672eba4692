"""CUDA's driver, called without importing Warp, which takes longer than to load programs that are compiled already.

Devices have the numbers that JAX and Warp give them, and their primary contexts, in which both work.
"""

import contextlib
import ctypes
import functools
import os
from collections.abc import Callable, Iterator
from typing import NamedTuple

_MULTIPROCESSORS, _MAJOR, _MINOR = 16, 75, 76  # attributes of a device
_APART, _UNTIMED = 1, 2  # a stream that does not wait for the default one, and an event without a time
_Handle = ctypes.c_void_p


class CudaDevice(NamedTuple):
    """A device: its number, its primary context, its compute capability as in 90, and how many multiprocessors it has."""

    number: int
    context: int
    arch: int
    multiprocessors: int


@functools.cache
def driver() -> ctypes.CDLL:
    """Return the library of the driver, which is started.

    Raises:
        RuntimeError: There is none, or it does not start.
    """
    try:
        found = ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError as error:
        raise RuntimeError(f"there is no CUDA driver: {error}") from error
    for name in ("cuCtxPushCurrent_v2", "cuModuleUnload"):
        getattr(found, name).argtypes = [_Handle]
    found.cuModuleLoadData.argtypes = [ctypes.POINTER(_Handle), ctypes.c_char_p]
    found.cuModuleGetFunction.argtypes = [ctypes.POINTER(_Handle), _Handle, ctypes.c_char_p]
    if code := found.cuInit(0):
        raise RuntimeError(f"the CUDA driver does not start, error {code}")
    return found


def version() -> int:
    """Return the version of CUDA that the driver has."""
    return _number(driver().cuDriverGetVersion)


def device_count() -> int:
    """Return how many devices there are."""
    return _number(driver().cuDeviceGetCount)


@functools.cache
def find_device(number: int) -> CudaDevice:
    """Return a device; its primary context stays, as JAX lets it."""
    handle, context = ctypes.c_int(), _Handle()
    _check(driver().cuDeviceGet(ctypes.byref(handle), number), "cuDeviceGet")
    _check(driver().cuDevicePrimaryCtxRetain(ctypes.byref(context), handle), "cuDevicePrimaryCtxRetain")
    kinds = _MAJOR, _MINOR, _MULTIPROCESSORS
    major, minor, multiprocessors = (_number(driver().cuDeviceGetAttribute, kind, handle) for kind in kinds)
    return CudaDevice(number, context.value or 0, 10 * major + minor, multiprocessors)


# Functions of the driver that record launches in a graph behind a condition (CUDA 12.3), by the names of native code.
GRAPHS = {
    "make_graph": "cuGraphCreate",
    "make_condition": "cuGraphConditionalHandleCreate",
    "begin_record": "cuStreamBeginCaptureToGraph",
    "end_record": "cuStreamEndCapture",
    "nodes_of": "cuGraphGetNodes",
    "add_node": "cuGraphAddNode",
    "make_ready": "cuGraphInstantiateWithFlags",
    "drop_graph": "cuGraphDestroy",
    "run_graph": "cuGraphLaunch",
    "drop_ready": "cuGraphExecDestroy",
}


@functools.cache
def has_graphs() -> bool:
    """Say whether the driver has all that records launches."""
    return all(hasattr(driver(), name) for name in GRAPHS.values())


def load_module(device: CudaDevice, binary: bytes) -> int | None:
    """Load a program, a cubin or PTX; return None where it cannot be loaded."""
    handle = _Handle()
    with _in_context(device):
        code = driver().cuModuleLoadData(ctypes.byref(handle), binary)  # bytes of Python end with the zero that PTX needs
    return None if code else handle.value


def find_function(module: int, name: str) -> int:
    """Return the handle of a function, or 0."""
    handle = _Handle()
    code = driver().cuModuleGetFunction(ctypes.byref(handle), module, name.encode())
    return 0 if code else handle.value or 0


def unload_module(device: CudaDevice, module: int) -> None:
    """Give back the memory of a program, when the device has done its work."""
    with _in_context(device):
        driver().cuCtxSynchronize()
        driver().cuModuleUnload(module)


def make_stream(device: CudaDevice) -> int:
    """Make a stream that stays."""
    return _made(device, "cuStreamCreate", _APART)


def make_event(device: CudaDevice) -> int:
    """Make an event that stays."""
    return _made(device, "cuEventCreate", _UNTIMED)


def _made(device: CudaDevice, name: str, kind: int) -> int:
    handle = _Handle()
    with _in_context(device):
        _check(getattr(driver(), name)(ctypes.byref(handle), kind), name)
    return handle.value or 0


def _number(call: Callable[..., int], *given: object) -> int:
    found = ctypes.c_int()
    _check(call(ctypes.byref(found), *given), "a question to the driver")
    return found.value


@contextlib.contextmanager
def _in_context(device: CudaDevice) -> Iterator[None]:
    _check(driver().cuCtxPushCurrent_v2(device.context), "cuCtxPushCurrent")
    try:
        yield
    finally:
        driver().cuCtxPopCurrent_v2(ctypes.byref(_Handle()))


def _check(code: int, what: str) -> None:
    if code:
        raise RuntimeError(f"{what} failed with CUDA's error {code}")
