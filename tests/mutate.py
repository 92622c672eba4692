"""Faults of one line, each put into a copy of the library: do the tests that claim that place notice it?

    python tests/mutate.py [ROOM ...] [--jobs 2] [--only TEXT] [--unmutated]

A room is a file of `tests/mutants`. Each of its entries says what is written (`file`, `was`, which stands there once), what would
be wrong (`now`, `why`), and which tests claim to know (`tests`, arguments of pytest; `gpu = true` where only a GPU can tell, and
`slow = true` where only tests can that run by hand). A fault is killed if one of them fails. The same tests must pass where
nothing is changed, which is tried first, of all rooms at once.
"""

import argparse
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import jax
from places import ROOT, list_files
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

ROOMS = {path.stem: path for path in sorted((ROOT / "tests" / "mutants").glob("*.toml"))}
ROWS = ROOT / "out" / "mutants.jsonl"
LONGEST = 600  # that the tests of a fault may take [s]; one that never ends is noticed, too
PYTEST = ["-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-p", "no:benchmark", "--no-header", "--tb=line"]


class Mutant(NamedTuple):
    """A fault of one line, and which tests claim to notice it."""

    room: str
    file: str
    was: str
    now: str
    why: str
    tests: tuple[str, ...]
    gpu: bool = False
    slow: bool = False

    def mutated(self, text: str) -> str:
        """Return the text of the file with the fault.

        Raises:
            ValueError: what was written stands there never, or more than once.
        """
        if text.count(self.was) != 1 or self.was == self.now:
            raise ValueError(f"{self.room}: {self.was!r} stands {text.count(self.was)} times in {self.file}, once is needed.")
        return text.replace(self.was, self.now)


def read_mutants(rooms: list[str]) -> list[Mutant]:
    """Return the faults of these rooms.

    Raises:
        ValueError: an entry is not as the files are now.
    """
    found = []
    for room in rooms:
        for entry in tomllib.loads(ROOMS[room].read_text(encoding="utf-8"))["mutant"]:
            mutant = Mutant(room, **entry | {"tests": tuple(entry["tests"])})
            mutant.mutated((ROOT / mutant.file).read_text(encoding="utf-8"))
            found.append(mutant)
    return found


def copy_tree(to: Path) -> None:
    """Copy the project, without what no test of a fault reads."""
    for name in list_files():
        if not name.startswith(("experiments/results/", "notebooks/", "docs/_static/")):
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name, follow_symlinks=False)


def run_tests(tests: tuple[str, ...], tree: Path, marked: str) -> tuple[int, str]:
    """Run tests in a tree; return pytest's exit status, -1 where they took too long, and what it printed."""
    path = os.pathsep.join([str(tree), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        done = subprocess.run(
            [sys.executable, *PYTEST, "-m", marked, *tests],
            cwd=tree,
            env=os.environ | {"PYTHONPATH": path, "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "xla")},
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return -1, "took too long"
    return done.returncode, done.stdout + done.stderr


def try_mutant(mutant: Mutant, trees: "queue.Queue[Path]") -> dict[str, object]:
    """Put a fault into a tree, run its tests there, take it out again, and return a row."""
    tree, began = trees.get(), time.monotonic()
    place = tree / mutant.file
    right = place.read_text(encoding="utf-8")
    try:
        place.write_text(mutant.mutated(right), encoding="utf-8")
        status, printed = run_tests(mutant.tests, tree, "slow or not slow" if mutant.slow else "not slow")
    finally:
        place.write_text(right, encoding="utf-8")
        trees.put(tree)
    end = "survived" if status == 0 else "killed" if status in (1, -1) or status > 128 or status < -1 else "not run"
    row = {"result": end, "seconds": round(time.monotonic() - began, 1), **mutant._asdict()}
    last = [line for line in printed.splitlines() if line.strip()][-6:]
    return row if end != "not run" else row | {"printed": last}


def main() -> int:
    """Try the faults that are asked for; return 1 if one survived."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help=f"of {', '.join(ROOMS)}; all if none is named")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="how many run at once (default: one per core)")
    parser.add_argument("--only", default="", help="faults whose file or text holds this")
    parser.add_argument("--unmutated", action="store_true", help="run the tests where nothing is changed, and no more")
    asked = parser.parse_args()
    for room in asked.rooms:
        if room not in ROOMS:
            parser.error(f"there is no room {room!r}: name some of {', '.join(ROOMS)}")
    console, has_gpu = Console(), jax.default_backend() == "gpu"
    every = [m for m in read_mutants(asked.rooms or list(ROOMS)) if asked.only in f"{m.file} {m.was} {m.now} {m.why}"]
    mutants = [m for m in every if has_gpu or not m.gpu]
    trees: queue.Queue[Path] = queue.Queue()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="jfrnn-mutants-") as folder:
        for k in range(max(1, asked.jobs)):
            copy_tree(Path(folder) / str(k))
            trees.put(Path(folder) / str(k))
        claimed = {slow: {test for m in mutants if m.slow is slow for test in m.tests} for slow in (False, True)}
        console.print(f"{len(mutants)} faults; the tests that claim them run without any first ...")
        for slow, tests in claimed.items():
            marked = ("not slow", "slow or not slow")[slow]
            status, printed = run_tests((*sorted(tests), "-n", str(asked.jobs)), Path(folder) / "0", marked) if tests else (0, "")
            if status != 0:
                console.print("\n".join(printed.splitlines()[-15:]), markup=False)
                console.print("They do not pass where nothing is changed: mend that first.")
                return 1
        if asked.unmutated:
            return 0
        ROWS.parent.mkdir(exist_ok=True)
        with Progress(console=console) as progress, ROWS.open("w", encoding="utf-8") as out, ThreadPoolExecutor(asked.jobs) as pool:
            task = progress.add_task("faults", total=len(mutants))
            for done in as_completed([pool.submit(try_mutant, mutant, trees) for mutant in mutants]):
                rows.append(done.result())
                out.write(json.dumps(rows[-1]) + "\n")
                out.flush()
                if rows[-1]["result"] != "killed":
                    progress.console.print(f"{rows[-1]['result']}: {rows[-1]['file']}: {rows[-1]['now']}", markup=False)
                    progress.console.print("\n".join(rows[-1].get("printed", [])), markup=False)
                progress.advance(task)
    table = Table("room", "faults", "killed", "survived", "not run", "need a GPU", "seconds")
    for room in sorted({m.room for m in every}):
        mine = [row for row in rows if row["room"] == room]
        ends = [sum(row["result"] == end for row in mine) for end in ("killed", "survived", "not run")]
        waiting = sum(m.room == room and m.gpu and not has_gpu for m in every)
        table.add_row(room, str(len(mine)), *map(str, ends), str(waiting), f"{sum(row['seconds'] for row in mine):.0f}")
    console.print(table)
    return int(any(row["result"] != "killed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
