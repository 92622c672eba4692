"""The sweep: a process per row, each row on disk before the next one starts."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from experiments import methods
from experiments._config import Config, Spec, digest
from experiments._errors import UsageError
from experiments._loop import Shown, Task, fill
from experiments._rows import RETRIED, SCENE_FIELDS, RowFile, SearchRow
from experiments._worker import RUNNER

ROOT = Path(__file__).resolve().parent.parent
REASON_LENGTH = 600


def run(config: Config, name: str, folder: Path, retry_failed: bool = False, shard: tuple[int, int] = (1, 1)) -> list[SearchRow]:
    """Measure every row of the config that the folder does not hold yet, and return all rows of the config.

    The folder holds rows.jsonl, and until all rows are there the exact pairs. With `retry_failed`, rows that are missing, failed or
    ran out of time are measured again. Of a shard (k, n), rows are those of every n-th scene from the k-th on, with all its
    methods and processes, which are to be compared.
    """
    sweep, specs = _Sweep(folder), shard_specs(config.specs(), shard)
    sweep.tasks = {
        spec.key: (spec, Task((spec.key,), spec.scene_name, partial(sweep.measure, spec), spec.is_cut_short)) for spec in specs
    }
    about, tasks = {"config": name, "config_hash": config.hash}, [task for _, task in sweep.tasks.values()]
    rows = fill(RowFile(folder), tasks, sweep.describe, retry_failed=retry_failed, about=about, begin=sweep.begin)
    for name in ("oracle", "kernels"):  # hundreds of megabytes, which a later round makes anew
        shutil.rmtree(folder / name, ignore_errors=True)
    return rows


def shard_specs(specs: Iterable[Spec], shard: tuple[int, int]) -> list[Spec]:
    """Return the rows of every n-th scene from the k-th on; shards of all k are the whole, and none has a row of another."""
    part, parts = shard
    specs = list(specs)
    scenes = {key: number for number, key in enumerate(dict.fromkeys(spec.scene_key for spec in specs))}
    return [spec for spec in specs if scenes[spec.scene_key] % parts == part - 1]


class _Sweep:
    """What a sweep knows while it runs: which scene is measured, and which methods are not there."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.tasks = folder, {}
        self._scene, self._prepared, self._absent = None, set(), {}

    def begin(self, left: list[Task[SearchRow]], shown: Shown) -> None:
        """Say what is not installed."""
        self.pending = [self.tasks[task.keys[0]][0] for task in left]
        self.done = 0
        if absent := [name for name in dict.fromkeys(spec.method for spec in self.pending) if methods.lacks(name)]:
            count = sum(spec.method in absent for spec in self.pending)
            names = f"{', '.join(absent)} ({methods.HOW_TO_INSTALL})"
            shown.say(f"not installed, so that {count} rows will have no figures: {names}")

    def measure(self, spec: Spec, shown: Shown) -> Iterator[SearchRow]:
        """Measure a row in a process of its own."""
        if spec.scene_key != self._scene:
            self._scene = spec.scene_key
            shown.say(f"{spec.scene_name}: {self.done} of {len(self.pending)} rows measured")
        if spec.scene_key not in self._prepared:
            self._prepared.add(spec.scene_key)
            shown.label(f"{spec.scene_name} · exact pairs")
            _prepare_oracle(spec, self.folder, shown)
        shown.label(f"{spec.scene_name} · {spec.method}")
        row = measure(spec, self.folder, self._absent.get(spec.method))
        self.done += 1
        yield row

    def describe(self, row: SearchRow) -> str | None:
        """Return a row as a line for the reader; of a method that is not there, only the first time."""
        text = None if row.method in self._absent else describe(row)
        if row.status == "missing":
            self._absent[row.method] = {"status": row.status, "reason": row.reason}  # it will not appear while this runs
        return text


def _prepare_oracle(spec: Spec, folder: Path, shown: Shown) -> None:
    """Find the exact pairs of a scene before its rows run, so that no row's time limit pays for them; once per folder."""
    there = folder / "oracle" / f"{digest(spec.scene_key)}.there"
    if there.exists():
        return
    answer = ask(_task("oracle", spec, folder), spec.timeout)
    if "reason" in answer:
        shown.say(f"{spec.scene_name}: no exact pairs: {answer['reason']}")
    else:
        there.touch()


def measure(spec: Spec, folder: Path, known: dict[str, Any] | None = None) -> SearchRow:
    """Measure one row in a fresh process, or as is `known` without it; never raises for what happens there.

    The first process of a row compiles its kernels, which is timed; the others take them from the folder.
    """
    kernels = None if spec.process == 0 else folder.resolve() / "kernels"
    answer = known or ask(_task("measure", spec, folder), spec.timeout, kernels=kernels)
    asked = {"layout": spec.layout, "method": spec.method, "fill_asked": spec.fill, "process": spec.process}
    asked |= {name: getattr(spec, name) for name in SCENE_FIELDS}
    return SearchRow(key=spec.key, **asked, **answer)


def _task(do: str, spec: Spec, folder: Path) -> dict[str, Any]:
    return {"do": do, "spec": asdict(spec), "oracle": str(folder.resolve() / "oracle")}


def ask(task: dict[str, Any], timeout: float, *, cold: bool = True, kernels: Path | None = None) -> dict[str, Any]:
    """Let a worker do a task and return its answer, or a status with the reason why there is none, after the timeout [s] at last.

    `cold`: kernels are compiled anew, as a compile time from a warm cache would mean nothing; or they are taken from a folder, and
    left there.
    """
    with tempfile.TemporaryDirectory() as cache:
        where = {"WARP_CACHE_PATH": str(kernels or cache), "JAX_ENABLE_COMPILATION_CACHE": "false"}
        # one pool from the start, see `bench.gpu`: else peaks on a GPU are those of whole pieces
        environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "true", RUNNER: str(os.getpid())} | (where if cold else {})
        command = [sys.executable, "-m", "experiments._worker"]
        try:
            done = subprocess.run(
                command, input=json.dumps(task), capture_output=True, text=True, cwd=ROOT, env=environment, timeout=timeout
            )
        except subprocess.TimeoutExpired:
            return {"status": "timeout", "reason": f"not done after {timeout:g} s"}
    if done.returncode == 0:
        return json.loads(done.stdout)
    code = done.returncode
    how = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return {"status": "failed", "reason": f"the process {how}: {done.stderr.strip()[-REASON_LENGTH:]}"}


def merge(folder: Path, parts: Iterable[Path]) -> int:
    """Add to a folder the rows of others that it does not hold, and return how many came; refuse parts without rows.

    Among rows of one key, a row that is ok counts, and among those the one with more repeats.
    """
    file, came, parts = RowFile(folder), 0, list(parts)
    if not parts:
        raise UsageError(f"{folder}: no folders shard-K-of-N in it; name the folders whose rows are to go there")
    with file.lock():
        file.repair()
        rows = {row.key: row for row in file.read()}
        for part in parts:
            theirs = RowFile(part).read()
            if not theirs:
                raise UsageError(f"{part}: no rows to merge; name a folder that a sweep has filled")
            for row in theirs:
                here = rows.get(row.key)
                if here is None or _worth(row) > _worth(here):
                    rows[row.key] = row
                    file.append(row)
                    came += 1
    return came


def _worth(row: SearchRow) -> tuple[bool, int]:
    """Return what makes a row count before another of its key: that there need not be a next one, and its repeats."""
    return row.status not in RETRIED, len(row.seconds)


def count_results(rows: list[SearchRow]) -> str:
    """Say how many rows have a result, and why the others have none."""
    statuses = Counter(row.status for row in rows)
    good = statuses.pop("ok", 0)
    others = ", ".join(f"{count} {status}" for status, count in statuses.items())
    return f"{good} of {len(rows)} rows ok" + (f", {len(rows) - good} without a result ({others})" if others else "")


def describe(row: SearchRow) -> str:
    """Return a row as a line for the reader."""
    start = f"{row.scene_name:<17} {row.method:<20} {row.status:<8}"
    if row.status != "ok":
        return f"{start}{row.reason}"
    memory = (row.peak_bytes if row.search_bytes is None else row.search_bytes) or 0
    return f"{start}{row.median_s:9.4f} s {memory / 1e6:8.1f} MB {row.pairs:>10} pairs, {row.missing} missing, {row.extra} extra"
