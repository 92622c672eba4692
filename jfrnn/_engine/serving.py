"""What XLA calls: kernels made into functions that serve a call, on the CPU and on CUDA."""

import threading
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from jfrnn._engine.cuda import Command
from jfrnn._engine.cuda import serve as serve_on_cuda
from jfrnn._engine.ffi import CallFrame
from jfrnn._engine.launch import Kernel
from jfrnn._engine.start import WarpArray, WarpDevice, load_warp

_one_at_a_time = threading.Lock()  # is served: on the CPU it takes all cores, and a hash grid is kept for all


def on_cuda(name: str, types: dict[str, Any], outputs: int, commands: Callable[..., list[Command]]) -> Kernel:
    """Return what runs commands on CUDA when XLA calls."""
    return Kernel(name, types, outputs, serve_on_cuda(load_warp(), [kind.dtype for kind in types.values()], commands))


def on_cpu(name: str, run: Callable[..., None], types: dict[str, Any], outputs: int) -> Kernel:
    """Return what calls `run` with a `warp.array` for each buffer when XLA calls on the CPU."""
    wp, dtypes = load_warp(), [kind.dtype for kind in types.values()]

    def serve(frame: CallFrame) -> None:
        arrays = _arrays(wp, frame, dtypes, wp.get_device("cpu"))
        with _one_at_a_time:
            run(*arrays)

    return Kernel(name, types, outputs, serve)


def on_stream(name: str, run: Callable[..., None], types: dict[str, Any], outputs: int) -> Kernel:
    """Return what calls `run` as `on_cpu` does, on CUDA, where it launches on the stream of the call."""
    wp, dtypes = load_warp(), [kind.dtype for kind in types.values()]
    streams: dict[int, Any] = {}  # Warp forgets one that is gone

    def serve(frame: CallFrame) -> None:
        device, address = wp.get_cuda_device(frame.device()), frame.stream()
        with _one_at_a_time:
            if address not in streams:
                streams[address] = wp.Stream(device, cuda_stream=address)
            with wp.ScopedStream(streams[address], sync_enter=False):
                run(*_arrays(wp, frame, dtypes, device))

    return Kernel(name, types, outputs, serve)


def stand_in(like: WarpArray, rows: int) -> WarpArray:
    """Return what a kernel is given in place of rows of int32 that it neither reads nor writes: memory that is there anyway."""
    return load_warp().array(ptr=like.ptr, shape=(rows, 1), dtype=like.dtype, device=like.device)


def _arrays(wp: ModuleType, frame: CallFrame, dtypes: Sequence[Any], device: WarpDevice) -> list[WarpArray]:
    buffers = zip(frame.buffers(), dtypes, strict=True)
    return [wp.array(ptr=x.data, shape=x.shape, dtype=dtype, device=device) for x, dtype in buffers]
