"""Run jax-md's own tests with `jfrnn.jax_md` in the place of its neighbor lists, and beside that with its own.

`python -m experiments.jax_md_tests CHECKOUT [FILE ...]`: CHECKOUT is a clone of https://github.com/jax-md/jax-md, whose package is
used, and FILE are tests in it (default: partition, energy, smap and simulate). It prints how many tests pass, and which do so with
one list alone. `--out=ROWS.csv` adds a row for each test as soon as it has run, and a test that has a row is not run again.
Further options go to pytest. As a plugin of pytest (`-p experiments.jax_md_tests`), this file puts our functions in place and
writes the rows.
"""

import csv
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

FILES = ("partition_test.py", "energy_test.py", "smap_test.py", "simulate_test.py")
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
    import jax

    theirs, ours = os.environ[_COMMITS].split()
    reason = str(report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr or "").strip().splitlines()[-1:]
    row = (report.nodeid.partition("::")[0].rpartition("/")[2], _name(report.nodeid), _who(), report.outcome)
    with Path(os.environ[_ROWS]).open("a", newline="") as file:
        csv.writer(file).writerow(
            (*row, f"{report.duration:.1f}", *[x[:200] for x in reason or [""]], theirs, jax.__version__, ours)
        )


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
    """Run the tests of a file that have no row yet, and add their rows."""
    if not out.exists():
        out.write_text(",".join(COLUMNS) + "\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), str(ROOT), os.environ.get("PYTHONPATH", "")])}
    environment |= {_ROWS: str(out), _COMMITS: " ".join(_commit(folder) for folder in (checkout, ROOT))}
    environment |= {_OURS: "1"} if ours else {}
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "experiments.jax_md_tests", "-c", os.devnull]
    command += ["--rootdir", str(checkout), *options, str(checkout / "tests" / file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=checkout)
    if not any((file, LISTS[ours]) == (row[0], row[2]) for row in read(out)):
        raise SystemExit(f"no test ran: {(done.stdout + done.stderr).strip()[-2000:]}")


def _commit(folder: Path) -> str:
    told = subprocess.run(["git", "rev-parse", "--short=12", "HEAD"], cwd=folder, capture_output=True, text=True, check=False)
    return told.stdout.strip() or "unknown"


def passed_by(rows: Rows, file: str, who: str) -> set[str]:
    """Return the tests of a file that pass with one of the `LISTS`."""
    return {test for (of, test, by), row in rows.items() if (of, by) == (file, who) and row["outcome"] == "passed"}


def main(words: list[str]) -> None:
    """Print the table, and what passes with one list alone."""
    options = [word for word in words if word.startswith("-") and not word.startswith("--out=")]
    asked = [word.partition("=")[2] for word in words if word.startswith("--out=")]
    names = [word for word in words if not word.startswith("-")]
    if not names or not (Path(names[0]) / "tests").is_dir():
        raise SystemExit(__doc__)
    checkout, files = Path(names[0]).resolve(), names[1:] or list(FILES)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(asked[-1] if asked else Path(folder) / "rows.csv").resolve()
        for file in files:
            for ours in (False, True):
                run(checkout, file, ours, options, out)
            rows = read(out)
            passed = [passed_by(rows, file, who) for who in LISTS]
            count = len({test for of, test, _ in rows if of == file})
            print(f"{file}: of {count} tests pass {len(passed[1])} with jfrnn, {len(passed[0])} with its own list", flush=True)
            for who, only in (("its own list", passed[0] - passed[1]), ("jfrnn", passed[1] - passed[0])):
                for name in sorted(only):
                    print(f"  only with {who}: {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
elif os.environ.get(_OURS):
    put_in_place()
