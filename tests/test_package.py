"""The package: what a wheel holds works elsewhere, and says what runs there."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import jfrnn

ROOT = Path(__file__).parent.parent
SEARCH = """
import doctest, jfrnn, numpy as np
import jfrnn.cases.hard, jfrnn.distributed
assert jfrnn.__file__.startswith({folder!r}), jfrnn.__file__
assert doctest.testmod(jfrnn).failed == 0
x = np.random.default_rng(0).uniform(size=(300, 3)).astype(np.float32)
nbrs = jfrnn.search(x, 0.1)
assert nbrs.backend == "warp"
print(len(nbrs.pairs()[0]))
"""


def run(*arguments, cwd, **environment):
    told = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | environment
    done = subprocess.run([sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False, env=told)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build a wheel of a copy of the tree, without what an earlier build left, and without the internet."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("jfrnn", "kernels", "cases", "pyproject.toml", "README.md", "LICENSE"):
        (folder / "tree").mkdir(exist_ok=True)
        (folder / "tree" / name).symlink_to(ROOT / name)
    build = ("-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(folder / "tree"))
    run(*build, cwd=folder)
    (found,) = folder.glob("*.whl")
    return found


def test_wheel_works_elsewhere(wheel, tmp_path):
    run(
        "-m", "pip", "install", "--quiet", "--no-deps", "--no-compile", "--target", str(tmp_path / "site"), str(wheel), cwd=tmp_path
    )
    said = run("-c", SEARCH.format(folder=str(tmp_path)), cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert int(said.split()[-1]) > 0


def test_wheel_holds_the_library_alone(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"jfrnn", f"jfrnn-{jfrnn.__version__}.dist-info"}
    assert {Path(name).suffix for name in names if not name.startswith("jfrnn-")} == {".py", ".typed", ".h", ".cuh"}
    held = {Path(name).name for name in names if "/native/" in name}
    assert held == {path.name for path in (ROOT / "kernels" / "native").iterdir() if path.suffix in (".py", ".h", ".cuh")}


def test_extras_name_what_the_wheel_holds():
    with (ROOT / "pyproject.toml").open("rb") as stream:
        project = tomllib.load(stream)
    assert set(project["project"]["optional-dependencies"]) == {"warp", "cuda13"}
    assert {"experiments", "peers", "notebooks", "docs", "test"} <= set(project["dependency-groups"])
    assert f"version: {jfrnn.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {jfrnn.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_command_says_which_engines_run():
    said = run("-m", "jfrnn", cwd=ROOT)
    assert f"jfrnn {jfrnn.__version__}: Python" in said
    assert [f"  {name:9} right" for name in ("jax", "warp", "hashgrid", "brute") if f"  {name:9} right" not in said] == []
