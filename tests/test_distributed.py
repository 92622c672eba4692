"""`jfrnn.distributed` on virtual devices and on two processes; what is checked stands in `distributed_checks.py`."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKS = Path(__file__).parent / "distributed_checks.py"
QUICK = {  # the others compile longer
    "pairs_on_1_2_4_8_devices",
    "particles_move_across_several_shards",
    "room_that_is_missing_is_told_and_made",
    "sums_and_their_gradients",
    "wrong_arguments_are_named",
}
NAMES = [
    node.name
    for node in ast.parse(CHECKS.read_text()).body
    if isinstance(node, ast.FunctionDef) and [ast.unparse(x) for x in node.decorator_list] == ["check"]
]


def outcomes(names):
    run = subprocess.run(
        [sys.executable, str(CHECKS), *names],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    assert [line["name"] for line in lines] == names, run.stderr
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
