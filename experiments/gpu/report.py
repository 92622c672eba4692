"""What the rows of a GPU run say: a table for each kind of rows, and a picture against the floor.

The floor of a search is the bytes that it cannot avoid, positions read once and list and counts written once, over the bandwidth
that a copy reached in the same run.
"""

import itertools
from pathlib import Path
from typing import Any

from experiments import _look
from experiments._errors import UsageError
from experiments._rows import RowFile
from experiments._table import count, markdown

OURS = "jfrnn warp"
_TITLES = {
    "exactness": "Hard cases against the oracle",
    "call": "Calls that are not waited for one by one",
    "scan": "Steps of compiled scans",
    "sum": "Sums over neighbors",
    "study": "What the choices cost, kernels alone",
    "memory": "Memory, planned and measured",
    "triangles": "Triangles around a gear",
}
_UNSHOWN = {"key", "kind", "device", "versions", "machine", "commit", "dirty", "time", "seconds", "p10_s", "p90_s", "wrong_cases"}
_SCENE = ("layout", "points")
_FIRST = {  # the kind of the row that a row is divided by, in what both are alike, and its method; None: the first
    **dict.fromkeys(("call", "scan"), ("call", _SCENE, OURS)),
    "sum": ("sum", (*_SCENE, "gradient"), "pair_sum warp"),
    "study": ("study", ("layout",), None),
}


def report(folder: Path) -> str:
    """Write report.md and, of searches, roofline.png beside the rows, and return the text."""
    path = folder / "rows.jsonl"
    if not path.exists():
        raise UsageError(f"{path} does not exist: run python -m experiments gpu CONFIG --out {folder} first")
    try:
        rows = RowFile(folder, dict).read()
        parts = [_head(rows), *(_section(rows, kind) for kind in _TITLES)]
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


def _section(rows: list[dict[str, Any]], kind: str) -> str:
    """Return a table of the rows of a kind, with a column for whatever one of them says; nothing where there are none."""
    lines = [_beside(row, rows) for row in _of(rows, kind)]
    names = [name for name in dict.fromkeys(itertools.chain(*lines)) if name not in _UNSHOWN]
    table = [{_head_of(name): _cell(name, line.get(name)) for name in names} for line in lines]
    return f"## {_TITLES[kind]}\n\n{markdown(table)}" if table else ""


def _beside(row: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a row with its time over that of our list, and over the floor; of a sum, over that of ours; of a study, the first."""
    first = _FIRST.get(row["kind"])
    if first is None or row.get("median_s") is None:
        return row
    kind, same, method = first
    others = [r for r in _of(rows, kind) if r.get("median_s") and all(r.get(name) == row.get(name) for name in same)]
    ours = next((r["median_s"] for r in others if method in (None, r["method"])), None)
    beside = {} if ours is None else {"/ ours": row["median_s"] / ours}
    if kind == "call":
        beside["/ floor"] = row["median_s"] / floor_seconds(row, bandwidth(rows))
    return row | beside


def _head_of(name: str) -> str:
    return f"{name.removesuffix('_s').removesuffix('median') or 'time'} [ms]" if name.endswith("_s") else name.replace("_", " ")


def _cell(name: str, value: Any) -> str:  # noqa: ANN401
    if value is None:
        return "·"
    if isinstance(value, float):
        return f"{1e3 * value if name.endswith('_s') else value:.4g}"
    return count(value) if isinstance(value, int) and not isinstance(value, bool) else str(value)[:80]


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
