"""`experiments bench house`: counts of the sources at a commit."""

import shutil
import subprocess

import pytest

from experiments.bench import house


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout of two packages of the library, of which one imports the other, and a kernel."""
    if shutil.which("git") is None:
        pytest.skip("no git")
    texts = {
        "jfrnn/__init__.py": "from jfrnn._above import up\n",
        "jfrnn/_above/__init__.py": 'from jfrnn._below import down\n\n\ndef up(a, b, *, c):\n    """Go."""\n    return down\n',
        "jfrnn/_below/__init__.py": "down = 1  # noqa: X\n",
        "jfrnn/sph/__init__.py": "above = 1\n",
        "kernels/native/text.h": "a\nb\nc\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for words in (("init", "-q"), ("add", "."), ("-c", "user.name=x", "-c", "user.email=x@x", "commit", "-qm", "x")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)


def test_counts_are_those_of_the_commit(checkout):
    row = house.count_part("HEAD", "library")
    assert (row["files"], row["lines"], row["lines_native"]) == (4, 11, 3)
    assert (row["longest_file"], row["longest_file_lines"]) == ("jfrnn/_above/__init__.py", 6)
    assert (row["longest_function"], row["longest_function_lines"], row["most_parameters"]) == (
        "jfrnn/_above/__init__.py: up",
        2,
        3,
    )
    assert (row["floors"], row["noqa_and_ignore"]) == (3, 1)
