"""Pyright finds no error in types, as `make lint` says, and mypy refuses of `typed.py` what is wrong, and nothing else."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT


def test_pyright_finds_no_error():
    """A worker that waits for pyright leaves the others all cores but one."""
    told = os.environ | {"NODE_OPTIONS": "--max-semi-space-size=128"}  # MB: with less, garbage is collected all the time
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=told)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.slow
def test_mypy_refuses_what_is_wrong_alone(tmp_path):
    """Of the package as whoever installs it has it, beside what it needs."""
    text = (Path(__file__).parent / "typed.py").read_text(encoding="utf-8")
    (tmp_path / "typed.py").write_text(text, encoding="utf-8")
    (tmp_path / "jfrnn").symlink_to(ROOT / "jfrnn")
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", os.devnull, "--follow-imports", "silent", "typed.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    wrong = [number for number, line in enumerate(text.splitlines(), start=1) if "pyright: ignore" in line]
    assert [int(line) for line in re.findall(r"^typed\.py:(\d+): error", done.stdout, re.MULTILINE)] == wrong, done.stdout
