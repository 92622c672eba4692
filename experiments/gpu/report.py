"""What the rows of a GPU run say: a table of calls, a table of what the choices cost, and a picture against the floor.

The floor of a search is the bytes that it cannot avoid, positions read once and list and counts written once, over the bandwidth
that a copy reached in the same run.
"""

from pathlib import Path
from typing import Any

from experiments import _look
from experiments._errors import UsageError
from experiments._rows import RowFile
from experiments._table import count, markdown

OURS = "jfrnn warp"
_TRIANGLE_KERNELS = ("prepare_s", "place_s", "fill_s", "allocate_s", "scatter_s", "query_s", "settle_s")


def report(folder: Path) -> str:
    """Write report.md and, of searches, roofline.png beside the rows, and return the text."""
    path = folder / "rows.jsonl"
    if not path.exists():
        raise UsageError(f"{path} does not exist: run python -m experiments gpu CONFIG --out {folder} first")
    try:
        rows = RowFile(folder, dict).read()
        parts = [part(rows) for part in (_head, _exactness, _calls, _sums, _study, _memory, _triangles)]
    except (ValueError, KeyError, TypeError, StopIteration) as error:
        raise UsageError(f"{path}: holds no rows of a GPU run ({type(error).__name__}: {error}); name the folder of one") from error
    text = "\n\n".join(part for part in parts if part) + "\n"
    (folder / "report.md").write_text(text, encoding="utf-8")
    _draw(rows, folder / "roofline.png")
    return text


def bandwidth(rows: list[dict[str, Any]]) -> float:
    """Return the bytes per second that a copy reached."""
    return next(row["bytes_per_s"] for row in rows if row["kind"] == "ceiling")


def floor_seconds(row: dict[str, Any], bytes_per_s: float) -> float:
    """Return the time that the unavoidable bytes of a search take: 12 B of positions, 4 B per count and per slot."""
    listed = 0 if row["method"].endswith("counts") else row.get("capacity", 0)
    return row["points"] * (12 + 4 + 4 * listed) / bytes_per_s


def _of(rows: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["kind"] == kind]


def _head(rows: list[dict[str, Any]]) -> str:
    row = rows[0]
    versions = ", ".join(f"{name} {row['versions'].get(name)}" for name in ("jax", "warp-lang"))
    commit, copy = (row["commit"] or "unknown")[:10], f"{bandwidth(rows) / 1e12:.2f} TB/s"
    return f"{row['device']} · {versions} · commit {commit} · {row['time'][:10]} · copy {copy}"


def _exactness(rows: list[dict[str, Any]]) -> str:
    table = [
        {"method": r["method"], "dtype": r["dtype"], "dim": r["dim"], "hard cases": r["cases"], "wrong": r["wrong"]}
        for r in _of(rows, "exactness")
    ]
    return "## Hard cases against the oracle\n\n" + markdown(table)


def _calls(rows: list[dict[str, Any]]) -> str:
    copy, table = bandwidth(rows), []
    ours = {(r["layout"], r["points"]): r["median_s"] for r in _of(rows, "call") if r["method"] == OURS}
    for r in [*_of(rows, "call"), *_of(rows, "scan")]:
        seconds, reference = r.get("median_s"), ours.get((r["layout"], r["points"]))
        exact = r.get("exact_directed_pairs")
        table.append({
            "scene": r["layout"], "points": count(r["points"]),
            "method": r["method"] + (", per step of a scan" if r["kind"] == "scan" else ""),
            "ms": "·" if seconds is None else f"{1e3 * seconds:.4g}",
            "/ ours": "·" if seconds is None or reference is None else f"{seconds / reference:.3g}",
            "/ floor": "·" if seconds is None else f"{seconds / floor_seconds(r, copy):.3g}",
            "pairs - exact": "·" if exact is None or r.get("directed_pairs") is None else r["directed_pairs"] - exact,
            "reason": r.get("reason", "")[:80],
        })  # fmt: skip
    return "## Calls that are not waited for one by one\n\n" + markdown(table)


def _sums(rows: list[dict[str, Any]]) -> str:
    table, sums = [], _of(rows, "sum")
    without_list = {(r["points"], r["gradient"]): r.get("median_s") for r in sums if r["method"] == "pair_sum warp"}
    for r in sums:
        seconds, ours = r.get("median_s"), without_list.get((r["points"], r["gradient"]))
        table.append({
            "scene": r["layout"], "points": count(r["points"]), "way": r["method"],
            "what": "density, gradient" if r["gradient"] else "density",
            "ms": "·" if seconds is None else f"{1e3 * seconds:.4g}",
            "/ pair_sum warp": "·" if seconds is None or ours is None else f"{seconds / ours:.3g}",
            "error / eps √k": f"{r['error']:.2g}" if "error" in r else "·",
            "B per particle": f"{r['compiled_bytes'] / r['points']:.1f}" if "compiled_bytes" in r else "·",
            "reason": r.get("reason", "")[:80],
        })  # fmt: skip
    return "## Sums over neighbors\n\n" + markdown(table)


def _study(rows: list[dict[str, Any]]) -> str:
    table = []
    for r in _of(rows, "study"):
        first = next(s for s in _of(rows, "study") if s["layout"] == r["layout"])
        table.append({
            "layout": r["layout"], "points": r["points"], "kernels": r["method"], "ms": f"{1e3 * r['median_s']:.4g}",
            "/ first": f"{r['median_s'] / first['median_s']:.3g}", "query ms": f"{1e3 * r['query_s']:.4g}",
            "pairs - exact": r["directed_pairs"] - r["exact_directed_pairs"],
        })  # fmt: skip
    return "## What the choices cost, kernels alone\n\n" + (markdown(table) if table else "No CUDA device: not measured.")


def _memory(rows: list[dict[str, Any]]) -> str:
    names = ("layout", "points", "capacity", "planned_bytes", "compiled_bytes", "peak_bytes", "warp_pool_bytes")
    return "## Memory, planned and measured\n\n" + markdown([{name: r[name] for name in names} for r in _of(rows, "memory")])


def _triangles(rows: list[dict[str, Any]]) -> str:
    table = []
    for r in _of(rows, "triangles"):
        wrong = r.get("wrong", r.get("differing", ""))
        stages = ", ".join(f"{name.removesuffix('_s')} {1e3 * r[name]:.3g}" for name in _TRIANGLE_KERNELS if name in r)
        table.append({
            "points": count(r["points"]), "dtype": r["dtype"], "cutoff": r["cutoff"], "slots": r["capacity"],
            "pairs": r["pairs"], "method": r["method"], "ms": f"{1e3 * r['median_s']:.4g}", "wrong rows": wrong,
            "kernels, ms": stages, "settled": r.get("settled", ""),
        })  # fmt: skip
    return "## Triangles around a gear\n\n" + markdown(table) if table else ""


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    copy = bandwidth(rows)
    calls = [row for row in _of(rows, "call") if row.get("median_s")]
    lists = sorted({(row["points"], floor_seconds(row, copy)) for row in calls if row["method"] == OURS})
    if not lists:
        return
    best, floor = min((row["median_s"] / floor_seconds(row, copy), row["points"]) for row in calls if row["method"] == OURS)
    title = f"Our list takes {_look.factor(best)} times the time in which its bytes can be moved, at {count(floor)} particles"
    figure, axes = _look.make_axes(title, 4.6)
    ends = []
    for number, method in enumerate(dict.fromkeys(row["method"] for row in calls)):
        of_method = sorted((row["points"], row["median_s"]) for row in calls if row["method"] == method)
        color = _look.OURS if method.startswith("jfrnn") else _look.PEER
        x, y = zip(*((n, 1e9 * s / n) for n, s in of_method), strict=True)
        axes.plot(x, y, color=color, marker=_look.MARKERS[number % len(_look.MARKERS)])
        ends.append((method, x[-1], y[-1], color))
    x, y = zip(*((n, 1e9 * s / n) for n, s in lists), strict=True)
    axes.plot(x, y, "--", color="k")
    _look.dress(axes, "particles", "ns per particle")
    _look.write_names(axes, [*ends, ("floor: bytes of the list / bandwidth", x[-1], y[-1], "k")])
    figure.savefig(path, dpi=200)
