"""The lowest versions that `pyproject.toml` declares, in an environment of their own: what it says there is true.

Everything is fetched from the registry that pip asks; where none can be reached, nothing is tested.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pasted
import pytest
from places import ROOT
from test_package import build_wheel

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TESTING = ("pytest>=8", "pytest-xdist>=3.7", "hypothesis>=6.100", "jaxtyping>=0.2.34", "beartype>=0.18")
UNREACHABLE = r"NewConnectionError|ConnectTimeoutError|ReadTimeoutError|ProxyError|ConnectionResetError|name resolution"
AT_ONCE = ("-m", "pytest", "--quiet", "-n", "0", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml"), "-o", "pythonpath=")


def lowest(requirements):
    """Return the lower bounds, by name: one of "jax[cuda13]>=0.7.2,<1" is jax 0.7.2."""
    found = [re.match(r"([\w.-]+)(?:\[[^]]*\])?>=([\w.]+)", each) for each in requirements]
    return {each[1]: re.sub(r"(\.0)+$", "", each[2]) for each in found}


VERSIONS = lowest([*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["warp"]])
VERSIONS["jaxlib"] = VERSIONS["jax"]


def run(*command, cwd, **environment):
    """Run a command as a user does: what tests ask of XLA is not asked of an XLA that knows nothing of it."""
    left_out = ("PYTHONPATH", "XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    told = {name: value for name, value in os.environ.items() if name not in left_out} | environment
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, env=told)


def lowest_python():
    """Return the lowest Python that is declared, if it is there."""
    version = PROJECT["requires-python"].removeprefix(">=")
    here = "{}.{}".format(*sys.version_info) == version
    found = sys.executable if here else shutil.which(f"python{version}")
    if found is None or run(found, "-c", "import venv, ensurepip", cwd=ROOT).returncode:
        pytest.skip(f"there is no Python {version}, the lowest that is declared")
    return found


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Install the lowest versions that are declared; return the Python that has them."""
    folder, found = tmp_path_factory.mktemp("lowest"), lowest_python()
    assert run(found, "-m", "venv", str(folder / "venv"), cwd=folder).returncode == 0
    pins = folder / "pins.txt"
    pins.write_text("".join(f"{name}=={version}\n" for name, version in VERSIONS.items()))
    python = str(folder / "venv" / "bin" / "python")
    install(python, "--constraint", str(pins), f"{build_wheel(folder)}[warp]", cwd=folder)
    return python


@pytest.fixture(scope="module")
def tested(python, tmp_path_factory):
    """Install what tests need besides; return the Python."""
    folder = tmp_path_factory.mktemp("testing")
    install(python, *(f"{name}=={version}" for name, version in VERSIONS.items()), *TESTING, cwd=folder)
    return python


def install(python, *words, cwd):
    done = run(python, "-m", "pip", "install", "--quiet", "--no-compile", "--retries", "1", "--timeout", "60", *words, cwd=cwd)
    if done.returncode and (told := re.search(UNREACHABLE, done.stderr)):
        pytest.skip(f"pip reaches no registry ({told[0]}): the lowest versions are not tested")
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_is_declared_is_installed(python, tmp_path):
    code = "import sys, importlib.metadata as m, jfrnn; print(jfrnn.__file__, *(f'{x}>={m.version(x)}' for x in sys.argv[1:]))"
    done = run(python, "-c", code, *VERSIONS, cwd=tmp_path)
    file, *versions = done.stdout.split()
    assert not Path(file).is_relative_to(ROOT) and lowest(versions) == VERSIONS, done.stderr


def test_cuda_is_there_for_the_lowest_jax_that_is_declared_with_it(python, tmp_path):
    """JAX names an extra before its packages are there; they take gigabytes, and are not installed here."""
    done = run(python, "-m", "pip", "index", "versions", "jax-cuda13-plugin", cwd=tmp_path)
    versions = [re.sub(r"(\.0)+$", "", each) for each in re.findall(r"[\d.]+\d", done.stdout)]
    assert lowest(PROJECT["optional-dependencies"]["cuda13"])["jax"] in versions, done.stderr


def complaints(done):
    """Return what a process said, but for what it says on a slow machine: that it compiles."""
    return [line for line in done.stderr.splitlines() if not line.startswith("jfrnn compiles kernels, ")]


def test_the_readme_runs_as_pasted(python, tmp_path):
    page = tmp_path / "README.md"
    shutil.copy(ROOT / "README.md", page)
    done = run(python, "-W", "error::RuntimeWarning", "-c", pasted.PROGRAM, str(page), cwd=tmp_path)
    assert pasted.lines_run(done.stdout).get(str(page), 0) > 20 and not complaints(done), done.stdout + done.stderr


def test_the_command_says_what_runs(python, tmp_path):
    done = run(python, "-W", "error", "-m", "jfrnn", cwd=tmp_path)
    assert done.returncode == 0 and not complaints(done), done.stdout + done.stderr
    told = dict(re.findall(r"^  (\w+) +(right|does not run: .*)", done.stdout, re.MULTILINE))
    assert [told[name] for name in ("jax", "warp", "brute")] == ["right"] * 3
    assert told["hashgrid"].startswith("does not run: the HashGrid of warp-lang") or VERSIONS["warp-lang"] != "1.18"


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["f32-3d and (warp or jax)", "not hashgrid"], ids=["single_3d", "all"])
def test_hard_cases(tested, kinds, tmp_path):
    """The hash grid of the lowest Warp is refused. `python -m jfrnn`, which runs each time, has pairs of each engine compared."""
    done = run(tested, *AT_ONCE, str(ROOT / "tests" / "engine" / "test_hard_cases.py"), "-k", kinds, cwd=tmp_path)
    assert done.returncode == 0 and int(re.search(r"(\d+) passed", done.stdout)[1]) > 100, done.stdout + done.stderr


@pytest.mark.slow
def test_sums_are_joined(tested, tmp_path):
    """Pairs are found once for a sum and its gradient, which takes what JAX promises to nobody."""
    which = "energies-open or can_be_read"
    done = run(tested, *AT_ONCE, str(ROOT / "tests" / "sums" / "test_joint.py"), "-k", which, cwd=tmp_path)
    assert done.returncode == 0 and "2 passed" in done.stdout, done.stdout + done.stderr
