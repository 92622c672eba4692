"""Begin in threads and by forks, as `test_start.py` asks in fresh processes."""

import faulthandler
import os
import shutil
import sys
import threading
import time
import warnings

import jax
import numpy as np

import jfrnn
from jfrnn._engine import launch
from jfrnn._engine.start import apart
from jfrnn.ase import primitive_neighbor_list
from jfrnn.kernels import Program, _compile

POINTS = np.random.default_rng(0).random((40, 3)).astype(np.float32)
KEPT = []


def start_together():
    """Let threads do the very first search, all at the same moment, and count how often native code was opened."""
    opened, found, together, work = [], [], threading.Barrier(4), launch.open_desk
    launch.open_desk = lambda *given: opened.append(given) or work(*given)

    def search():
        together.wait()
        found.append(jfrnn.count(POINTS, 0.3, backend="warp"))

    threads = [threading.Thread(target=search) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = jfrnn.count(POINTS, 0.3, backend="brute")
    print(f"opened {len(opened)} right {sum(np.array_equal(count, expected) for count in found)}")


def program(name):
    return Program(name, 'extern "C" void nothing() {}\n', cuda=False)


def fork():
    """Fork before the first search, which opens doors in one process alone, and while another thread compiles.

    Each child traces a search, works apart and compiles: XLA itself has no threads there.
    """
    over = threading.Event()

    def compile_all():
        for k in range(10**6):
            _compile.begin(program(f"beside{k}"))
            _compile.load(program(f"parent{k}"))
            if over.is_set():
                return

    doors = [launch._doors[name]._goal for name in launch._PLATFORMS]  # Linux lets these have memory for instructions
    before = [goal.value for goal in doors]
    opens = os.fork()
    if opens == 0:
        launch._open()
        os._exit(0)
    os.waitpid(opens, 0)
    print("led elsewhere", sum(goal.value != known for goal, known in zip(doors, before, strict=True)))
    KEPT.append(jfrnn.search(POINTS, 0.3, backend="warp", capacity=32))
    thread = threading.Thread(target=compile_all)
    thread.start()
    ended = [os.waitpid(_child(k), 0)[1] for k in range(6)]
    over.set()
    thread.join()
    print("ended", *ended)


def _child(k):
    child = os.fork()
    if child == 0:
        faulthandler.dump_traceback_later(15, exit=True)
        desk, laid = launch._open(), next(iter(launch._plans.values()))
        refused = all(is_refused(work) for work in (lambda: jfrnn.search(POINTS, 0.3), lambda: KEPT[0].vectors(POINTS)))
        assert len(primitive_neighbor_list("i", True, np.eye(3), POINTS, 0.3)) > 0  # without JAX
        apart(lambda: _compile.load(program(f"child{k}")).address_of("nothing"))
        begun = _compile.begin(program(f"beside child{k}"))
        assert begun is None or begun.result().exists()
        desk.drop(laid)
        os._exit(0 if refused else 3)
    return child


def is_refused(work):
    """Say whether a call in a process that was forked after JAX had started ends with an error, instead of waiting forever."""
    try:
        work()
    except RuntimeError as error:
        return "spawn" in str(error)
    return False


def end():
    """End while a search, whose result nobody waits for, asks for a plan."""

    @jax.jit
    def search(x):  # with a product that makes XLA go on behind the call
        return jfrnn.count(x, 0.3, backend="warp").sum() + (x @ x.T).sum().astype(np.int32)

    def keep(*given):
        asked.set()
        time.sleep(0.5)
        work(*given)

    asked, work, x = threading.Event(), launch._keep_plan, jax.device_put(np.resize(POINTS, (8000, 3)))
    search(x).block_until_ready()
    for key in list(launch._plans):
        launch._open().drop(launch._plans.pop(key))
    launch._keep_plan = keep
    faulthandler.dump_traceback_later(15, exit=True)
    search(x)
    asked.wait()
    print("ends")


def outlive():
    """Do the first search when the main thread has ended, and no thread can begin any more."""

    def search():
        threading.main_thread().join()
        print("right", np.array_equal(jfrnn.count(POINTS, 0.3, backend="warp"), expected))

    expected = jfrnn.count(POINTS, 0.3, backend="brute")
    threading.Thread(target=search).start()


def clear():
    """Compile while another process clears the folder in which kernels are kept."""
    work, folder = _compile._clang.compile_object, _compile.kernel_folder() / _compile._FOLDER

    def compile_in_vain(*given, **more):
        shutil.rmtree(folder)
        work(*given, **more)

    _compile._clang.compile_object = compile_in_vain
    print("cleared", _compile.load(program("cleared")).address_of("nothing") > 0, len([*folder.iterdir()]))


def fill():
    """Compile what a disk has no room for."""
    try:
        _compile.load(Program("filled", 'extern "C" char many[1 << 20] = {1};\n', cuda=False))
    except RuntimeError as error:
        print(error)


warnings.filterwarnings("ignore", message=".*fork")
checks = {"together": start_together} | {check.__name__: check for check in (fork, outlive, end, clear, fill)}
checks[sys.argv[1]]()
