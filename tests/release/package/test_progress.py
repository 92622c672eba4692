"""What is told while tests run: which file begins, how long it took, and where a test hangs."""

import re

from places import TESTS
from started import run_python

SCENE = {
    "conftest.py": "import progress\n\nprogress.PATIENCE = 1\npytest_plugins = ['progress']\n",
    "test_quick.py": "import pytest\n\ndef test_one(): pass\ndef test_two(): assert False\ndef test_three(): pytest.skip()\n",
    "test_slow.py": "import time\n\ndef test_that_waits(): time.sleep(2.5)\n",
}


def test_files_are_told_as_they_begin_and_end_and_what_hangs(tmp_path):
    for name, text in SCENE.items():
        (tmp_path / name).write_text(text)
    words = ("-m", "pytest", "-n", 2, "--dist", "loadfile", "-p", "no:cacheprovider", tmp_path)
    told = run_python(*words, ends=1, cwd=tmp_path, PYTHONPATH=str(TESTS)).stdout
    for line in (
        r" test_quick\.py: 3 tests begin$",
        r"\[ 75%\] test_quick\.py: 1 failed, 1 passed, 1 skipped in \d+\.\d s$",
        r" test_slow\.py: 1 tests begin$",
        r" no result for \d+ s: test_slow\.py::test_that_waits runs$",
        r"\[100%\] test_slow\.py: 1 passed in \d+\.\d s$",
    ):
        assert re.search(line, told, re.MULTILINE), (line, told)
