"""Pyright finds no error in types. `make lint` says the same; here, other tests run beside it."""

import os
import subprocess
import sys

from places import ROOT


def test_pyright_finds_no_error():
    """A worker that waits for pyright leaves the others all cores but one."""
    told = os.environ | {"NODE_OPTIONS": "--max-semi-space-size=128"}  # MB: with less, garbage is collected all the time
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=told)
    assert found.returncode == 0, found.stdout + found.stderr
