"""One row in a process of its own: `python -m experiments._worker`, a task as JSON on stdin, its answer as JSON on stdout."""

import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import psutil

from cases import Scene
from experiments import _accuracy, _compare, _layouts, _machine, _measure, _oracle, methods
from experiments._config import Spec

RUNNER = "JFRNN_RUNNER"  # environment variable: the process that asks, which this one is not to survive
MOST_MEMORY = 0.8  # of the machine; a method that wants more gets an error instead of taking the machine down


def main() -> None:
    """Do the task of stdin. Whatever else is printed, by kernels too, goes to stderr."""
    _end_with_parent()
    _limit_memory()
    answer_stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    task = json.load(sys.stdin)
    answer = _answer(task)
    with answer_stream:
        json.dump(answer, answer_stream, allow_nan=False)


def _answer(task: dict[str, Any]) -> dict[str, Any]:
    """Do a task: {"do": "oracle" or "measure", "spec", "oracle": folder}, or {"do": "sum", "spec"}."""
    if task["do"] == "sum":
        from experiments.bench import ways

        return ways.measure(task["spec"])
    spec, folder = Spec(**task["spec"]), Path(task["oracle"])
    return prepare_oracle(spec, folder) if task["do"] == "oracle" else measure(spec, folder)


def prepare_oracle(spec: Spec, folder: Path) -> dict[str, Any]:
    """Leave the exact pairs of the scene in the folder; of a large one, those of a sample."""
    scene = make_scene(spec)
    if (n := len(scene.positions)) > _compare.MOST_LISTED:
        _oracle.load_sample(scene.positions, scene.cutoff, _compare.sample(n), folder)
        return {"pairs": None}
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


def make_scene(spec: Spec) -> Scene:
    """Return the scene of a row."""
    options = {name: getattr(spec, name) for name in ("spacing", "cutoff_ratio", "dtype", "dim", "seed", "fill", "angle", "growth")}
    scene = _layouts.make(spec.layout, **options)
    return _layouts.order_scene(scene, spec.order, spec.seed)


def _measure_search(adapter: methods.Adapter, spec: Spec, scene: Scene, folder: Path, row: dict[str, Any]) -> None:
    """Time the search, then compare what it found; fill the row as far as it comes."""
    positions, cutoff = scene.positions, _oracle.round_cutoff(scene.cutoff, scene.positions.dtype)
    row["cutoff"], whole = cutoff, _measure.Bystanders()
    device = _measure.DeviceMemory()
    memory = _measure.PeakMemory()
    search, capacity = _prepare(adapter, spec, positions, cutoff, row)
    prepared_peak = memory.peak()

    searching = _measure.PeakMemory()
    steps = getattr(adapter, "STEPS", 1)
    bystanders = _measure.Bystanders()
    result, seconds = _measure.repeat(search, 1, 0.0, 1)
    row["first_s"] = seconds[0] / steps
    peak, row["device_bytes"] = searching.peak(), device.peak()  # of one search: JAX may free its result during the next
    if spec.max_repeats > 1:  # else one run takes minutes, and is the only one
        del result
        bystanders = _measure.Bystanders()
        result, seconds = _measure.repeat(search, spec.repeats, spec.min_seconds, spec.max_repeats, spec.most_seconds)
    row["others_cores"] = bystanders.cores()
    if row["others_cores"] is None:  # too short to tell: what others did from the start of the row on tells more than nothing
        row["others_cores"] = whole.cores()

    found = adapter.read(result)
    row |= _measure.summarize([second / steps for second in seconds])
    row |= {"list_bytes": found.list_bytes, "device": found.device, "parts": found.parts, "rebuilt": found.rebuilt}
    row |= {"peak_bytes": max(prepared_peak, peak) - memory.start, "memory_source": searching.source}
    taken = peak - searching.start if searching.source == "VmHWM" else None
    if row["device_bytes"] is not None:
        taken, row["memory_source"] = row["device_bytes"], "device"
    if taken is not None:
        taken = max(taken, found.list_bytes)  # a small list may fit into pages that were there before
        row |= {"search_bytes": taken, "scratch_bytes": taken - found.list_bytes}
    del result
    if spec.process == 0 and (plan := getattr(adapter, "plan", None)):
        planned = plan(positions, cutoff, *capacity)
        row |= {"planned_list_bytes": planned.result_bytes, "planned_scratch_bytes": planned.scratch_bytes}
    _judge(found, spec, positions if found.positions is None else found.positions, cutoff, folder, row)


def _judge(found: methods.Found, spec: Spec, positions: np.ndarray, cutoff: float, folder: Path, row: dict[str, Any]) -> None:
    """Compare what was found with the exact pairs, and in the first process sums over it with exact ones."""
    if (n := len(positions)) > _compare.MOST_LISTED:
        rows = _compare.sample(n)
        row |= _compare.compare_sample(found, _oracle.load_sample(positions, cutoff, rows, folder), rows, n)
        return
    exact = _oracle.load_pairs(positions, cutoff, folder) if found.positions is None else _oracle.find_pairs(positions, cutoff)
    row |= _compare.compare(found, exact, n)
    if spec.process == 0:
        row |= _accuracy.errors(found, row, exact, positions, cutoff)


def _prepare(
    adapter: methods.Adapter, spec: Spec, positions: np.ndarray, cutoff: float, row: dict[str, Any]
) -> tuple[Callable[[], Any], tuple[Any, ...]]:
    """Do what the adapter does once, and note how long that takes; return the search, and the capacity it was prepared for."""
    if follow := getattr(adapter, "follow", None):
        begin = perf_counter()
        search = follow(positions, cutoff, spec.motion * spec.spacing)
        row["compile_s"] = perf_counter() - begin
        return search, ()
    capacity = ()
    if allocate := getattr(adapter, "allocate", None):
        begin = perf_counter()
        capacity = (allocate(positions, cutoff),)
        row["allocate_s"] = perf_counter() - begin
    begin = perf_counter()
    search = adapter.prepare(positions, cutoff, *capacity)
    row["compile_s"] = perf_counter() - begin
    return search, capacity


def _limit_memory() -> None:
    """Keep this process below a share of the machine's memory; not where a GPU's driver reserves addresses without end."""
    if not Path("/dev/nvidiactl").exists():
        most = int(MOST_MEMORY * psutil.virtual_memory().total)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _end_with_parent() -> None:
    """Ask the system, where it is Linux, to end this process with the runner: a killed sweep leaves nothing that runs on."""
    if sys.platform == "linux":
        set_death_signal = 1  # PR_SET_PDEATHSIG of linux/prctl.h
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
        if os.environ.get(RUNNER, str(os.getppid())) != str(os.getppid()):
            sys.exit("the runner ended before this process had begun")  # no signal will tell


if __name__ == "__main__":
    main()
