"""Native code between XLA and the kernels, called by frames as XLA lays them out, with a driver that notes what it is asked."""

import ctypes
import functools
import sys
import threading
import types
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
from checked import refuses

from jfrnn._engine import Clear, Launch, Plan, launch, plans, start
from jfrnn.kernels import Field, Kernel, Program, _clang, _compile, _driver, _nvrtc, one_at_a_time
from jfrnn.kernels._compile import write_launcher

HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()
HARNESS = r"""
static long long events[4096][4];
static int event_count;
static void note(long long kind, long long a, long long b, long long c) {
    long long* event = events[__atomic_fetch_add(&event_count, 1, __ATOMIC_RELAXED) % 4096];
    event[0] = kind, event[1] = a, event[2] = b, event[3] = c;
}
static int launch(void* f, unsigned x, unsigned, unsigned, unsigned block, unsigned, unsigned, unsigned, void* stream, void** given,
                  void**) {
    note(1, (long long)stream, *(long long*)given[0], 1000000 * ((int*)given[0])[2] + 1000 * x + block);
    const int number = ((int*)given[0])[2];
    if (number == 21) note(10, ((long long*)given[0])[2], 0, 0);
    return number == 13 ? 700 : 0;
}
static int read(void* host, unsigned long long address, size_t bytes, void*) { memcpy(host, (void*)address, bytes); return 0; }
static int finish(void*) { return 0; }
static int clear(unsigned long long address, unsigned, size_t words, void* stream) {
    note(2, (long long)stream, (long long)address, (long long)words);
    return 0;
}
static int record(void* event, void* stream) { note(3, (long long)stream, (long long)event, 0); return 0; }
static int wait(void* stream, void* event, unsigned) { note(4, (long long)stream, (long long)event, 0); return 0; }
static long long graphs, most_graphs;  // those beyond cannot be made ready
static int make_graph(void** graph, unsigned) { *graph = (void*)++graphs; return 0; }
static int begin_record(void* stream, void* graph, const void*, const void*, size_t, int) {
    note(6, (long long)stream, (long long)graph, 0);
    return 0;
}
static int end_record(void* stream, void**) { note(7, (long long)stream, 0, 0); return 0; }
static int make_ready(void** ready, void* graph, unsigned long long) { *ready = graph; return graphs > most_graphs; }
static int drop_graph(void*) { return 0; }
static int make_condition(unsigned long long* condition, void*, void*, unsigned value, unsigned flags) {
    *condition = 700 + 10 * value + flags;
    return 0;
}
static int nodes_of(void*, void** nodes, size_t* count) { nodes[0] = (void*)31, *count = 1; return 0; }
static int add_node(void**, void*, void** before, size_t count, void* node) {  // a conditional one: its condition, and its body
    static void* body = (void*)40;
    note(11, (long long)before[0], (long long)count, ((long long*)node)[2]);
    ((void***)node)[4] = &body;
    return 0;
}
static int run_graph(void* ready, void* stream) { note(8, (long long)stream, (long long)ready, 0); return 0; }
static int drop_ready(void* ready) { note(9, (long long)ready, 0, 0); return 0; }

struct Task { XLA_FFI_Task* run; void* data; };
static Task tasks[64];
static int task_count, device_number;
static char failure[1024];
static XLA_FFI_Error* create(XLA_FFI_Error_Create_Args* a) {
    int k = 0;
    for (; a->message[k] && k < 1023; ++k) failure[k] = a->message[k];
    failure[k] = 0;
    return (XLA_FFI_Error*)failure;
}
static XLA_FFI_Error* get_stream(XLA_FFI_Stream_Get_Args* a) { a->stream = (void*)(99ll + device_number); return nullptr; }
static XLA_FFI_Error* get_device(XLA_FFI_DeviceOrdinal_Get_Args* a) { a->device_ordinal = device_number; return nullptr; }
static XLA_FFI_Error* schedule(XLA_FFI_ThreadPool_Schedule_Args* a) {
    tasks[task_count++] = Task{a->task, a->data};
    return nullptr;
}
static XLA_FFI_Error* threads(XLA_FFI_ThreadPool_NumThreads_Args* a) { *a->num_threads = 4; return nullptr; }

extern "C" {
static int inside;
void work_alone(const void* given) {
    const long long others = __atomic_fetch_add(&inside, 1, __ATOMIC_ACQ_REL);
    for (int k = 0; k < 100; ++k) desk->yield();
    note(5, ((const long long*)given)[2], *(const long long*)given, ((const int*)given)[2] + 1000 * others);
    __atomic_fetch_sub(&inside, 1, __ATOMIC_ACQ_REL);
}
void take_turn() { desk->take_lock(desk->turn, 1); }
void add_one(const void* given) { __atomic_fetch_add(*(int* const*)given, ((const int*)given)[2], __ATOMIC_RELAXED); }
void* driver(int k) {
    void* all[] = {(void*)launch, (void*)clear, (void*)record, (void*)wait, (void*)make_graph, (void*)drop_graph,
                   (void*)begin_record, (void*)end_record, (void*)make_ready, (void*)drop_ready, (void*)run_graph,
                   (void*)read, (void*)finish, (void*)make_condition, (void*)nodes_of, (void*)add_node};
    return all[k];
}
void have_graphs(int most) { graphs = 0, most_graphs = most; }
int take_events(long long* out) {
    const int count = event_count;
    memcpy(out, events, sizeof(events[0]) * count);
    event_count = 0;
    return count;
}
int run_tasks() {  // those that were scheduled, whoever waits for them
    const int count = task_count;
    for (int k = 0; k < count; ++k) tasks[k].run(tasks[k].data);
    task_count = 0;
    return count;
}
const char* call(const char* kernel, int size, int device, int cuda, void* input, void* output, int stage, int extension) {
    XLA_FFI_Api api = {};
    api.XLA_FFI_Error_Create = create;
    api.XLA_FFI_Stream_Get = get_stream;
    api.XLA_FFI_DeviceOrdinal_Get = get_device;
    api.XLA_FFI_ThreadPool_Schedule = schedule;
    api.XLA_FFI_ThreadPool_NumThreads = threads;
    device_number = device;
    XLA_FFI_Buffer buffers[2] = {};
    buffers[0].data = input, buffers[1].data = output;
    void *in[1] = {buffers}, *out[1] = {buffers + 1};
    XLA_FFI_ByteSpan names[2] = {{"kernel", 6}, {"recipe", 6}}, texts[2] = {{kernel, (size_t)size}, {"made so", 7}};
    XLA_FFI_ByteSpan* all_names[2] = {names, names + 1};
    void* all_texts[2] = {texts, texts + 1};
    XLA_FFI_Metadata metadata = {};
    metadata.api_version.minor_version = -1;
    XLA_FFI_Metadata_Extension asked = {};
    asked.metadata = &metadata;
    *(int*)((char*)&asked + sizeof(size_t)) = extension;
    XLA_FFI_CallFrame frame = {};
    frame.api = &api;
    frame.stage = (XLA_FFI_ExecutionStage)stage;
    if (extension) frame.extension_start = (decltype(frame.extension_start))&asked;
    frame.args.size = frame.rets.size = 1;
    frame.args.args = in, frame.rets.rets = out;
    frame.attrs.size = 2, frame.attrs.names = all_names, frame.attrs.attrs = all_texts;
    XLA_FFI_Error* error = cuda ? answer_on_cuda(&frame) : answer_on_cpu(&frame);
    return error ? failure : extension == 1 && metadata.api_version.minor_version == XLA_FFI_API_MINOR ? "told" : nullptr;
}
}
"""
EXECUTE, INSTANTIATE = 3, 0
LAUNCH, CLEAR, RECORD, WAIT, WORK, BEGIN, END, RUN, DROP, TOLD, NODE = range(1, 12)
GRAPHS = "make_graph", "drop_graph", "begin_record", "end_record", "make_ready", "drop_ready", "run_graph"
GRAPHS += "read", "finish", "make_condition", "nodes_of", "add_node"
_TEXT = ctypes.c_void_p, ctypes.c_longlong
_MAKE_PLAN = ctypes.CFUNCTYPE(None, *_TEXT, *_TEXT, ctypes.c_int, ctypes.c_void_p)


HOST = types.SimpleNamespace(cuda=False)


class Native:
    """The native code, with plans of its own: `made` are the names, recipes and devices for which it asked."""

    cuda = True  # as the program of what is launched

    def __init__(self):
        self.library = _compile.load(Program("harness", write_launcher(HEADER) + HARNESS, cuda=False))
        self.made, self.refused, self.laid = [], None, {}
        self.make_plan = _MAKE_PLAN(self.make)
        self.desk = plans.open_desk(self.library, ctypes.cast(self.make_plan, ctypes.c_void_p).value, 8)
        for k, name in enumerate(("launch", "clear", "record", "wait", *GRAPHS)):
            setattr(self.desk._desk, name, self.function("driver", ctypes.c_void_p)(k))

        self.have_graphs(1000)

    def have_graphs(self, most):
        ctypes.CFUNCTYPE(None, ctypes.c_int)(self.library.address_of("have_graphs"))(most)

    def function(self, name, result=ctypes.c_int):
        return ctypes.CFUNCTYPE(result)(self.library.address_of(name))

    def make(self, name, name_size, recipe, recipe_size, device, wrong):
        name, recipe = ctypes.string_at(name, name_size).decode(), ctypes.string_at(recipe, recipe_size).decode()
        self.made.append((name, recipe, device))
        if isinstance(self.refused, BaseException):
            raise self.refused
        ctypes.memmove(wrong, (self.refused or b"") + b"\0", len(self.refused or b"") + 1)
        if self.refused is None:
            self.keep(name, device, Plan([self.step()], {"number": 5}))

    def step(self, threads=1, **more):
        fields = Field("x", 0, True), Field("number", 8, False)
        return Launch(Kernel(self, "add_one", fields, 16, 32), threads, **more)  # this is its own program

    def step_on_host(self, **more):
        fields = Field("x", 0, True), Field("number", 8, False), Field("stream", 16, True)
        return Launch(Kernel(HOST, "work_alone", fields, 24), **more)

    def keep(self, name, device, plan):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(plans, "compiler", lambda: self)
            patch.setattr(plans, "_second_stream", lambda device: (7, 71, 72))
            patch.setattr(plans, "_end_of_turn", lambda device: 80 + device)
            patch.setattr(plans, "_make_recorder", lambda device: plans._Recorder(stream=5, context=6))
            self.laid[name, device] = plans.lay_plan(name, plan, {"x": (1,), "y": (1,)}, device)
        self.desk.keep(self.laid[name, device])

    def load(self, program, device):
        assert program is (self if device.startswith("cuda") else HOST) or device == "cpu"
        return self.library

    def call(self, name, x=0, y=0, *, device=0, cuda=True, stage=EXECUTE, extension=0):
        kinds = ctypes.c_char_p, *3 * [ctypes.c_int], *2 * [ctypes.c_void_p], *2 * [ctypes.c_int]
        call = ctypes.CFUNCTYPE(ctypes.c_char_p, *kinds)(self.library.address_of("call"))
        return call(name.encode(), len(name), device, cuda, x, y, stage, extension)

    def events(self):
        found = np.zeros((4096, 4), np.int64)
        take = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(self.library.address_of("take_events"))
        return [tuple(row) for row in found[: take(found.ctypes.data)].tolist() or found[:0].tolist()]


@pytest.fixture
def native():
    found = Native()
    found.events()
    yield found
    for laid in found.laid.values():
        found.desk.drop(laid)


def launched(stream, address, number, blocks):
    return LAUNCH, stream, address, 1000000 * number + 1000 * blocks + 32


def test_launches_get_numbers_of_the_plan_and_addresses_of_the_call(native):
    steps = [Clear("y", 40), native.step(64), native.step(65, numbers={"number": 6}), native.step(0)]
    native.keep("many@", 0, Plan(steps, {"number": 4}))
    for k in range(3):
        assert native.call("many@", 1000 + k, 2000 + k) is None
        cleared = CLEAR, 99, 2000 + k, 10
        assert native.events() == [cleared, launched(99, 1000 + k, 4, 2), launched(99, 1000 + k, 6, 3)]
    assert native.made == []


def test_what_may_run_beside_the_one_before_waits_for_what_came_before_both(native):
    numbered = native.step(2, numbers={"number": 2}), native.step(3, numbers={"number": 3}, beside=True)
    native.keep("beside@", 0, Plan([native.step(1), *numbered, native.step(4)], {"number": 1}))
    assert native.call("beside@", 1000) is None
    both = [launched(99, 1000, 2, 1), launched(7, 1000, 3, 1)]
    before, after = [(RECORD, 99, 71, 0), (WAIT, 7, 71, 0)], [(RECORD, 7, 72, 0), (WAIT, 99, 72, 0)]
    assert native.events() == [launched(99, 1000, 1, 1), *before, *both, *after, launched(99, 1000, 1, 1)]


def test_launches_of_a_loop_are_recorded_once(native):
    """What comes at the same addresses for the eighth time is recorded, on a stream of its own, and is a graph from then on."""
    steps = [Clear("y", 40), native.step(1), native.step(2), native.step(3, beside=True)]
    native.keep("loop@", 0, Plan(steps, {"number": 1}))

    def call(x):
        assert native.call("loop@", x, 2000) is None
        return native.events()

    def launches(stream, x):
        first = [(CLEAR, stream, 2000, 10), launched(stream, x, 1, 1), (RECORD, stream, 71, 0), (WAIT, 7, 71, 0)]
        both = [launched(stream, x, 1, 1), launched(7, x, 1, 1)]
        return [*first, *both, (RECORD, 7, 72, 0), (WAIT, stream, 72, 0)]

    for _ in range(7):
        assert call(1000) == launches(99, 1000)
    assert call(1000) == [(BEGIN, 5, 1, 0), *launches(5, 1000), (END, 5, 0, 0), (RUN, 99, 1, 0)]
    assert call(1000) == [(RUN, 99, 1, 0)]
    assert call(1001) == launches(99, 1001)  # one array stands elsewhere, or the other
    assert native.call("loop@", 1000, 2001) is None
    assert native.events()[0] == (CLEAR, 99, 2001, 10)
    for x in range(2000, 2029):
        call(x)
        assert call(1000) == [(RUN, 99, 1, 0)]  # among the 32 that were met last
    for x in range(3000, 3031):
        assert call(x) == launches(99, x)
    assert call(3031) == [(DROP, 1, 0, 0), *launches(99, 3031)]
    for _ in range(7):
        call(3031)
    native.desk.drop(native.laid.pop(("loop@", 0)))
    assert native.events() == [(DROP, 2, 0, 0)]


def test_what_is_asked_for_is_launched_by_the_host_once_and_then_by_the_device(native):
    """A step that sets a condition is recorded in place of the first one, and the others behind that condition."""
    fields = Field("x", 0, True), Field("number", 8, False), Field("condition", 16, True)
    decide = Launch(Kernel(native, "add_one", fields, 24, 32), numbers={"number": 21})
    steps = [native.step(1), native.step(2, numbers={"number": 2})]
    native.keep("asked@", 0, Plan(steps, {"number": 1}, ["condition"], asked="y", decide=decide))
    word = np.zeros(1, np.int32)
    check, rest = (lambda stream, x: launched(stream, x, 1, 1)), (lambda stream, x: launched(stream, x, 2, 1))

    def call(x):
        assert native.call("asked@", x, word.ctypes.data) is None
        return native.events()

    assert call(1000) == [check(99, 1000)]
    graph = [(BEGIN, 5, 1, 0), launched(5, 1000, 21, 1), (TOLD, 701, 0, 0), (END, 5, 0, 0), (NODE, 31, 1, 701)]
    assert call(1000) == [*graph, (BEGIN, 5, 40, 0), rest(5, 1000), (END, 5, 0, 0), (RUN, 99, 1, 0)]
    word[0] = 1
    assert call(1000) == [(RUN, 99, 1, 0)]
    assert call(2000) == [check(99, 2000), rest(99, 2000)]


def test_where_a_driver_cannot_record_all_is_launched(native):
    native.keep("loop@", 0, Plan([native.step(1), native.step(2)], {"number": 1}))
    native.keep("fails@", 0, Plan([native.step(1), native.step(1)], {"number": 13}))
    failure = b"fails: a launch failed with CUDA's error 700"
    assert [native.call("fails@") for _ in range(10)] == 10 * [failure]
    assert [event[0] for event in native.events()] == [*7 * [LAUNCH], BEGIN, LAUNCH, END, *3 * [LAUNCH]]
    native.have_graphs(0)
    for k in range(12):
        assert native.call("loop@", 1000) is None
        assert [event[1] for event in native.events()] == ([99, 99] if k != 7 else [5, 5, 5, 5, 99, 99])  # it tries once


def test_single_launches_and_those_beside_work_of_the_host_are_not_recorded(native):
    native.keep("one@", 0, Plan([native.step(1)], {"number": 1}))
    native.keep("host@", 0, Plan([native.step(1), native.step_on_host()], {"number": 1}))
    native.keep("turns@", 0, taking_turns(native.step(1), native.step(1)))
    assert not any(laid.plan.recorder for laid in native.laid.values())


def test_an_unknown_name_is_asked_for_once_per_device(native):
    for device in (0, 1, 1, 0):
        assert native.call("asked@here@4", 1000, device=device) is None
    assert native.made == [("asked@here@4", "made so", 0), ("asked@here@4", "made so", 1)]
    assert [event[1] for event in native.events()] == [99, 100, 100, 99]
    native.desk.drop(native.laid["asked@here@4", 1])
    assert native.call("asked@here@4", 1000, device=1) is None
    assert native.made[2:] == [("asked@here@4", "made so", 1)]


def test_programs_that_are_made_ready_ask_and_launch_nothing(native):
    assert native.call("ready@", stage=INSTANTIATE) is None
    assert native.call("ready@", stage=INSTANTIATE, cuda=False) is None
    assert [device for _, _, device in native.made] == [-2, -3]  # for the first device, or the CPU, soon
    assert native.events() == []


def test_what_goes_wrong_is_told_to_xla(native):
    native.refused = b"RuntimeError: no such kernel"
    assert native.call("refused@here") == b"refused: RuntimeError: no such kernel"
    native.refused = b"x" * (plans.MOST_WORDS - 1)
    assert native.call("refused@here") == (b"refused: " + native.refused)[:1023]  # what this driver notes
    native.keep("fails@here", 0, Plan([native.step(1), native.step(1)], {"number": 13}))
    assert native.call("fails@here") == b"fails: a launch failed with CUDA's error 700"
    assert len(native.events()) == 1  # nothing is launched behind


def test_what_python_leaves_unanswered_is_told_to_xla(native, monkeypatch):
    ignored = []
    monkeypatch.setattr(sys, "unraisablehook", lambda given: ignored.append(given.exc_value))
    native.refused = KeyboardInterrupt()
    assert native.call("dropped@here") == b"dropped: Python ended, or stopped, before it had answered."
    assert ignored == [native.refused]
    native.refused = None
    assert native.call("dropped@here", 1000) is None


def test_at_the_end_of_python_other_threads_than_the_main_one_ask_no_more(native):
    native.keep("known@", 0, Plan([native.step(1)], {"number": 1}))
    native.desk.close()
    with ThreadPoolExecutor(1) as other:
        unknown = other.submit(native.call, "unknown@here").result()
        assert other.submit(native.call, "known@").result() is None
    assert unknown == b"unknown: Python ended, or stopped, before it had answered."
    assert native.made == []
    assert native.call("unknown@here") is None


def test_the_version_of_the_interface_is_told(native):
    assert native.call("any@", extension=1) == b"told"
    assert native.made == []
    native.keep("known@", 0, Plan([native.step(1)], {"number": 1}))
    assert native.call("known@", extension=7) is None  # with any other extension it is a call
    assert len(native.events()) == 1


def taking_turns(*steps):
    return Plan(steps, {"number": 1}, keep=lambda device: plans.Kept({"x": 1000}, None))


def test_calls_that_share_what_is_kept_wait_for_the_last_one_on_any_stream(native):
    native.keep("shares@", 1, taking_turns(native.step_on_host(), native.step(1)))
    for _ in range(2):
        assert native.call("shares@", 5, device=1) is None
        assert native.events() == [(WAIT, 100, 81, 0), (WORK, 100, 1000, 1), launched(100, 1000, 1, 1), (RECORD, 100, 81, 0)]


def test_a_call_that_fails_ends_its_turn(native):
    native.keep("fails@", 0, taking_turns(native.step(1, numbers={"number": 13}), native.step(1)))
    for _ in range(2):
        assert native.call("fails@") == b"fails: a launch failed with CUDA's error 700"
        assert [event[0] for event in native.events()] == [WAIT, LAUNCH, RECORD]


def test_calls_that_share_what_is_kept_take_turns(native):
    for name in ("one@", "other@"):
        native.keep(name, -1, taking_turns(native.step_on_host(), native.step_on_host(numbers={"number": 2})))
    with ThreadPoolExecutor(4) as threads:
        calls = [threads.submit(native.call, ("one@", "other@")[k % 2], cuda=False) for k in range(200)]
        assert all(call.result() is None for call in calls)
    assert [event[3] for event in native.events()] == 200 * [1, 2]


def test_a_process_that_begins_by_a_fork_takes_the_turn_of_a_thread_that_it_does_not_have(native):
    native.keep("shares@", -1, taking_turns(native.step_on_host()))
    native.function("take_turn", None)()
    native.desk.begin_anew()
    assert native.call("shares@", cuda=False) is None


def test_threads_that_come_late_find_nothing_to_do(native):
    """The step is over when the thread of the call has found nothing left, whoever else was asked to join."""
    native.keep("shared@", -1, Plan([native.step(3), native.step(1)], {"number": 1}))
    total = np.zeros(1, np.int32)
    assert native.call("shared@", total.ctypes.data, cuda=False) is None
    assert total[0] == 2
    assert native.function("run_tasks")() == 2
    assert total[0] == 2


def test_plans_are_dropped_while_others_call(native):
    """Nobody meets a plan that is gone, and a call that has found one ends first."""
    total = np.zeros(1, np.int32)
    lasting = functools.partial(native.call, "lasting@", total.ctypes.data, cuda=False)
    native.keep("lasting@", -1, Plan([native.step(1)], {"number": 1}))

    def change(k):
        native.keep(f"other{k % 3}@", -1, Plan([native.step(1)], {"number": 1}))
        native.desk.drop(native.laid.pop((f"other{k % 3}@", -1)))

    with ThreadPoolExecutor(3) as threads:
        calls = [threads.submit(lasting) for _ in range(2000)]
        for k in range(500):
            change(k)
        assert all(call.result() is None for call in calls)
    assert total[0] == 2000
    assert native.made == []


def test_a_program_for_cuda_is_made_ready_on_a_device_of_the_process(monkeypatch):
    """Processes of one host have a device each, by its number on the host."""
    found, shapes, laid = launch.Call("ready", ["x"], {}, lambda *_: Plan([], {})), {"x": (3,)}, []
    monkeypatch.setattr(launch, "_read_call", lambda name, recipe: (found, shapes))
    monkeypatch.setattr(launch, "multiprocessors_of", lambda device: laid.append(device) or 1)
    own = types.SimpleNamespace(local_hardware_id=3)
    monkeypatch.setattr(jax, "local_devices", lambda backend: [own] if backend == "cuda" else 1 / 0)
    monkeypatch.setattr(_driver, "driver", lambda: ctypes.pythonapi)
    launch._keep_plan("ready@here@3", "made so", -2)
    launch._keep_plan("ready@here@3", "made so", 3)
    launch._open().drop(launch._plans.pop(("ready@here@3", 3)))
    assert laid == [3]


def make_driver(loaded, contexts):
    """Return a driver of CUDA that has one device, and loads whatever begins as it should, noting what, and in which context."""

    def put(found, value):
        found._obj.value = value
        return 0

    def load(found, binary):
        loaded.append((binary, list(contexts)))
        return 200 if b"broken" in binary else put(found, 0x200)

    return types.SimpleNamespace(
        **dict.fromkeys(("cuInit", "cuCtxSynchronize", "cuModuleUnload"), lambda *_: 0),
        cuDriverGetVersion=lambda found: put(found, 13000),
        cuDeviceGet=put,
        cuDevicePrimaryCtxRetain=lambda found, _: put(found, 0x100),
        cuDeviceGetAttribute=lambda found, kind, _: put(found, {16: 132, 75: 9, 76: 0}[kind]),
        cuCtxPushCurrent_v2=lambda context: contexts.append(context) or 0,
        cuCtxPopCurrent_v2=lambda _: 0 * contexts.pop(),
        cuModuleLoadData=load,
        cuModuleGetFunction=lambda found, module, name: put(found, module + len(name)),
    )


def test_a_program_for_cuda_that_is_kept_is_not_compiled_again(monkeypatch, tmp_path):
    """NVRTC is asked where nothing is kept, or what is kept cannot be loaded: for the device, or for PTX that is near to it."""
    loaded, contexts, compiled = [], [], []
    driver = make_driver(loaded, contexts)
    monkeypatch.setattr(_driver, "driver", lambda: driver)
    monkeypatch.setattr(_compile, "_folders", lambda: [tmp_path])
    monkeypatch.setattr(_driver, "find_device", _driver.find_device.__wrapped__)

    def compile_cuda(text, name, target, arch, fused):
        compiled.append((target.suffix, arch))
        target.write_text(text)

    monkeypatch.setattr(_nvrtc, "compile_cuda", compile_cuda)
    program = Program("kept", ".entry kept(", cuda=True)
    for _ in range(2):
        library = _compile.load(program, "cuda:1")
        assert library.address_of("twelve chars") == 0x20C
        del library
    assert compiled == [(".cubin", 90)]
    assert loaded == [(b".entry kept(", [0x100])] * 2
    refuses(RuntimeError, "cannot be loaded", _compile.load, Program("broken", "broken", cuda=True), "cuda:1")
    monkeypatch.setattr(_nvrtc, "known_archs", lambda: (75, 80))
    refuses(RuntimeError, "cannot be loaded", _compile.load, Program("broken", "broken of the future", cuda=True), "cuda:1")
    assert compiled == [(".cubin", 90)] * 3 + [(".ptx", 80)] * 2
    monkeypatch.setattr(_nvrtc, "known_archs", tuple)
    with pytest.raises(RuntimeError, match=r"knows the compute capabilities \[\], none of which fits 90"):
        _compile.load(Program("none", "none", cuda=True), "cuda:1")
    assert contexts == []


def test_programs_are_compiled_beside_each_other_and_each_once(monkeypatch, tmp_path):
    """Two compilers wait for each other; a program that is begun twice has one, and is not begun when it is kept."""
    monkeypatch.setattr(_compile, "_folders", lambda: [tmp_path])
    work, met, compiled = _clang.compile_object, threading.Barrier(2), []

    def compile_together(text, *given):
        compiled.append(text)
        met.wait(60)
        work(text, *given)

    monkeypatch.setattr(_clang, "compile_object", compile_together)
    programs = [Program(name, f'extern "C" int {name}() {{ return 1; }}', cuda=False) for name in ("one", "other")]
    begun = [_compile.begin(program) for program in (*programs, programs[0])]
    assert begun[0] is begun[2]
    assert [job.result().stem.split("_")[0] for job in begun] == ["one", "other", "one"]
    assert len(compiled) == 2
    assert [_compile.begin(program) for program in programs] == [None, None]
    assert all(_compile.load(program).address_of(program.name) for program in programs)


def test_a_program_that_is_being_made_begins_to_compile_and_its_call_waits(monkeypatch):
    """A plan is laid when all that it launches is compiled."""
    job, laid, call = Future(), [], launch.Call("begun", ["x"], {}, lambda *_: "plan")
    monkeypatch.setattr(launch, "_read_call", lambda name, recipe: (call, {"x": (3,)}))
    monkeypatch.setattr(launch, "begin_programs", lambda plan, device: [job] if not job.done() else [])
    monkeypatch.setattr(launch, "lay_plan", lambda *given: laid.append(given) or plans.lay_plan("begun@", Plan([], {}), {}, -1))
    launch._keep_plan("begun@here@3", "made so", launch._CPU_SOON)
    assert not laid
    caller = threading.Thread(target=launch._keep_plan, args=("begun@here@3", "made so", launch._CPU))
    caller.start()
    caller.join(0.2)
    assert caller.is_alive()
    assert not laid
    job.set_result(None)
    caller.join(60)
    assert [given[:2] for given in laid] == [("begun@here@3", "plan")]
    launch._open().drop(launch._plans.pop(("begun@here@3", -1)))


def test_who_waits_long_for_compilers_is_told_once(monkeypatch, caplog):
    monkeypatch.setattr(start, "_LONG", 0.05)
    monkeypatch.setattr(start, "_said", False)
    for _ in range(2):
        jobs = [Future(), Future()]
        threading.Timer(0.5, lambda jobs=jobs: [job.set_result(None) for job in jobs]).start()
        start.wait_for(jobs)
        assert all(job.done() for job in jobs)
    assert [record.getMessage().split(",")[0] for record in caplog.records] == ["jfrnn compiles kernels"]
    start.wait_for([])
    failed = Future()
    failed.set_exception(RuntimeError("does not compile"))
    refuses(RuntimeError, "does not compile", start.wait_for, [failed])


def test_what_failed_begins_anew():
    jobs = [Future(), Future()]
    jobs[0].set_exception(RuntimeError("a full disk"))
    jobs[1].set_result(None)
    begin = functools.cache(lambda: jobs.pop(0) if jobs else None)
    refuses(RuntimeError, "a full disk", start.finish, begin)
    for _ in range(2):
        start.finish(begin)
    assert jobs == []


def test_a_program_that_is_given_back_waits_for_nobody():
    """Else a thread that compiles, in which Python gives programs back, would wait for one that forks when it has compiled."""
    unloaded = []
    with one_at_a_time:
        thread = threading.Thread(target=_compile._unload, args=(lambda: unloaded.append("left"),))
        thread.start()
        thread.join(60)
        assert not thread.is_alive()
        assert unloaded == []
    _compile.load(Program("after", 'extern "C" int after() { return 1; }', cuda=False))
    assert unloaded == ["left"]
    _compile._unload(lambda: unloaded.append("at once"))
    assert unloaded == ["left", "at once"]


def test_the_native_code_is_waited_for_where_its_interface_is_a_later_one(monkeypatch):
    latest = launch._COMPILED_BEFORE
    for version, sure in (((0, 1), True), (latest, True), ((latest[0], latest[1] + 1), False), ((), False)):
        lines = [f"#define XLA_FFI_API_{name} {number}" for name, number in zip(("MAJOR", "MINOR"), version, strict=False)]
        program = Program("launch", "\n".join(lines), cuda=False)
        monkeypatch.setattr(launch, "_launcher", lambda program=program: program)
        assert launch._will_compile.__wrapped__() is sure, version
