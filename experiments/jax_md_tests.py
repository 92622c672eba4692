"""Run jax-md's own tests and examples with `jfrnn.jax_md` in the place of its neighbor lists, and beside that with its own.

`python -m experiments.jax_md_tests CHECKOUT [FILE ...]`: CHECKOUT is a clone of https://github.com/jax-md/jax-md, whose package is
used, and FILE are tests in it, or examples such as `examples/npt_simulation.py` (default: `FILES` and `EXAMPLES`). It prints how
many pass, and which do so with one list alone: one that fails by an error that jfrnn raises is refused. `--out=ROWS.csv` adds a
row for each as soon as it has run, and what has a row is not run again. `--list=jfrnn` runs one list alone. Further options go to
pytest.

Examples are run as jax-md's documentation runs them, with few steps. What they would download (a silicon crystal at 300 K, and
curves to draw beside theirs) is made here: it is the same for both lists.

As a plugin of pytest (`-p experiments.jax_md_tests`), this file puts our functions in place and writes the rows.
"""

import csv
import os
import re
import runpy
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from experiments import _machine

FILES = ("partition_test.py", "custom_partition_test.py", "energy_test.py", "smap_test.py", "simulate_test.py", "nn_test.py")
UNITS = ("berendsen", "csvr", "npt_melting", "npt", "nve", "nvk", "nvt", "velocity_rescale")
EXAMPLES = ("nve_neighbor_list", "npt_simulation", "npt_csvr", "custom_nl", *(f"units/{name}_si_sw" for name in UNITS))
EXAMPLES = tuple(f"examples/{name}.py" for name in EXAMPLES)
LISTS = ("jax-md", "jfrnn")
COLUMNS = ("file", "test", "list", "outcome", "seconds", "reason", "jax_md_commit", "jax", "commit")
_OURS = "JFRNN_IN_JAX_MD"
_ROWS = "JFRNN_ROWS_OF_JAX_MD"
_COMMITS = "JFRNN_COMMITS_OF_JAX_MD"
ROOT = Path(__file__).resolve().parents[1]

Rows = dict[tuple[str, str, str], dict[str, str]]  # by file, test and list


def put_in_place() -> None:
    """Replace the functions of jax-md that make neighbor lists, also where they are defaults of arguments."""
    from jax_md import custom_partition, energy, partition  # pyright: ignore[reportMissingImports]

    import jfrnn.jax_md as ours

    for module, name in ((partition, "neighbor_list"), (custom_partition, "neighbor_list_multi_image")):
        theirs, new = getattr(module, name), getattr(ours, name)
        setattr(module, name, new)
        for function in vars(energy).values():
            defaults = getattr(function, "__defaults__", None)
            if isinstance(defaults, tuple) and any(x is theirs for x in defaults):
                function.__defaults__ = tuple(new if x is theirs else x for x in defaults)


def run_example(path: str) -> None:
    """Run an example in this process, as jax-md's documentation does."""
    urllib.request.urlretrieve = _make_file
    if os.environ.get(_OURS):
        put_in_place()
    runpy.run_path(path, run_name="__main__")


def _make_file(url: str, name: str) -> None:
    """Write what an example would download."""
    rng = np.random.default_rng(0)
    corner = np.array([[0, 0, 0], [0, 2, 2], [2, 0, 2], [2, 2, 0]])
    atoms = np.concatenate([corner, corner + 1])  # of a cell of diamond, in quarters of its edge
    cells = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    x = (cells + atoms / 4).reshape(-1, 3) / 4  # fractions of the box of 4³ cells
    velocities = 2.98 * rng.standard_normal(x.shape)  # sqrt(kT/m) of silicon at 300 K [Å/ps]
    column = np.ones((len(x), 1))
    crystal = np.hstack([column, column, x, velocities - velocities.mean(0)])
    curves = rng.random((400, 5 if "melting" in name else 6))
    np.savetxt(name, crystal if name.endswith(".traj") else curves)


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Leave out the tests that have a row."""
    if os.environ.get(_ROWS):
        done, who = read(Path(os.environ[_ROWS])), _who()
        items[:] = [item for item in items if (item.path.name, _name(item.nodeid), who) not in done]


def pytest_runtest_logreport(report: Any) -> None:  # noqa: ANN401
    """Write the row of a test."""
    if not os.environ.get(_ROWS) or (report.when != "call" and report.outcome == "passed"):
        return
    if report.when == "teardown":
        return
    told = str(report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr or "").strip()
    row = (report.nodeid.partition("::")[0].rpartition("/")[2], _name(report.nodeid), _who())
    outcome = judge(told) if report.outcome == "failed" else report.outcome
    _add_row(row, outcome, report.duration, told.splitlines(), os.environ)


def _add_row(key: tuple[str, ...], outcome: str, seconds: float, lines: list[str], environment: Mapping[str, str]) -> None:
    """Add the row of a test or of an example; the last of the lines is its reason."""
    theirs, ours = environment[_COMMITS].split()
    with Path(environment[_ROWS]).open("a", newline="") as file:
        csv.writer(file).writerow((*key, outcome, f"{seconds:.1f}", (lines or [""])[-1][:200], theirs, version("jax"), ours))


def judge(told: str) -> str:
    """Say of an error whether jfrnn raised it, "refused": the last file that it names is then one of the library; else "failed"."""
    files = re.findall(r"([\w./-]+\.py)(?:\", line |:\d)", told)
    return "refused" if files and "jfrnn" in Path(files[-1]).parts else "failed"


def _who() -> str:
    return LISTS[bool(os.environ.get(_OURS))]


def _name(node: str) -> str:
    return node.partition("::")[2]


def read(path: Path) -> Rows:
    """Return the rows of a file; none if there is no file yet."""
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        return {(row["file"], row["test"], row["list"]): row for row in csv.DictReader(file)}


def run(checkout: Path, file: str, ours: bool, options: list[str], out: Path) -> None:
    """Run an example, or the tests of a file, that have no row yet, and add their rows."""
    if not out.exists():
        out.write_text(",".join(COLUMNS) + "\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), str(ROOT), os.environ.get("PYTHONPATH", "")])}
    commits = [(_machine.commit(folder)["commit"] or "unknown")[:12] for folder in (checkout, ROOT)]
    environment |= {_ROWS: str(out), _COMMITS: " ".join(commits), "READTHEDOCS": "True", "MPLBACKEND": "agg"}
    environment |= {_OURS: "1"} if ours else {}
    if file in EXAMPLES:
        if (file, "", LISTS[ours]) not in read(out):
            _run_example(checkout / file, (file, "", LISTS[ours]), environment)
        return
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "experiments.jax_md_tests", "-c", os.devnull]
    command += ["--rootdir", str(checkout), *options, str(checkout / "tests" / file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=checkout)
    if not any((file, LISTS[ours]) == (row[0], row[2]) for row in read(out)):
        raise SystemExit(f"no test ran: {(done.stdout + done.stderr).strip()[-2000:]}")


def _run_example(path: Path, key: tuple[str, ...], environment: dict[str, str]) -> None:
    """Run an example in an empty folder, and add its row: the reason is the last line that it printed."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", f"from experiments import jax_md_tests as own; own.run_example({str(path)!r})"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=folder)
    outcome = judge(done.stderr) if done.returncode else "passed"
    lines = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    numbers = [line for line in lines if re.search(r"\d\.\d", line)] if not done.returncode else lines
    _add_row(key, outcome, time.monotonic() - began, numbers, environment)


def passed_by(rows: Rows, file: str, who: str) -> set[str]:
    """Return the tests of a file that pass with one of the `LISTS`."""
    return {test for (of, test, by), row in rows.items() if (of, by) == (file, who) and row["outcome"] == "passed"}


def main(words: list[str]) -> None:
    """Print the table, and what passes with one list alone."""
    own = {key: [word.partition("=")[2] for word in words if word.startswith(f"--{key}=")] for key in ("out", "list")}
    options = [word for word in words if word.startswith("-") and not word.startswith(("--out=", "--list="))]
    names = [word for word in words if not word.startswith("-")]
    if not names or not (Path(names[0]) / "tests").is_dir():
        raise SystemExit(__doc__)
    checkout, files = Path(names[0]).resolve(), names[1:] or [*FILES, *EXAMPLES]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(own["out"][-1] if own["out"] else Path(folder) / "rows.csv").resolve()
        for file in files:
            for who in own["list"] or LISTS:
                run(checkout, file, who == LISTS[1], options, out)
            report(read(out), file)


def report(rows: Rows, file: str) -> None:
    """Print what became of a file with either list, and by name what does not pass with ours."""
    passed = [passed_by(rows, file, who) for who in LISTS]
    count = len({test for of, test, _ in rows if of == file})
    print(f"{file}: of {count} pass {len(passed[1])} with jfrnn, {len(passed[0])} with its own list", flush=True)
    for name in sorted(passed[1] - passed[0]):
        print(f"  only with jfrnn: {name}")
    for (of, name, who), row in rows.items():
        if of == file and who == LISTS[1] and row["outcome"] in ("failed", "refused"):
            print(f"  {row['outcome']}{'' if name in passed[0] else ', as with its own list'}: {name} ({row['reason']})")


if __name__ == "__main__":
    main(sys.argv[1:])
elif os.environ.get(_OURS):
    put_in_place()
