"""Handlers of signals that raise while searches run: no wrong result, nothing lost, no memory written after it was given back."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "interrupted.py"


def run(tries):
    """Raise so many times in each of 16 works; return how often a result was wrong, and an exception lost."""
    environment = os.environ | {"JAX_ENABLE_X64": "0"}
    done = subprocess.run([sys.executable, PROGRAM, str(tries)], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    print(done.stderr)  # what was dropped, and where
    words = done.stdout.split()
    return {kind: int(times) for kind, times in zip(words[::2], words[1::2])}


def assert_sound(found, tries):
    assert (found["wrong"], found["lost"]) == (0, 0)
    assert found["interrupted"] + found["finished"] == 16 * tries
    assert min(found["interrupted"], found["finished"]) > tries  # it was raised within searches, and behind them


def test_interrupted_searches_are_right_or_raise():
    assert_sound(run(24), 24)


@pytest.mark.slow
def test_searches_that_are_interrupted_thousands_of_times_are_right_or_raise():
    assert_sound(run(300), 300)
