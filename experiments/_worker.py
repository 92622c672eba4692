"""One row in a process of its own: `python -m experiments._worker`, a task as JSON on stdin, its answer as JSON on stdout."""

import json
import os
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

from experiments import _layouts, _machine, methods
from experiments._config import Spec


def main() -> None:
    """Do the task of stdin. Whatever else is printed, by kernels too, goes to stderr."""
    answer_stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    task = json.load(sys.stdin)
    spec, folder = Spec(**task["spec"]), Path(task["oracle"])
    answer = prepare_oracle(spec, folder) if task["do"] == "oracle" else measure(spec, folder)
    with answer_stream:
        json.dump(answer, answer_stream, allow_nan=False)


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


def make_scene(spec: Spec) -> Any:
    """Return the scene of a row."""
    options = {"spacing": spec.spacing, "cutoff_ratio": spec.cutoff_ratio, "dtype": spec.dtype, "dim": spec.dim, "seed": spec.seed}
    return _layouts.make(spec.layout, **options, **({} if spec.fill is None else {"fill": spec.fill}))


def _measure_search(adapter: methods.Adapter, spec: Spec, scene: Any, folder: Path, row: dict[str, Any]) -> None:
    """Time the search, then compare what it found; fill the row as far as it comes."""
    from experiments import _compare, _measure, _oracle

    positions, cutoff = scene.positions, _oracle.round_cutoff(scene.cutoff, scene.positions.dtype)
    row["cutoff"] = cutoff
    del scene  # it holds the positions in float64 too, and the start counts what is there
    memory = _measure.PeakMemory()
    begin = perf_counter()
    search = adapter.prepare(positions, cutoff)
    row |= {"compile_s": perf_counter() - begin, "compile_peak_bytes": memory.peak(), "memory_source": memory.source}

    _, [row["first_s"]] = _measure.repeat(search, 1, 0.0, 1)
    result, seconds = _measure.repeat(search, spec.repeats, spec.min_seconds, spec.max_repeats)
    row |= _measure.summarize(seconds) | {"peak_bytes": memory.peak()}

    found = adapter.read(result)
    row |= {"list_bytes": found.list_bytes, "scratch_bytes": max(row["peak_bytes"] - found.list_bytes, 0), "device": found.device}
    row |= _compare.compare(found, _oracle.load_pairs(positions, cutoff, folder), len(positions))


if __name__ == "__main__":
    main()
