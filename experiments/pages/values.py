"""Single figures in running text, made from rows: in a page `<!-- value NAME -->` stands before one, `<!-- end -->` behind it."""

import json
from collections.abc import Callable
from functools import partial

from experiments.pages.rows import RESULTS, number, one, read, whole
from jfrnn.cases.batches import BATCH_CASES
from jfrnn.cases.hard import HARD_CASES
from jfrnn.cases.periodic import PERIODIC_CASES
from jfrnn.cases.radii import RADII_CASES
from jfrnn.cases.triangles import TRIANGLE_CASES

_CASES = {"hard": HARD_CASES, "periodic": PERIODIC_CASES, "radii": RADII_CASES, "batches": BATCH_CASES, "triangles": TRIANGLE_CASES}


def _bytes_per_particle(method: str) -> str:
    """Return the peak of the device's memory at a hundred million particles [B per particle]."""
    rows = [row for row in read("h200_size/table.csv") if row["method"] == method and row["status"] == "ok"]
    row = max(rows, key=lambda row: int(row["points"]))
    return number(1e6 * float(row["device_mb"]) / int(row["points"]), digits=2)


def _decided() -> str:
    """Return how many hard cases were decided on a GPU after later changes of kernels, if none was wrong."""
    rows = [row for row in read("h200/decided_again.jsonl") if row["kind"] == "exactness"]
    wrong = sum(row["wrong"] for row in rows)
    return f"{whole(sum(row['cases'] for row in rows))} decisions, {wrong or 'none'} wrong"


def _ahead() -> str:
    """Return in how many scenes of few particles on a GPU nvalchemi's list takes less than ours, by the median."""
    rows = [row for row in read("h200_fill/table.csv") if row["status"] == "ok" and int(row["points"]) < 14_000]
    scenes = dict.fromkeys(row["scene"] for row in rows)
    pairs = [[one(rows, scene=scene, method=method) for method in ("nvalchemi", "warp")] for scene in scenes]
    both = [(theirs, ours) for theirs, ours in pairs if theirs and ours]
    ahead = [theirs for theirs, ours in both if float(theirs["median_s"]) < float(ours["median_s"])]
    names = ", ".join(f"{whole(row['points'])} particles, `{row['layout']}`" for row in ahead)
    return f"{len(ahead)} of {len(both)} of these scenes" + (f" ({names})" if names else "")


def _jet(what: str) -> str:
    """Return particles, or the sum of a column, of the jet on an H200."""
    if what == "particles":
        return whole(json.loads((RESULTS / "jet_gear/h200_run.json").read_text(encoding="utf-8"))["particles"])
    return whole(sum(float(row[what]) for row in read("jet_gear/h200_steps.csv")))


def _lead(platform: str) -> str:
    """Return how many times as fast our list is as vesin's on the thesis's full lattice, or as nvalchemi's on a GPU."""
    if platform == "cpu":
        rows = read("thesis_cpu/table.csv")
        ours, theirs = (one(rows, layout="full", method=method) for method in ("warp", "vesin"))
    else:
        rows = [row for row in read("h200/rows.jsonl") if row["kind"] == "call" and row["points"] == 1_000_000]
        ours, theirs = (one(rows, method=method) for method in ("jfrnn warp", "nvalchemi 0.5.0 cell_list"))
    assert ours is not None and theirs is not None, platform
    return f"{number(float(theirs['median_s']) / float(ours['median_s']), digits=2)} times"


def _density(what: str) -> str:
    """Return milliseconds, or nanoseconds per particle, of a density of 64 million particles on one GPU."""
    row = one(read("distributed/h200_x2_64m.jsonl"), work="pair_sum", devices=1) or {}
    return number(row["median_s"], 1e3) if what == "ms" else number(row["median_s"] / row["particles"], 1e9, digits=2)


def _tree_disagrees() -> str:
    """Return on how many points Warp's tree says another thing about the cutoff, and libigl."""
    rows = read("triangles/cpu_warp.csv")
    said = []
    for method, title in (("libigl", "libigl"), ("wp.Mesh nearest", "Warp's tree, in single precision,")):
        of = [row for row in rows if row["method"] == method]
        said.append(f"{title} on {sum(int(row['missing'] or 0) + int(row['extra'] or 0) for row in of) or 'none'}")
    return ", ".join(said)


def _first(guide: str) -> str:
    """Return what the code of a guide compiles, and how long it takes in a fresh process, the first time and later."""
    rows = read("latency/guides_cpu.csv")
    cold, warm = (one(rows, guide=guide, cache=cache, status="ok") for cache in ("cold", "warm"))
    assert cold is not None and warm is not None, guide
    programs, kernels = (f"{cold[what]} {what if cold[what] != '1' else what[:-1]}" for what in ("programs", "kernels"))
    made = f"{programs} of XLA and {kernels}" if cold["kernels"] != "0" else f"{programs} of XLA"
    seconds = [number(row["page_s"], digits=2) for row in (cold, warm)]
    return f"{made}, and takes {seconds[0]} s in a fresh process the first time on a machine, {seconds[1]} s in later ones"


VALUES: dict[str, Callable[[], str]] = {
    **{f"gpu-bytes-{name}": partial(_bytes_per_particle, of) for name, of in (("counts", "warp-counts"), ("density", "pair-sum"))},
    **{f"jet-{what}": partial(_jet, what) for what in ("particles", "steps", "seconds")},
    **{f"lead-{platform}": partial(_lead, platform) for platform in ("cpu", "gpu")},
    **{f"density-64m-{what}": partial(_density, what) for what in ("ms", "ns")},
    **{"gpu-decided-later": _decided, "gpu-ahead": _ahead, "tree-disagrees": _tree_disagrees},
    **{f"cases-{kind}": partial(str, len(cases)) for kind, cases in _CASES.items()},
}
VALUES |= {f"first-{row['guide']}": partial(_first, row["guide"]) for row in read("latency/guides_cpu.csv")}
