"""The table of a sweep: a line per row, beside what the thesis says, with ratios to cell-linked lists or another method."""

from collections.abc import Sequence
from typing import Any, TypeVar

from experiments import _statistics, _thesis
from experiments._rows import SearchRow
from experiments._statistics import Summary

RowT = TypeVar("RowT", bound=SearchRow)

YARDSTICKS = ("cll", "warp", "warp-counts", "warp-rebuild")
"""What ratios divide by: the first of these that a sweep has."""
NOTEWORTHY_CORES = 0.25  # what other processes take beyond it is said: it slows down the methods that use all cores
PARTS = ("t_tree", "t_ksearch", "t_frsearch", "t_processing")
COLUMNS = (
    *("scene", "layout", "fill_asked", "fill", "points", "spacing", "cutoff_ratio", "dim", "dtype", "seed", "angle", "growth"),
    *("order", "motion", "method", "status", "reason", "processes", "repeats", "allocate_s", "compile_s", "first_s"),
    *("median_s", "low_s", "high_s", "confidence", "p10_s", "p90_s", *PARTS, "rebuilt", "others_cores", "yardstick"),
    *("seconds_ratio", "within_noise", "search_mb", "list_mb", "scratch_mb", "peak_mb", "device_mb", "planned_list_mb"),
    *("planned_scratch_mb", "mb_ratio", "pairs", "missing", "extra", "compared", "density_error", "gradient_error"),
    *("jump_error", "thesis_method", "thesis_points", "thesis_s", "thesis_s_to_cll", "thesis_mb", "thesis_mb_to_cll"),
)


def lines(rows: list[SearchRow]) -> list[dict[str, Any]]:
    """Return a line per method and scene, with the keys `COLUMNS`, None where there is nothing to say.

    Scenes stand in order of their points; within one, the methods stand as the rows do. `seconds_ratio` and `mb_ratio` divide by
    the row of the method `yardstick` of the same scene, seconds round by round; `thesis_..._to_cll` divide the thesis's figures by
    its own. MB are 10^6 bytes; `search_mb` is what the search takes over what was resident after compilation, `peak_mb` counts
    compilation too.
    """
    summaries = _statistics.summarize(rows)
    names = name_scenes(summaries)
    present = {row.method for row in summaries}
    yardstick = next((name for name in YARDSTICKS if name in present), YARDSTICKS[0])
    others = {row.scene_key: row for row in summaries if row.method == yardstick and row.status == "ok"}
    made = [_line(row, names[row.scene_key], others.get(row.scene_key)) for row in in_order(summaries)]
    return [line | {"yardstick": yardstick} for line in made]


def in_order(rows: Sequence[RowT]) -> list[RowT]:
    """Return the rows, small scenes first and each scene's rows together."""
    points = {row.scene_key: row.points for row in rows if row.points is not None}
    first = {key: number for number, key in enumerate(dict.fromkeys(row.scene_key for row in rows))}
    return sorted(rows, key=lambda row: (points.get(row.scene_key, 0), first[row.scene_key]))


def name_scenes(rows: Sequence[SearchRow]) -> dict[tuple[Any, ...], str]:
    """Return a name of each scene: layout and fill, and whatever else differs within these rows."""
    differing = {
        "spacing": lambda row: f"dx {row.spacing:g} m",
        "cutoff_ratio": lambda row: f"r {row.cutoff_ratio:g} dx",
        "dim": lambda row: f"{row.dim}D",
        "dtype": lambda row: row.dtype,
        "seed": lambda row: f"seed {row.seed}",
        "angle": lambda row: "" if row.angle is None else f"{row.angle:g}°",
        "growth": lambda row: "" if row.growth is None else f"grown {row.growth:g} x",
        "order": lambda row: row.order,
        "motion": lambda row: f"motion {row.motion:g} dx",
    }
    shown = [text for name, text in differing.items() if len({getattr(row, name) for row in rows}) > 1]
    made = sorted(rows, key=lambda row: row.fill is not None)  # of a row that is skipped nobody knows which fill was made
    return {row.scene_key: ", ".join(filter(None, [row.scene_name, *(text(row) for text in shown)])) for row in made}


def megabytes(count: int | None) -> float | None:
    """Return bytes in MB."""
    return None if count is None else count / 1e6


def count(value: int) -> str:
    """Return a whole number with a space before every three digits."""
    return f"{value:,}".replace(",", " ")


def ratio(value: float | None, yardstick: float | None) -> float | None:
    """Return value / yardstick, None where either is unknown or there is nothing to divide by."""
    return value / yardstick if value is not None and yardstick else None


def pairs_mark(line: dict[str, Any]) -> str:
    """Return what stands before the numbers of wrong pairs of a line: whether they were told from counts alone."""
    return "~" if line["compared"] in ("counts", "sample") else ""


def busy_mark(line: dict[str, Any]) -> str:
    """Return what stands before the time of a line: whether others worked meanwhile, or whether that could not be measured."""
    if line["median_s"] is None:
        return ""
    return "°" if line["others_cores"] is None else "*" if line["others_cores"] > NOTEWORTHY_CORES else ""


def _line(row: Summary, scene: str, other: Summary | None) -> dict[str, Any]:
    paired = None if other is None or other is row else _statistics.ratio_interval(row, other)
    thesis, thesis_cll = _thesis.figures(row), _thesis.figures(row, "CLL")
    line = {name: getattr(row, name) for name in COLUMNS if hasattr(row, name)}
    line |= {
        "scene": scene,
        "seconds_ratio": paired.middle if paired else ratio(row.median_s, other and other.median_s),
        **row.parts,
    }
    line["processes"] = row.processes or None
    line["within_noise"] = None if other is None or other is row else _statistics.within_noise(row, other)
    sizes = ("search", "list", "scratch", "peak", "device", "planned_list", "planned_scratch")
    line |= {f"{name}_mb": megabytes(getattr(row, f"{name}_bytes")) for name in sizes}
    line["mb_ratio"] = ratio(row.search_bytes, other and other.search_bytes)
    if thesis is not None and thesis_cll is not None:
        line |= {"thesis_method": thesis.method, "thesis_points": thesis.points}
        line |= {"thesis_s": thesis.seconds, "thesis_s_to_cll": ratio(thesis.seconds, thesis_cll.seconds)}
        line |= {"thesis_mb": thesis.megabytes, "thesis_mb_to_cll": ratio(thesis.megabytes, thesis_cll.megabytes)}
    return {name: line.get(name) for name in COLUMNS}
