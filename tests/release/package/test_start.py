"""How Warp starts where its folder cannot be written or holds damaged files, and what it says; each in a fresh process."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import TESTS

CHOOSE = """
import jax, numpy as np, warnings
import jfrnn

def choose(backend):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        x = np.zeros((8, 2), np.float32)
        print(jax.eval_shape(lambda x: jfrnn.search(x, 0.2, capacity=9, backend=backend), x).backend)
    for warning in caught:
        print(warning.category.__name__, warning.filename, warning.message)
"""
DAMAGED, BEGUN = (TESTS / name for name in ("damaged.py", "begun.py"))


def run(*command, cache, limits=""):
    """Run Python with a folder for Warp's kernels; return what it writes."""
    words = ["bash", "-c", f'{limits} exec "$@"', "bash", sys.executable, *command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=os.environ | {"WARP_CACHE_PATH": str(cache)})
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


@pytest.fixture
def nowhere(tmp_path):
    """A path at which no folder can be made, not even by root."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "cache"


@pytest.fixture
def read_only(tmp_path):
    """A folder for kernels that is there and in which nobody can make files."""
    import warp

    (tmp_path / warp.__version__).symlink_to("/proc/self/fdinfo")
    return tmp_path


@pytest.mark.slow
def test_in_a_folder_that_can_only_be_read_kernels_are_compiled_elsewhere(read_only):
    answers, errors = run(DAMAGED, "kernel", cache=read_only)
    assert answers == ["kernel 1"]
    assert errors.count("RuntimeWarning: the folder in which Warp keeps compiled kernels,") == 1


NOWHERE = """
import logging
import time
import warnings
import numpy as np
import jfrnn
from jfrnn.kernels import _compile

logging.getLogger("jfrnn").setLevel(logging.ERROR)  # a slow machine would be told that kernels compile

def make(*about, whole=_compile._make):
    time.sleep(0.3)  # so that threads of XLA, which have no caller that a warning could name, are there first
    return whole(*about)

_compile._make = make
x = np.zeros((8, 2), np.float32)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(jfrnn.search(x, 0.2).backend, *(int(jfrnn.count(x, 0.2, backend=backend)[0]) for backend in ("warp", "hashgrid")))
print(len(caught), caught[0].category.__name__, caught[0].filename, caught[0].message)
"""


def test_without_a_folder_kernels_and_warp_are_compiled_elsewhere_with_one_warning(nowhere):
    (found, warned), errors = run("-c", NOWHERE, cache=nowhere)
    assert found == "warp 7 7"
    assert warned.startswith(f"1 RuntimeWarning <string> the folder in which Warp keeps compiled kernels, {nowhere}/")
    assert "Set the environment variable WARP_CACHE_PATH to a folder that can be written" in warned
    assert errors == ""  # nor does Warp say that there is no driver for CUDA
    folder = warned.partition("compiled into ")[2].split()[0]
    assert not Path(folder).exists()


def test_without_any_folder_auto_takes_jax_with_one_warning_and_warp_says_what_to_set(nowhere):
    code = "\ntry:\n    choose('warp')\nexcept RuntimeError as error:\n    print(error)\nchoose('auto')\nchoose('auto')"
    (refused, answer, warned, again), errors = run("-c", CHOOSE + code, cache=nowhere, limits="ulimit -f 0;")
    assert f"{nowhere}/" in refused
    assert "Set the environment variable WARP_CACHE_PATH to a folder that can be written" in refused
    assert answer == again == "jax"
    assert "RuntimeWarning <string> backend='auto' takes the slower engine 'jax' on the platform 'cpu': " in warned
    reason = refused.partition("'cpu': ")[2].removesuffix(". Pass backend='jax'.")
    assert "cannot be written, nor" in reason
    assert reason in warned
    assert errors == ""


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def spoil(path):
    path.write_bytes(bytes(path.stat().st_size))


DAMAGES = {"cut": cut, "emptied": lambda path: path.write_bytes(b""), "spoiled": spoil, "whole": lambda path: None}


def test_damaged_files_are_compiled_anew(tmp_path):
    right = [f"{name} 1" for name in DAMAGES]
    assert run(DAMAGED, *DAMAGES, cache=tmp_path)[0] == right
    damaged = {}
    for name, damage in DAMAGES.items():
        (path,) = tmp_path.glob(f"*/wp_jfrnn/damaged_{name}_*.o")
        damaged[path] = path.read_bytes(), path.stat().st_mtime_ns
        damage(path)
    assert run(DAMAGED, *DAMAGES, cache=tmp_path)[0] == right
    for path, (before, made) in damaged.items():
        assert path.read_bytes() == before
        assert (path.stat().st_mtime_ns == made) == ("whole" in path.name)


def begin(how):
    """Run `begun.py` with the kernels that are there."""
    import warp

    warp.init()
    return run(BEGUN, how, cache=Path(warp.config.kernel_cache_dir).parent)


def test_threads_that_search_first_at_the_same_moment_start_all_once():
    assert begin("together") == (["opened 1 right 4"], "")


def test_a_process_ends_while_results_that_nobody_waits_for_need_python():
    assert begin("end") == (["ends"], "")


def test_a_folder_that_is_cleared_while_a_compiler_works_holds_the_program_afterwards(tmp_path):
    assert run(BEGUN, "clear", cache=tmp_path) == (["cleared True 1"], "")


def test_a_compiler_without_room_does_not_end_the_process(tmp_path):
    (told,), errors = run(BEGUN, "fill", cache=tmp_path, limits="ulimit -f 512;")
    assert re.match("the folder in which .* cannot be written, nor is there a temporary one .* Set .* WARP_CACHE_PATH to", told)
    assert errors == ""


def test_a_thread_that_outlives_the_main_one_compiles_by_itself(tmp_path):
    assert run(BEGUN, "outlive", cache=tmp_path) == (["right True"], "")


@pytest.mark.skipif(sys.platform != "linux", reason="forks with memory for instructions")
def test_processes_that_fork_share_no_door_and_leave_no_lock_behind():
    assert begin("fork") == (["led elsewhere 0", "ended 0 0 0 0 0 0"], "")
