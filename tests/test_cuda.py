"""The calls of XLA on CUDA, without a device: frames as XLA lays them out, and a Warp that notes what it is asked for."""

import contextlib
import ctypes
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from jfrnn._engine import cuda as _cuda
from jfrnn._engine import ffi as _ffi
from jfrnn._engine import launch as _launch

NAME = b"called@here"
DEVICES = [SimpleNamespace(alias=f"cuda:{k}", make_current=lambda: None) for k in range(2)]  # not hashable, as those of Warp


class Array:
    """What is used of a `warp.array`."""

    def __init__(self, ptr, shape, dtype, device):
        self.ptr, self.shape = ptr, shape
        self.packed = SimpleNamespace(data=ptr)

    def __ctype__(self):
        return self.packed


class Launch:
    def __init__(self, log, kernel, inputs):
        self.log, self.kernel, self.inputs = log, kernel, list(inputs)

    def set_param_at_index_from_ctype(self, index, value):
        self.inputs[index] = value

    def launch(self, stream):
        seen = tuple(getattr(x, "data", x) for x in self.inputs)
        self.log.append(("launch", self.kernel, seen, stream.cuda_stream))


class Warp:
    array = Array

    def __init__(self):
        self.log, self.recorded, self.streams, self.recording = [], 0, 0, 0

    def get_cuda_device(self, number):
        return DEVICES[number]

    def Stream(self, device):  # one of its own
        self.streams += 1
        stream = SimpleNamespace(device=device, cuda_stream=self.streams)
        stream.wait_stream = lambda other: self.log.append(("wait", stream.cuda_stream, other.cuda_stream))
        return stream

    def launch(self, kernel, dim, inputs, device, block_dim, record_cmd):
        assert record_cmd
        self.recorded += 1
        return Launch(self.log, kernel, inputs)

    @contextlib.contextmanager
    def ScopedCapture(self, stream):
        self.recording += 1
        time.sleep(0.01)
        assert self.recording == 1  # Warp has one account of what is recorded
        capture, begin = SimpleNamespace(graph=None), len(self.log)
        yield capture
        self.recording -= 1
        capture.graph = tuple(self.log[begin:])
        del self.log[begin:]

    def capture_launch(self, graph, stream):
        self.log.append(("graph", graph, stream.cuda_stream))


class Frame:
    """A call frame with an input [4, 2] and an output [4] at some addresses."""

    def __init__(self, addresses, extension=None, device=0):
        self.failure, self.number = None, device
        texts = [_ffi.Text(ctypes.cast(ctypes.c_char_p(text), ctypes.c_void_p), len(text)) for text in (b"kernel", NAME)]
        self.texts = [(ctypes.POINTER(_ffi.Text) * 1)(ctypes.pointer(text)) for text in texts]
        self.dims = [(ctypes.c_int64 * 2)(4, 2), (ctypes.c_int64 * 1)(4)]
        self.buffers = [
            _ffi.Buffer(ctypes.sizeof(_ffi.Buffer), None, 11, address, len(dims), dims)
            for address, dims in zip(addresses, self.dims, strict=True)
        ]
        self.pointers = [(ctypes.POINTER(_ffi.Buffer) * 1)(ctypes.pointer(buffer)) for buffer in self.buffers]
        self.functions = [_ffi.Get(self.stream), _ffi.Get(self.device), _ffi.Fail(self.fail)]
        self.api = _ffi.Api(get_stream=self.functions[0], get_device=self.functions[1], fail=self.functions[2])
        self.frame = _ffi.CallFrame(api=ctypes.pointer(self.api), context=7, stage=_ffi.EXECUTE)
        self.frame.attributes.size, self.frame.attributes.names, self.frame.attributes.values = 1, *self.texts
        if extension is not None:
            self.frame.extension = ctypes.pointer(extension)
        for name, pointer in zip(("inputs", "outputs"), self.pointers, strict=True):
            part = getattr(self.frame, name)
            part.size, part.buffers = 1, pointer

    def stream(self, ask):
        assert ask.contents.context == 7
        ask.contents.answer = 99 + self.number
        return 0

    def device(self, ask):
        ask.contents.answer = self.number
        return 0

    def fail(self, failure):
        self.failure = failure.contents.message.decode()
        return 1


@pytest.fixture
def registered(monkeypatch):
    """Serve a call of two kernels; return what answers XLA, and the Warp that notes it."""
    warp = Warp()

    def commands(x, count):
        if x.ptr == 666:
            raise RuntimeError("no such kernel")
        if x.ptr == 667:
            raise KeyboardInterrupt
        besides = [_cuda.Command("beside", [x], 4, 32, beside=True)] if x.ptr >= 5000 else []
        return [_cuda.Command("sort", [x, 4], 4, 128), _cuda.Command("query", [x, count], 4, 32), *besides]

    monkeypatch.setitem(_launch._served, NAME, _cuda.serve(warp, ["float", "int"], commands))
    return _launch._answer, warp


def call(answer, *addresses, **options):
    frame = Frame(addresses, **options)
    return answer(ctypes.addressof(frame.frame)), frame


def launches(x, count, stream=99):
    return [("launch", "sort", (x, 4), stream), ("launch", "query", (x, count), stream)]


def test_launches_are_recorded_once_and_told_new_addresses(registered):
    handler, warp = registered
    for k in range(40):
        assert call(handler, 1000 + k, 2000 + k)[0] is None
        assert warp.log[-2:] == launches(1000 + k, 2000 + k)
    assert warp.recorded == 2
    assert len(warp.log) == 80


def test_addresses_that_come_back_soon_become_a_graph(registered):
    handler, warp = registered
    call(handler, 1000, 2000)
    call(handler, 1001, 2001)
    del warp.log[:]
    for _ in range(3):
        call(handler, 1000, 2000)
    assert warp.log == [("graph", tuple(launches(1000, 2000, stream=1)), 99)] * 3  # recorded elsewhere
    del warp.log[:]
    for k in range(_cuda._SOON + 1):  # none comes back within so many others
        call(handler, 3000 + k, 4000)
    call(handler, 3000, 4000)
    assert not any(entry[0] == "graph" for entry in warp.log)
    call(handler, 1000, 2000)  # a graph that was made is kept
    assert warp.log[-1][0] == "graph"


def test_each_device_has_launches_and_graphs_of_its_own(registered):
    handler, warp = registered
    for device in (0, 1, 1, 0):
        call(handler, 1000, 2000, device=device)
    graphs = [("graph", tuple(launches(1000, 2000, stream)), 99 + device) for device, stream in ((1, 1), (0, 3))]
    assert warp.log == [*launches(1000, 2000, 99), *launches(1000, 2000, 100), *graphs]
    assert warp.recorded == 4


def test_devices_call_at_the_same_time(registered):
    handler, warp = registered
    devices = [k % 2 for k in range(40)]
    with ThreadPoolExecutor(2) as threads:
        answers = list(threads.map(lambda device: call(handler, 1000 + device, 2000, device=device)[0], devices))
    assert answers == [None] * 40
    assert warp.recorded == 4
    graphs = [entry for entry in warp.log if entry[0] == "graph"]
    assert sorted(entry[2] for entry in graphs) == [99] * 19 + [100] * 19


def test_what_may_run_beside_the_one_before_does_in_a_graph(registered):
    handler, warp = registered
    call(handler, 5000, 2000)
    beside = ("launch", "beside", (5000,), 99)
    assert warp.log == [*launches(5000, 2000), beside]
    del warp.log[:]
    call(handler, 5000, 2000)
    sort, query = launches(5000, 2000, stream=1)
    assert warp.log == [("graph", (sort, ("wait", 2, 1), query, (*beside[:3], 2), ("wait", 1, 2)), 99)]


def test_what_goes_wrong_is_told_to_xla(registered):
    handler, _ = registered
    answer, frame = call(handler, 666, 2000)
    assert answer == 1
    assert frame.failure == "called: RuntimeError: no such kernel"
    answer, frame = call(handler, 667, 2000)  # whatever is raised: no answer would mean success
    assert answer == 1
    assert frame.failure == "called: KeyboardInterrupt: "


def test_the_version_of_the_interface_is_told(registered):
    handler, warp = registered
    metadata = _ffi.Metadata()
    extension = _ffi.Extension(type=1, metadata=ctypes.pointer(metadata))
    assert call(handler, 1000, 2000, extension=extension)[0] is None
    assert (metadata.version.major, metadata.version.minor) == (0, 1)
    assert warp.log == []


def test_a_call_with_an_unknown_extension_is_a_call(registered):
    handler, warp = registered
    assert call(handler, 1000, 2000, extension=_ffi.Extension(type=7))[0] is None
    assert warp.log == launches(1000, 2000)
