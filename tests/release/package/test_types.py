"""Pyright finds no error in types. `make lint` says the same; here, other tests run beside it."""

import subprocess
import sys

from places import ROOT


def test_pyright_finds_no_error():
    """A worker that waits for pyright leaves the others all cores but one."""
    root = ROOT
    found = subprocess.run(
        [sys.executable, "-m", "pyright", "--pythonpath", sys.executable], cwd=root, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stdout + found.stderr
