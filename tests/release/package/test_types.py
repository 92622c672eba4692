"""Pyright finds no error in types, as `make lint` says, and mypy refuses of `typed.py` what is wrong, and nothing else."""

import os
import re
import sys
from pathlib import Path

import pytest
from checked import slow
from places import ROOT
from started import run_python


@pytest.mark.parametrize("paths", [("jfrnn", "tests/release/package/typed.py"), slow(("experiments",))], ids=lambda each: each[0])
def test_pyright_finds_no_error(paths):
    """A worker that waits for pyright leaves the others all cores but one."""
    room = "--max-semi-space-size=128"  # MB: with less, garbage is collected all the time
    run_python("-m", "pyright", "--pythonpath", sys.executable, *paths, NODE_OPTIONS=room)


@pytest.mark.slow
def test_mypy_refuses_what_is_wrong_alone(tmp_path):
    """Of the package as whoever installs it has it, beside what it needs."""
    text = (Path(__file__).parent / "typed.py").read_text(encoding="utf-8")
    (tmp_path / "typed.py").write_text(text, encoding="utf-8")
    (tmp_path / "jfrnn").symlink_to(ROOT / "jfrnn")
    words = ("-m", "mypy", "--strict", "--cache-dir", os.devnull, "--follow-imports", "silent", "typed.py")
    done = run_python(*words, ends=1, cwd=tmp_path)
    wrong = [number for number, line in enumerate(text.splitlines(), start=1) if "pyright: ignore" in line]
    assert [int(line) for line in re.findall(r"^typed\.py:(\d+): error", done.stdout, re.MULTILINE)] == wrong, done.stdout
