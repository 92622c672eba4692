"""Kernels that XLA launches on CUDA: recorded once per shape, then launched on whatever buffers a call brings.

A CUDA graph launches all of them at once, but knows its addresses, and takes several times as long to make as a search of 28 000
particles. XLA brings the same addresses again in a loop, and often from call to call; but a program with many small results brings
others nearly every time. So graphs are made only of addresses that came back soon, and launches are told new ones otherwise.

The structures are those of XLA's foreign function interface (xla/ffi/api/c_api.h, version 0.1), of which only what is read here is
spelled out.
"""

import ctypes
import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

_SOON = 16  # calls with other addresses, within which the same ones must come back to be worth a graph
_GRAPHS = 32  # that are kept per function: more than can come back so soon
_API_VERSION = (0, 1)
_METADATA = 1  # the extension that asks for the version
_INTERNAL_ERROR = 13


class Command(NamedTuple):
    """A kernel, its arguments (arrays and numbers), its threads, in all and per block, whether it may run beside the one before."""

    kernel: Any
    arguments: Sequence[Any]
    threads: int
    block: int
    beside: bool = False


class _Version(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("major", ctypes.c_int), ("minor", ctypes.c_int))


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


class _Extension(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),  # of the one type that is looked at
    )


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _Ask(ctypes.Structure):
    """What is asked about a call: its stream, or the number of its device; the answer comes last."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("answer", ctypes.c_void_p),
    )


class _Failure(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


_Fail = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Failure))
_Get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Ask))


class _Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("fail", _Fail),
        ("others", ctypes.c_void_p * 3),
        ("get_stream", _Get),
        ("more", ctypes.c_void_p * 12),
        ("get_device", _Get),
    )


class _CallFrame(ctypes.Structure):
    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("inputs", _Buffers),
        ("outputs", _Buffers),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))
# Warp keeps one account of devices, streams and recordings for all threads; nothing is launched while this is held
_warp_lock = threading.Lock()
_kept: list[Any] = []  # handlers live as long as programs that call them: as long as the process


class _Stream(NamedTuple):
    """What a launch reads of a stream. Warp forgets a stream once any `wp.Stream` of it is gone, whoever else has one."""

    cuda_stream: int
    device: Any


class _Recorded(NamedTuple):
    """Launches, and the arguments of theirs that hold an address, each with the buffer whose address that is."""

    launches: list[Any]
    beside: list[bool]
    addresses: list[tuple[Any, int]]

    def launch(self, stream: Any, side: Any = None) -> None:  # noqa: ANN401
        """Launch all in order; those that may run beside others do, if there is a stream for them."""
        for k, launch in enumerate(self.launches):
            if side is None or not self.beside[k]:
                if side is not None and any(self.beside[k + 1 : k + 2]):
                    side.wait_stream(stream)
                launch.launch(stream)
            else:
                launch.launch(side)
                stream.wait_stream(side)


class _Calls:
    """The calls of one name on one stream of XLA, of which a thread makes one after the other; another device has another thread.

    Graphs are recorded from streams of Warp: those of XLA may be told to wait for each other meanwhile, by threads of other
    devices, and what waits for a stream that is being recorded is recorded, too.
    """

    def __init__(self, wp: Any, stream: _Stream, dtypes: Sequence[Any], commands: Callable[..., list[Command]]) -> None:  # noqa: ANN401
        self._wp, self._stream, self._dtypes, self._commands = wp, stream, dtypes, commands
        self._recorded: dict[tuple[int, ...], _Recorded] = {}
        self._recent: OrderedDict[tuple[int, ...], None] = OrderedDict()
        self._graphs: OrderedDict[tuple[int, ...], Any] = OrderedDict()
        self._lock = threading.Lock()

    def launch(self, buffers: list[_Buffer]) -> None:
        """Launch what the commands say, on these buffers."""
        with self._lock:
            here = [buffer.data for buffer in buffers]
            shapes = tuple(buffer.dims[k] for buffer in buffers for k in range(buffer.rank))
            key = (*here, *shapes)
            graph = self._graphs.get(key)
            if graph is not None:
                self._graphs.move_to_end(key)
                self._wp.capture_launch(graph, stream=self._stream)
                return
            if shapes not in self._recorded:
                with _warp_lock:
                    self._recorded[shapes] = _record(self._wp, self._stream.device, buffers, self._dtypes, self._commands)
            launches = self._recorded[shapes]
            for argument, place in launches.addresses:
                argument.data = here[place]
            if key not in self._recent:
                self._recent[key] = None
                if len(self._recent) > _SOON:
                    self._recent.popitem(last=False)
                launches.launch(self._stream)
                return
            with _warp_lock:
                first, side = _recording_streams(self._wp, self._stream.device.alias)
                with self._wp.ScopedCapture(stream=first) as capture:
                    launches.launch(first, side)
                self._graphs[key] = capture.graph
                if len(self._graphs) > _GRAPHS:
                    self._graphs.popitem(last=False)
            self._wp.capture_launch(capture.graph, stream=self._stream)


@functools.cache
def _recording_streams(wp: Any, device: str) -> tuple[Any, Any]:  # noqa: ANN401
    return wp.Stream(device), wp.Stream(device)


def register(name: str, wp: Any, dtypes: Sequence[Any], commands: Callable[..., list[Command]]) -> None:  # noqa: ANN401
    """Let XLA call kernels by a name, on CUDA.

    Args:
        name: Of the target of `jax.ffi.ffi_call`.
        wp: The package Warp.
        dtypes: Warp's scalar types of the buffers, inputs first.
        commands: arrays -> commands, in order; once per device and shapes, with a `warp.array` for each buffer.
    """
    streams: dict[int, _Calls] = {}

    def launch(frame: _CallFrame) -> None:
        buffers = [frame.inputs.buffers[k].contents for k in range(frame.inputs.size)]
        buffers += [frame.outputs.buffers[k].contents for k in range(frame.outputs.size)]
        ask = _Ask(ctypes.sizeof(_Ask), None, frame.context, None)
        frame.api.contents.get_stream(ask)
        address = ask.answer or 0
        if address not in streams:
            frame.api.contents.get_device(ask)
            with _warp_lock:
                device = wp.get_cuda_device((ask.answer or 0) & 0x7FFFFFFF)
                streams.setdefault(address, _Calls(wp, _Stream(address, device), dtypes, commands))
        streams[address].launch(buffers)

    def handle(frame: Any) -> int | None:  # noqa: ANN401
        call = frame.contents
        try:
            if call.extension:
                asked = call.extension.contents
                if asked.type == _METADATA:  # a question, no call; with any other extension it is one
                    version = asked.metadata.contents.version
                    version.major, version.minor = _API_VERSION
                    return None
            launch(call)
        except Exception as error:  # XLA raises it again
            message = f"{name}: {type(error).__name__}: {error}".encode()
            return call.api.contents.fail(_Failure(ctypes.sizeof(_Failure), None, message, _INTERNAL_ERROR))
        return None

    handler = _Handler(handle)
    _kept.append(handler)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.cast(handler, ctypes.c_void_p).value), platform="CUDA")


def _record(
    wp: Any,  # noqa: ANN401
    device: Any,  # noqa: ANN401
    buffers: list[_Buffer],
    dtypes: Sequence[Any],
    commands: Callable[..., list[Command]],
) -> _Recorded:
    arrays = [
        wp.array(ptr=buffer.data, shape=tuple(buffer.dims[k] for k in range(buffer.rank)), dtype=dtype, device=device)
        for buffer, dtype in zip(buffers, dtypes, strict=True)
    ]
    places = {id(array): place for place, array in enumerate(arrays)}
    launches: list[Any] = []
    addresses: dict[int, tuple[Any, int]] = {}
    listed = commands(*arrays)
    for kernel, arguments, threads, block, _ in listed:
        launch = wp.launch(kernel, dim=threads, inputs=list(arguments), device=device, block_dim=block, record_cmd=True)
        for index, argument in enumerate(arguments):
            if isinstance(argument, wp.array):
                # another view of a buffer is told by its address
                place = places.get(id(argument))
                place = next(k for k, array in enumerate(arrays) if array.ptr == argument.ptr) if place is None else place
                packed = argument.__ctype__()
                launch.set_param_at_index_from_ctype(index, packed)
                addresses[id(packed)] = (packed, place)
        launches.append(launch)
    return _Recorded(launches, [command.beside for command in listed], list(addresses.values()))
