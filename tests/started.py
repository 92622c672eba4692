"""Python in processes of their own, for tests that must not share one with others."""

import os
import subprocess
import sys

from places import ROOT


def run_python(*words, ends=0, cwd=ROOT, python=sys.executable, without=(), timeout=None, **environment):
    """Run Python on these words, in this environment besides what is there; return what it printed, if it ends with this status."""
    told = {name: value for name, value in os.environ.items() if name not in without} | environment
    command = [python, *map(str, words)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, env=told, timeout=timeout)
    assert done.returncode == ends, done.stdout + done.stderr
    return done
