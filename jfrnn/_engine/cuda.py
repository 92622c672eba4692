"""Kernels that XLA launches on CUDA: recorded once per shape, then launched on whatever buffers a call brings.

A CUDA graph launches all of them at once, but knows its addresses, and takes several times as long to make as a search of 28 000
particles. XLA brings the same addresses again in a loop, and often from call to call; but a program with many small results brings
others nearly every time. So graphs are made only of addresses that came back soon, and launches are told new ones otherwise.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

from jfrnn._engine.ffi import Buffer, CallFrame
from jfrnn._engine.start import WarpArray, WarpDevice, WarpStream

_SOON = 16  # calls with other addresses, within which the same ones must come back to be worth a graph
_GRAPHS = 32  # that are kept per function: more than can come back so soon


class Command(NamedTuple):
    """A kernel, its arguments (arrays and numbers), its threads, in all and per block, whether it may run beside the one before."""

    kernel: Any
    arguments: Sequence[Any]
    threads: int
    block: int
    beside: bool = False


def multiprocessors_of(array: WarpArray) -> int:
    """Return how many multiprocessors the device of an array has; the CPU, on which tests launch kernels, counts as one."""
    return max(array.device.sm_count, 1)


# Warp keeps one account of devices, streams and recordings for all threads; nothing is launched while this is held
_warp_lock = threading.Lock()


class _Stream(NamedTuple):
    """What a launch reads of a stream. Warp forgets a stream once any `wp.Stream` of it is gone, whoever else has one."""

    cuda_stream: int
    device: Any


class _Recorded(NamedTuple):
    """Launches, and the arguments of theirs that hold an address, each with the buffer whose address that is."""

    launches: list[Any]
    beside: list[bool]
    addresses: list[tuple[Any, int]]

    def launch(self, stream: WarpStream, side: WarpStream = None) -> None:
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

    def __init__(self, wp: ModuleType, stream: _Stream, dtypes: Sequence[Any], commands: Callable[..., list[Command]]) -> None:
        self._wp, self._stream, self._dtypes, self._commands = wp, stream, dtypes, commands
        self._recorded: dict[tuple[int, ...], _Recorded] = {}
        self._recent: OrderedDict[tuple[int, ...], None] = OrderedDict()
        self._graphs: OrderedDict[tuple[int, ...], Any] = OrderedDict()
        self._lock = threading.Lock()

    def launch(self, buffers: list[Buffer]) -> None:
        """Launch what the commands say, on these buffers."""
        with self._lock:
            self._stream.device.make_current()  # for the thread that answers in place of another one
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
def _recording_streams(wp: ModuleType, device: str) -> tuple[WarpStream, WarpStream]:
    return wp.Stream(device), wp.Stream(device)


def serve(wp: ModuleType, dtypes: Sequence[Any], commands: Callable[..., list[Command]]) -> Callable[[CallFrame], None]:
    """Return what launches kernels when XLA calls, on CUDA.

    Args:
        wp: The package Warp.
        dtypes: Warp's scalar types of the buffers, inputs first.
        commands: arrays -> commands, in order; once per device and shapes, with a `warp.array` for each buffer.
    """
    streams: dict[int, _Calls] = {}

    def launch(frame: CallFrame) -> None:
        address = frame.stream()
        if address not in streams:
            with _warp_lock:
                device = wp.get_cuda_device(frame.device())
                streams.setdefault(address, _Calls(wp, _Stream(address, device), dtypes, commands))
        streams[address].launch(frame.buffers())

    return launch


def _record(
    wp: ModuleType,
    device: WarpDevice,
    buffers: list[Buffer],
    dtypes: Sequence[Any],
    commands: Callable[..., list[Command]],
) -> _Recorded:
    arrays = [
        wp.array(ptr=buffer.data, shape=buffer.shape, dtype=dtype, device=device)
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
