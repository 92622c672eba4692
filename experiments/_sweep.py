"""The sweep: a process per row, each row on disk before the next one starts."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from experiments import _machine, methods
from experiments._config import Config, Spec, digest
from experiments._errors import UsageError
from experiments._forecast import Forecast, in_words
from experiments._rows import RETRIED, SCENE_FIELDS, Row, RowFile
from experiments._worker import RUNNER

ROOT = Path(__file__).resolve().parent.parent
REASON_LENGTH = 600


def run(config: Config, name: str, folder: Path, retry_failed: bool = False, shard: tuple[int, int] = (1, 1)) -> list[Row]:
    """Measure every row of the config that the folder does not hold yet, and return all rows of the config.

    Args:
        config: The sweep.
        name: Name of the config, kept in the rows.
        folder: Holds rows.jsonl and the exact pairs.
        retry_failed: Whether rows that are missing, failed or ran out of time are measured again.
        shard: (k, n): only every n-th scene from the k-th on, with all its methods and processes, which are to be compared.
    """
    file = RowFile(folder)
    with file.locked():
        file.repair()
        return _run(config, name, file, retry_failed, shard)


def shard_specs(specs: Iterable[Spec], shard: tuple[int, int]) -> list[Spec]:
    """Return the rows of every n-th scene from the k-th on; shards of all k are the whole, and none has a row of another."""
    part, parts = shard
    specs = list(specs)
    scenes = {key: number for number, key in enumerate(dict.fromkeys(spec.scene_key for spec in specs))}
    return [spec for spec in specs if scenes[spec.scene_key] % parts == part - 1]


def _run(config: Config, name: str, file: RowFile, retry_failed: bool, shard: tuple[int, int]) -> list[Row]:
    """Do the work of `run` with the file of rows at hand."""
    folder, specs = file.path.parent, shard_specs(config.specs(), shard)
    rows = {row.key: row for row in file.read() if not (retry_failed and row.status in RETRIED)}
    pending = [spec for spec in specs if (row := rows.get(spec.key)) is None or spec.cut_short(row)]
    about = {"machine": _machine.machine(), **_machine.commit(), "config": name, "config_hash": config.hash}
    forecast, scene, prepared, absent = Forecast(pending, rows.values()), None, set(), {}
    with progress(len(specs)) as shown:
        bar = shown.add_task("", total=len(specs), completed=len(specs) - len(pending))
        _announce(shown.console, specs, pending, forecast)
        for done, spec in enumerate(pending):
            begin, left = perf_counter(), f"left: {in_words(forecast.left(pending[done:]))}"
            if spec.scene_key != scene:
                scene = spec.scene_key
                shown.console.print(f"{spec.scene_name}: {done} of {len(pending)} rows measured, {left}", highlight=False)
            if scene not in prepared:
                prepared.add(scene)
                shown.update(bar, description=f"{left} · {spec.scene_name} · exact pairs")
                _prepare_oracle(spec, folder, shown.console)
            shown.update(bar, description=f"{left} · {spec.scene_name} · {spec.method}")
            row = replace(measure(spec, folder, absent.get(spec.method)), **about)
            forecast.note(spec, perf_counter() - begin)
            file.append(row)
            if spec.method not in absent:
                shown.console.print(describe(row), highlight=False, markup=False, soft_wrap=True)
            if row.status == "missing":
                absent[spec.method] = {"status": row.status, "reason": row.reason}  # it will not appear while this runs
            shown.advance(bar)
    keys = {spec.key for spec in specs}
    return [row for row in file.read() if row.key in keys]


def _announce(console: Console, specs: list[Spec], pending: list[Spec], forecast: Forecast) -> None:
    """Say what is there, what is not installed, and how long the rest will take."""
    if len(pending) < len(specs):
        console.print(f"{len(specs) - len(pending)} of {len(specs)} rows are there already")
    if forecast.absent:
        count = sum(spec.method in forecast.absent for spec in pending)
        names = f"{', '.join(forecast.absent)} ({methods.HOW_TO_INSTALL})"
        console.print(f"not installed, so that {count} rows will have no figures: {names}", highlight=False, markup=False)
    if pending:
        console.print(f"{len(pending)} rows to measure: {in_words(forecast.left(pending))}", highlight=False, markup=False)


@contextmanager
def progress(total: int) -> Iterator[Progress]:
    """Show a bar on stderr."""
    columns = (BarColumn(16), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True, force_jupyter=False), disable=total == 0) as shown:
        yield shown


def _prepare_oracle(spec: Spec, folder: Path, console: Console) -> None:
    """Find the exact pairs of a scene before its rows run, so that no row's time limit pays for them; once per folder."""
    there = folder / "oracle" / f"{digest(spec.scene_key)}.there"
    if there.exists():
        return
    answer = ask(_task("oracle", spec, folder), spec.timeout)
    if "reason" in answer:
        console.print(f"{spec.scene_name}: no exact pairs: {answer['reason']}", highlight=False, markup=False)
    else:
        there.touch()


def measure(spec: Spec, folder: Path, known: dict[str, Any] | None = None) -> Row:
    """Measure one row in a fresh process; never raises for what happens there.

    The first process of a row compiles its kernels, which is timed; the others take them from the folder.

    Args:
        spec: The row.
        folder: Holds the exact pairs, and kernels.
        known: What the process would answer, where that is known without it.
    """
    kernels = None if spec.process == 0 else folder.resolve() / "kernels"
    answer = known or ask(_task("measure", spec, folder), spec.timeout, kernels=kernels)
    asked = {"layout": spec.layout, "method": spec.method, "fill_asked": spec.fill, "process": spec.process}
    asked |= {name: getattr(spec, name) for name in SCENE_FIELDS}
    return Row(key=spec.key, **asked, **answer, time=datetime.now(UTC).isoformat(timespec="seconds"))


def _task(do: str, spec: Spec, folder: Path) -> dict[str, Any]:
    return {"do": do, "spec": asdict(spec), "oracle": str(folder.resolve() / "oracle")}


def ask(task: dict[str, Any], timeout: float, *, cold: bool = True, kernels: Path | None = None) -> dict[str, Any]:
    """Let a worker do a task and return its answer, or a status with the reason why there is none.

    Args:
        task: See `experiments._worker`.
        timeout: The worker is ended after this time [s].
        cold: Kernels are compiled anew: a compile time from a warm cache would mean nothing.
        kernels: Take kernels from this folder, and leave them there, instead.
    """
    with tempfile.TemporaryDirectory() as cache:
        where = {"WARP_CACHE_PATH": str(kernels or cache), "JAX_ENABLE_COMPILATION_CACHE": "false"}
        # one pool from the start, see `_gpu.run`: else peaks on a GPU are those of whole pieces
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
    return {"status": "failed", "reason": _explain_exit(done.returncode, done.stderr)}


def _explain_exit(code: int, stderr: str) -> str:
    """Say how a process ended that gave no answer."""
    how = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return f"the process {how}: {stderr.strip()[-REASON_LENGTH:]}"


def merge(folder: Path, parts: Iterable[Path]) -> int:
    """Add to a folder the rows of others that it does not hold, and return how many came.

    Of one key, a row that is ok counts, and among those the one with more repeats.

    Raises:
        UsageError: There are no parts, a part has no rows, or a line of it is no row.
    """
    file, came, parts = RowFile(folder), 0, list(parts)
    if not parts:
        raise UsageError(f"{folder}: no folders shard-K-of-N in it; name the folders whose rows are to go there")
    with file.locked():
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


def _worth(row: Row) -> tuple[bool, int]:
    """Return what makes a row count before another of its key: that there need not be a next one, and its repeats."""
    return row.status not in RETRIED, len(row.seconds)


def count_results(rows: list[Row]) -> str:
    """Say how many rows have a result, and why the others have none."""
    statuses = Counter(row.status for row in rows)
    good = statuses.pop("ok", 0)
    others = ", ".join(f"{count} {status}" for status, count in statuses.items())
    return f"{good} of {len(rows)} rows ok" + (f", {len(rows) - good} without a result ({others})" if others else "")


def describe(row: Row) -> str:
    """Return a row as a line for the reader."""
    start = f"{row.scene_name:<17} {row.method:<20} {row.status:<8}"
    if row.status != "ok":
        return f"{start}{row.reason}"
    memory = (row.peak_bytes if row.search_bytes is None else row.search_bytes) or 0
    return f"{start}{row.median_s:9.4f} s {memory / 1e6:8.1f} MB {row.pairs:>10} pairs, {row.missing} missing, {row.extra} extra"
