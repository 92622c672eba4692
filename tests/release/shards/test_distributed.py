"""`jfrnn.distributed` on virtual devices and on two processes; what is checked stands in `distributed_checks.py`."""

import ast
import json
import os
import socket
import subprocess
import sys

import pytest
from places import TESTS

HERE = TESTS
CHECKS, SPH, PROCESS = HERE / "distributed_checks.py", HERE / "distributed_sph.py", HERE / "distributed_process.py"
QUICK = {  # the others compile longer
    "counts_beside_cuts_that_differ_and_of_strays",
    "one_function_in_two_boxes_on_two_meshes",
    "pairs_on_8_devices",
    "particles_move_across_several_shards",
    "particles_that_do_not_fill_a_round_of_migration",
    "sums_and_their_gradients",
    "what_is_missing_anywhere_is_told",
    "wrong_arguments_are_named",
}


def names_in(path):
    """Return what the file checks, without importing it: that would ask for devices here."""
    functions = (node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef))
    return [node.name for node in functions if [ast.unparse(x) for x in node.decorator_list] == ["check"]]


NAMES = names_in(CHECKS)


def started(*arguments):
    env = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(HERE.parent)}
    command = [sys.executable, *(str(argument) for argument in arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


def outcomes(names, path=CHECKS):
    stdout, stderr = started(path, *names).communicate()
    lines = [json.loads(line) for line in stdout.splitlines() if line.startswith("{")]
    assert [line["name"] for line in lines] == names, stderr
    return {line["name"]: line["wrong"] for line in lines}


@pytest.fixture(scope="module")
def quick():
    """All quick checks in one process: most of their time is its start and what they compile alike."""
    return outcomes([name for name in NAMES if name in QUICK])


@pytest.mark.parametrize("name", sorted(QUICK))
def test_on_virtual_devices(quick, name):
    assert quick[name] is None, quick[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in QUICK])
def test_more_on_virtual_devices(name):
    wrong = outcomes([name])[name]
    assert wrong is None, wrong


@pytest.mark.slow
@pytest.mark.parametrize("name", names_in(SPH))
def test_solver_on_virtual_devices(name):
    wrong = outcomes([name], SPH)[name]
    assert wrong is None, wrong


def two_processes(what):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    runs = [started(PROCESS, address, 2, process, what) for process in range(2)]
    return [(*run.communicate(timeout=120), run.returncode) for run in runs]


@pytest.mark.slow
def test_two_processes_with_gloo_find_what_one_finds():
    for stdout, stderr, code in two_processes("lives"):
        assert code == 0, stderr
        assert "4 devices, " in stdout


@pytest.mark.slow
@pytest.mark.parametrize("process", [0, 1])
def test_a_process_that_dies_ends_the_other(process):
    """With the message of JAX's coordination service, or that of the collective whose connection broke."""
    runs = two_processes(f"dies{process}")  # does not hang: there is a limit to it
    assert runs[process][2] == 1
    _, stderr, code = runs[1 - process]
    assert code != 0
    assert "another task died" in stderr or "Connection" in stderr, stderr
