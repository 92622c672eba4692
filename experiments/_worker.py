"""One row in a process of its own: `python -m experiments._worker`, a task as JSON on stdin, its answer as JSON on stdout."""

import ctypes
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments import _layouts, _machine, methods
from experiments._config import Spec

if TYPE_CHECKING:
    from jfrnn.cases import Scene  # pyright: ignore[reportMissingImports]


def main() -> None:
    """Do the task of stdin. Whatever else is printed, by kernels too, goes to stderr."""
    _end_with_parent()
    answer_stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    task = json.load(sys.stdin)
    answer = _answer(task)
    with answer_stream:
        json.dump(answer, answer_stream, allow_nan=False)


def _answer(task: dict[str, Any]) -> dict[str, Any]:
    """Do a task: {"do": "oracle" or "measure", "spec", "oracle": folder}, or {"do": "sum" or "sph", "spec"}."""
    if task["do"] == "sum":
        from experiments import _ways

        return _ways.measure(_ways.Spec(**task["spec"]))
    if task["do"] == "sph":
        from experiments.sph import tradeoff

        return tradeoff.measure(tradeoff.Spec(**task["spec"]))
    spec, folder = Spec(**task["spec"]), Path(task["oracle"])
    return prepare_oracle(spec, folder) if task["do"] == "oracle" else measure(spec, folder)


def prepare_oracle(spec: Spec, folder: Path) -> dict[str, Any]:
    """Leave the exact pairs of the scene in the folder."""
    from experiments import _oracle

    scene = make_scene(spec)
    return {"pairs": len(_oracle.load_pairs(scene.positions, scene.cutoff, folder))}


def measure(spec: Spec, folder: Path) -> dict[str, Any]:
    """Return the fields of the row that this process can know; a failure is a field too."""
    try:
        adapter = methods.load(spec.method)
    except ImportError as error:
        return {"status": "missing", "reason": f"{spec.method} cannot be imported: {error}"}
    row: dict[str, Any] = {"versions": _machine.versions(getattr(adapter, "PACKAGES", ()))}
    try:
        scene = make_scene(spec)
        row |= {"fill": scene.fill, "points": len(scene.positions)}
        limit = getattr(adapter, "MAX_POINTS", None)
        if limit is not None and len(scene.positions) > limit:
            return row | {"status": "skipped", "reason": f"{len(scene.positions)} points; {spec.method} is run up to {limit}"}
        _measure_search(adapter, spec, scene, folder, row)
        row["status"] = "ok"
    except Exception as error:  # whatever a method raises is the result of its row
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {error}"}
    return row


def make_scene(spec: Spec) -> "Scene":
    """Return the scene of a row."""
    options = {"spacing": spec.spacing, "cutoff_ratio": spec.cutoff_ratio, "dtype": spec.dtype, "dim": spec.dim, "seed": spec.seed}
    return _layouts.make(spec.layout, **options, **({} if spec.fill is None else {"fill": spec.fill}))


def _measure_search(adapter: methods.Adapter, spec: Spec, scene: "Scene", folder: Path, row: dict[str, Any]) -> None:
    """Time the search, then compare what it found; fill the row as far as it comes."""
    from experiments import _compare, _measure, _oracle

    positions, cutoff = scene.positions, _oracle.round_cutoff(scene.cutoff, scene.positions.dtype)
    row["cutoff"] = cutoff
    memory = _measure.PeakMemory()
    search = _prepare(adapter, positions, cutoff, row)
    prepared_peak = memory.peak()

    searching = _measure.PeakMemory()
    _, [row["first_s"]] = _measure.repeat(search, 1, 0.0, 1)
    bystanders = _measure.Bystanders()
    result, seconds = _measure.repeat(search, spec.repeats, spec.min_seconds, spec.max_repeats)
    row["others_cores"] = bystanders.cores()
    peak = searching.peak()

    found = adapter.read(result)
    row |= _measure.summarize(seconds) | {"list_bytes": found.list_bytes, "device": found.device, "parts": found.parts}
    row |= {"peak_bytes": max(prepared_peak, peak) - memory.start, "memory_source": searching.source}
    if searching.source == "VmHWM":
        taken = max(peak - searching.start, found.list_bytes)  # a small list may fit into pages that were there before
        row |= {"search_bytes": taken, "scratch_bytes": taken - found.list_bytes}
    row |= _compare.compare(found, _oracle.load_pairs(positions, cutoff, folder), len(positions))


def _prepare(adapter: methods.Adapter, positions: np.ndarray, cutoff: float, row: dict[str, Any]) -> Callable[[], Any]:
    """Do what the adapter does once, and note how long that takes."""
    capacity = ()
    if allocate := getattr(adapter, "allocate", None):
        begin = perf_counter()
        capacity = (allocate(positions, cutoff),)
        row["allocate_s"] = perf_counter() - begin
    begin = perf_counter()
    search = adapter.prepare(positions, cutoff, *capacity)
    row["compile_s"] = perf_counter() - begin
    return search


def _end_with_parent() -> None:
    """Ask the system, where it is Linux, to end this process with the runner: a killed sweep leaves nothing that runs on."""
    if sys.platform == "linux":
        set_death_signal = 1  # PR_SET_PDEATHSIG of linux/prctl.h
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


if __name__ == "__main__":
    main()
