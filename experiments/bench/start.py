"""What a newcomer waits for: fresh processes from the first import to the first result, with and without compiled kernels."""

import compileall
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import numpy as np
import pandas as pd
import typer

from experiments import _machine, _measure
from experiments._errors import UsageError
from experiments.bench import fresh, table

WHAT = ("search", "gradient")
PARTS = ("import_jax_s", "array_s", "import_jfrnn_s", "first_s", "again_s", "process_s")
COLUMNS = (
    *("platform", "who", "what", "cache", "repeat", "wait_s", *PARTS, "said_lines", "answer", "status", "reason"),
    *("others_cores", "device", "jax", "warp", "commit", "dirty"),
)
ROOT = Path(__file__).resolve().parents[2]
_MOST_S = 300  # of a process


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "start",
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Fresh processes of each.")] = 3,
    before: Annotated[Path | None, typer.Option(help="Another checkout, measured in turns with this one.")] = None,
) -> str:
    """Time fresh processes up to their first search of 1000 particles, and up to their first pair_sum with its gradient.

    `wait_s` is the time from `import jfrnn` to the first result, after `import jax` and its first array; `again_s` that of a second
    call, of other shapes. The folder of kernels is empty ("cold"), or holds what another process compiled ("warm"). Medians [s].
    """
    if before is not None and not (before / "jfrnn" / "__init__.py").is_file():
        raise UsageError(f"--before {before}: is no checkout of this project; there is no jfrnn/__init__.py")
    checkouts = {"jfrnn": ROOT} if before is None else {"before": before.resolve(), "after": ROOT}
    # the memory of a device is for the processes that are measured
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    parts = [
        (f"{what} {who} {repeat + 1}", partial(_rows, what, who, checkout, repeat))
        for repeat, what, (who, checkout) in itertools.product(range(repeats), WHAT, checkouts.items())
    ]
    commits = [_machine.commit(checkout) for checkout in checkouts.values()]
    frame = table.measure(out, f"start_{jax.default_backend()}", parts, commits, COLUMNS)
    return table.text(_summarize(frame))


def _rows(what: str, who: str, checkout: Path, repeat: int) -> Iterator[table.Line]:
    for row in run_twice(what, checkout):
        waited = {"wait_s": row["import_jfrnn_s"] + row["first_s"]} if row["status"] == "ok" else {}
        yield {"who": who, "what": what, "repeat": repeat} | row | waited


def run_twice(asked: str, checkout: Path, more: dict[str, str] | None = None) -> Iterator[table.Line]:
    """Yield the rows of two processes, see `run`: of the first, and of the next, which finds the kernels of the first."""
    with tempfile.TemporaryDirectory() as name:
        packages, kernels = Path(name) / "packages", Path(name) / "kernels"
        kernels.mkdir()
        link(checkout, packages)
        for cache in ("cold", "warm"):
            row = run(asked, packages, kernels, more) | {"cache": cache, **_machine.commit(checkout)}
            yield row | {"kernels": sum(1 for _ in kernels.rglob("*.o"))}


def link(checkout: Path, packages: Path) -> None:
    """Make a folder that holds the library of a checkout as an installation does: kernels and cases are packages of it."""
    (packages / "jfrnn").mkdir(parents=True)
    parts = {part.name: part for part in (checkout / "jfrnn").iterdir()}
    for name, part in (parts | {name: checkout / name for name in ("kernels", "cases")}).items():
        (packages / "jfrnn" / name).symlink_to(part)
    for name in ("jfrnn", "kernels", "cases"):  # as an installation does: no process waits for bytecode
        compileall.compile_dir(checkout / name, quiet=2)


def run(asked: str, packages: Path, kernels: Path, more: dict[str, str] | None = None) -> table.Line:
    """Run `fresh` in a process that takes the library from a folder of `link` and keeps kernels in another; return what it says.

    Where the library takes a slower engine than it would choose, it warns, and the process fails.
    """
    not_given = ("XLA_PYTHON_CLIENT_PREALLOCATE", "JAX_COMPILATION_CACHE_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in not_given}
    paths = os.pathsep.join(filter(None, (str(packages), os.environ.get("PYTHONPATH"))))  # Warp may stand where the user says
    environment |= {"PYTHONPATH": paths, "WARP_CACHE_PATH": str(kernels), "CUDA_CACHE_PATH": str(kernels / "cuda")}
    environment |= more or {}
    words = [sys.executable, "-P", "-W", "error::RuntimeWarning", fresh.__file__, asked]
    begin, bystanders = perf_counter(), _measure.Bystanders()
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment, cwd=kernels, timeout=_MOST_S)
    except subprocess.TimeoutExpired:
        return {"status": "timeout", "reason": f"no result in {_MOST_S} s"}
    seconds, lines, others = perf_counter() - begin, done.stdout.splitlines(), bystanders.cores()
    if done.returncode != 0:
        return {"status": "failed", "reason": " ".join(done.stderr.split())[-300:]}
    row: dict[str, Any] = json.loads(lines[-1])
    row |= {"process_s": seconds, "said_lines": len(lines) - 1}
    return row | {"others_cores": None if others is None else round(others, 2), "status": "ok"}


def _summarize(frame: pd.DataFrame) -> pd.DataFrame:
    """Return medians over repeats; where there are two checkouts, also how long this one lets wait beside the other."""
    names = ["what", "cache", "who"]
    done = frame[frame["status"] == "ok"].astype(dict.fromkeys(("wait_s", *PARTS, "said_lines"), float))
    groups = done.groupby(names, sort=False)
    medians = (
        groups[["wait_s", *PARTS]].median().assign(processes=groups.size(), said_lines=groups["said_lines"].max()).reset_index()
    )
    if "before" in set(medians["who"]):
        first = medians[medians["who"] == "before"].set_index(names[:2])["wait_s"]
        medians["ratio"] = medians["wait_s"] / [
            first.get(key, np.nan) for key in zip(medians["what"], medians["cache"], strict=True)
        ]
    reasons = pd.DataFrame({"what": frame["status"] + ": " + frame["reason"]}).dropna().drop_duplicates()
    return pd.concat([medians, reasons]) if len(reasons) else medians
