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


# A kernel of one block of 256 that lets a graph go on if a word is not 0; the driver knows the function that it calls.
_DECIDE = b"""
.version 6.0
.target sm_50
.address_size 64
.extern .func cudaGraphSetConditional (.param .b64 condition, .param .b32 value);
.visible .entry decide (.param .u64 condition, .param .u64 words, .param .u32 count)
{
    .reg .b64 %condition, %words, %at;
    .reg .b32 %k, %count, %word, %found;
    .reg .pred %ends, %any;
    ld.param.u64 %condition, [condition];
    ld.param.u64 %words, [words];
    ld.param.u32 %count, [count];
    cvta.to.global.u64 %words, %words;
    mov.u32 %k, %tid.x;
    mov.u32 %found, 0;
next:
    setp.ge.u32 %ends, %k, %count;
    @%ends bra all;
    mul.wide.u32 %at, %k, 4;
    add.u64 %at, %words, %at;
    ld.global.u32 %word, [%at];
    or.b32 %found, %found, %word;
    add.u32 %k, %k, 256;
    bra next;
all:
    setp.ne.u32 %any, %found, 0;
    bar.red.or.pred %any, 0, %any;
    selp.u32 %found, 1, 0, %any;
    mov.u32 %k, %tid.x;
    setp.ne.u32 %ends, %k, 0;
    @%ends bra end;
    {
        .param .b64 to_condition;
        .param .b32 to_value;
        st.param.b64 [to_condition], %condition;
        st.param.b32 [to_value], %found;
        call.uni cudaGraphSetConditional, (to_condition, to_value);
    }
end:
    ret;
}
"""
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


@functools.cache
def find_decider(device: CudaDevice) -> int | None:
    """Return the handle of the function that decides whether a graph goes on, None where a driver has no such graphs."""
    if not has_graphs():
        return None
    module = load_module(device, _DECIDE)
    return None if module is None else find_function(module, "decide") or None


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
