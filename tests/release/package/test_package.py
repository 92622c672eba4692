"""The package: what a wheel holds works elsewhere, and says what runs there."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from importlib.metadata import distribution
from pathlib import Path

import pytest
from checked import refuses
from places import ROOT, list_files
from started import run_python

import jfrnn
from jfrnn import __main__

SEARCH = """
import doctest, jfrnn, numpy as np
import jfrnn.cases.hard, jfrnn.distributed
assert jfrnn.__file__.startswith({folder!r}), jfrnn.__file__
assert doctest.testmod(jfrnn).failed == 0
x = np.random.default_rng(0).uniform(size=(300, 3)).astype(np.float32)
nbrs = jfrnn.search(x, 0.1)
assert nbrs.backend == {engine!r}
print(len(nbrs.pairs()[0]))
"""
FLUID = ("-m", "jfrnn.sph", "run", "one", "--set", "duration=0.0002", "--frames", "1")


def run(*arguments, cwd, python=sys.executable, **environment):
    return run_python(*arguments, cwd=cwd, python=python, without=("PYTHONPATH",), **environment).stdout


def build_wheel(folder):
    """Build a wheel of a copy of the tree, without what an earlier build left, and without the internet."""
    for name in ("jfrnn", "jfrnn_ase_plugin.py", "kernels", "cases", "pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (folder / "tree").mkdir(exist_ok=True)
        (folder / "tree" / name).symlink_to(ROOT / name)
    build = ("-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(folder / "tree"))
    run(*build, cwd=folder)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel(tmp_path_factory.mktemp("wheel"))


def test_wheel_works_elsewhere(wheel, tmp_path):
    site = str(tmp_path / "site")
    run("-m", "pip", "install", "--quiet", "--no-deps", "--no-compile", "--target", site, wheel, cwd=tmp_path)
    said = run("-c", SEARCH.format(folder=str(tmp_path), engine="warp"), cwd=tmp_path, PYTHONPATH=site)
    assert int(said.split()[-1]) > 0
    run(*FLUID, "--no-pictures", cwd=tmp_path, PYTHONPATH=site)
    assert (tmp_path / "out/sph/one/snapshots/000000002.vtp").exists()


def test_wheel_holds_the_library_alone(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"jfrnn", "jfrnn_ase_plugin.py", f"jfrnn-{jfrnn.__version__}.dist-info"}
    assert {Path(name).suffix for name in names if not name.startswith("jfrnn-")} == {".py", ".typed", ".h", ".cuh"}
    held = {Path(name).name for name in names if "/native/" in name}
    assert held == {path.name for path in (ROOT / "kernels" / "native").rglob("*") if path.suffix in (".py", ".h", ".cuh")}


def test_a_wheel_made_from_the_sdist_holds_the_same(wheel, tmp_path):
    """The source distribution is whole: it holds every file of the repository, and its tests run from it."""
    tree, names = tmp_path / "tree", set(list_files())
    for name in names:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    build = "from setuptools import build_meta; print(build_meta.build_{}('..'))"
    made = tmp_path / run("-c", build.format("sdist"), cwd=tree).split()[-1]
    assert made.name == f"jfrnn-{jfrnn.__version__}.tar.gz"
    with tarfile.open(made) as held:
        assert names <= {name.partition("/")[2] for name in held.getnames()}
        held.extractall(tmp_path, filter="data")
    source = tmp_path / f"jfrnn-{jfrnn.__version__}"
    assert " passed" in run("-m", "pytest", "-n", "0", "tests/geometry/test_meshes.py", cwd=source)
    again = tmp_path / run("-c", build.format("wheel"), cwd=source).split()[-1]
    assert sorted(zipfile.ZipFile(again).namelist()) == sorted(zipfile.ZipFile(wheel).namelist())


def test_extras_name_what_the_wheel_holds():
    with (ROOT / "pyproject.toml").open("rb") as stream:
        project = tomllib.load(stream)
    assert set(project["project"]["optional-dependencies"]) == {"warp", "cuda13", "sph"}
    assert {"experiments", "peers", "notebooks", "docs", "test"} <= set(project["dependency-groups"])
    assert f"version: {jfrnn.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {jfrnn.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_extras_are_there_for_a_resolver(wheel, tmp_path):
    """Offline: pip resolves the extra whose packages are installed here; the other is one that JAX has."""
    run("-m", "pip", "install", "--dry-run", "--no-index", f"{wheel}[warp,sph]", cwd=tmp_path)
    told = metadata(wheel)
    assert set(told.get_all("Provides-Extra")) == {"warp", "cuda13", "sph"}
    needed = next(line for line in told.get_all("Requires-Dist") if 'extra == "cuda13"' in line)
    assert needed.startswith("jax[cuda13]") and "cuda13" in distribution("jax").metadata.get_all("Provides-Extra")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extras", "engine"), [("", "jax"), ("[warp]", "warp"), ("[sph]", "jax"), ("[cuda13]", "jax"), ("[warp,cuda13]", "warp")]
)
def test_wheel_works_in_a_fresh_environment_with_each_extra(wheel, tmp_path, extras, engine):
    """Everything is fetched: those of CUDA take gigabytes."""
    run("-m", "venv", str(tmp_path / "venv"), cwd=tmp_path)
    python = str(tmp_path / "venv" / "bin" / "python")
    run("-m", "pip", "install", "--quiet", "--no-compile", "--no-cache-dir", f"{wheel}{extras}", cwd=tmp_path, python=python)
    search = SEARCH.format(folder=str(tmp_path), engine=engine)
    if engine == "jax":
        search = search.replace("assert doctest.testmod(jfrnn).failed == 0\n", "")  # they name engines of Warp
    assert int(run("-c", search, cwd=tmp_path, python=python, JAX_PLATFORMS="cpu").split()[-1]) > 0
    said = run("-m", "jfrnn", cwd=tmp_path, python=python, JAX_PLATFORMS="cpu")
    assert f"  {engine:9} right" in said
    if extras == "[sph]":
        run(*FLUID, cwd=tmp_path, python=python, JAX_PLATFORMS="cpu")
        assert (tmp_path / "out/sph/one/one.gif").exists()


def metadata(wheel):
    with zipfile.ZipFile(wheel) as held:
        return message_from_bytes(held.read(next(name for name in held.namelist() if name.endswith("/METADATA"))))


def describe(tree, repository):
    """Return the metadata of a package whose pyproject.toml names a repository."""
    for name in ("jfrnn", "kernels", "cases", "setup.py", "README.md", "LICENSE"):
        (tree / name).symlink_to(ROOT / name)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'repository = ""' in text
    (tree / "pyproject.toml").write_text(text.replace('repository = ""', f'repository = "{repository}"'), encoding="utf-8")
    made = run("-c", "from setuptools import build_meta as b; print(b.prepare_metadata_for_build_wheel('.'))", cwd=tree).split()[-1]
    return message_from_bytes((tree / made / "METADATA").read_bytes())


@pytest.mark.parametrize("repository", ["", "https://example.org/owner/jfrnn/"])
def test_links_and_pictures_of_a_package_page_lead_somewhere(wheel, tmp_path, repository):
    """One line of pyproject.toml makes them all; without it there are none that lead nowhere."""
    told = describe(tmp_path, repository) if repository else metadata(wheel)
    text = told.get_payload()
    assert "make sweep" not in text and "\n## Cite\n" in text
    links = re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", text)
    assert all(link.startswith(("https://", "#")) for _, link in links)
    assert told["Author"] == "jfrnn developers"
    if not repository:
        assert "![" not in text and told.get_all("Project-URL") is None and "A jet of oil onto a turning gear" in text
        assert "quickstart (`notebooks/quickstart.ipynb`)" in text
        return
    home = repository.rstrip("/")
    assert [link for picture, link in links if picture] == [f"{home}/raw/main/docs/_static/jet.gif"]
    assert ("", f"{home}/blob/main/docs/start.md") in links
    named = dict(line.split(", ") for line in told.get_all("Project-URL"))
    assert named["Homepage"] == home and set(named) == {"Homepage", "Documentation", "Changelog"}
    paths = {link.removeprefix(f"{home}/").partition("/main/")[2] for _, link in links if link.startswith(home)}
    assert paths and all((ROOT / path.partition("#")[0]).exists() for path in paths)


def test_command_says_which_engines_run():
    said = run("-m", "jfrnn", cwd=ROOT)
    assert f"jfrnn {jfrnn.__version__}: Python" in said
    wanted = dict.fromkeys(("jax", "warp", "brute"), "pairs, sum and gradient,") | {"hashgrid": "pairs,", "brute": "pairs, sum and"}
    assert [name for name, what in wanted.items() if f"  {name:9} right: {what}" not in said] == []


def test_command_refuses_what_it_does_not_know(capsys):
    refuses(SystemExit, "2", __main__.main, ["--versoin"])
    assert "unrecognized arguments: --versoin" in capsys.readouterr().err
    refuses(SystemExit, "0", __main__.main, ["--version"])
    assert capsys.readouterr().out == f"jfrnn {jfrnn.__version__}\n"


def test_command_ends_quietly_where_nobody_reads():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-u", "-m", "jfrnn"]
    done = subprocess.run(command, cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


def test_command_names_the_platforms_that_were_asked_for(monkeypatch, capsys):
    def fail():
        raise AssertionError

    monkeypatch.setattr(__main__, "default_platform", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    assert __main__.main([]) == 1
    assert "JAX finds no device of JAX_PLATFORMS=cuda: AssertionError" in capsys.readouterr().out


def test_command_goes_on_where_an_engine_fails(monkeypatch, capsys):
    def fail(backend, sums):
        raise RuntimeError(f"{backend} breaks\nhere")

    monkeypatch.setattr(__main__, "_is_right", fail)
    assert __main__.main([]) == 1
    said = capsys.readouterr().out
    assert [f"  {name:9} FAILS, RuntimeError: {name} breaks\n" in said for name in ("jax", "brute")] == [True, True]
