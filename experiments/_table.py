"""The table of a sweep: a line per row, beside what the thesis says, with ratios to cell-linked lists on either side."""

from typing import Any

from experiments import _thesis
from experiments._rows import Row

YARDSTICK = "cll"
COLUMNS = (
    *("scene", "layout", "fill_asked", "fill", "points", "spacing", "cutoff_ratio", "dim", "dtype", "method", "status", "reason"),
    *("allocate_s", "compile_s", "first_s", "median_s", "p10_s", "p90_s", "repeats", "others_cores", "seconds_to_cll"),
    *("search_mb", "list_mb", "scratch_mb", "peak_mb", "mb_to_cll", "pairs", "missing", "extra", "compared"),
    *("thesis_method", "thesis_points", "thesis_s", "thesis_s_to_cll", "thesis_mb", "thesis_mb_to_cll"),
)


def lines(rows: list[Row]) -> list[dict[str, Any]]:
    """Return a line per row, with the keys `COLUMNS`, None where there is nothing to say.

    Scenes stand in order of their points; within one, the methods stand as the rows do. `seconds_to_cll` and `mb_to_cll` divide by
    the row `cll` of the same scene; `thesis_..._to_cll` divide the thesis's figures by its own. MB are 10^6 bytes; `search_mb` is
    what the search takes over what was resident after compilation, `peak_mb` counts compilation too.
    """
    names = name_scenes(rows)
    yardsticks = {row.scene_key: row for row in rows if row.method == YARDSTICK and row.status == "ok"}
    return [_line(row, names[row.scene_key], yardsticks.get(row.scene_key)) for row in in_order(rows)]


def in_order(rows: list[Row]) -> list[Row]:
    """Return the rows, small scenes first and each scene's rows together."""
    points = {row.scene_key: row.points for row in rows if row.points is not None}
    first = {key: number for number, key in enumerate(dict.fromkeys(row.scene_key for row in rows))}
    return sorted(rows, key=lambda row: (points.get(row.scene_key, 0), first[row.scene_key]))


def name_scenes(rows: list[Row]) -> dict[tuple[Any, ...], str]:
    """Return a name of each scene: layout and fill, and whatever else differs within these rows."""
    differing = {
        "spacing": lambda row: f"dx {row.spacing:g} m",
        "cutoff_ratio": lambda row: f"r {row.cutoff_ratio:g} dx",
        "dim": lambda row: f"{row.dim}D",
        "dtype": lambda row: row.dtype,
        "seed": lambda row: f"seed {row.seed}",
    }
    shown = [text for name, text in differing.items() if len({getattr(row, name) for row in rows}) > 1]
    return {row.scene_key: ", ".join([row.scene_name, *(text(row) for text in shown)]) for row in rows}


def megabytes(count: int | None) -> float | None:
    """Return bytes in MB."""
    return None if count is None else count / 1e6


def count(value: int) -> str:
    """Return a whole number with a space before every three digits."""
    return f"{value:,}".replace(",", " ")


def ratio(value: float | None, yardstick: float | None) -> float | None:
    """Return value / yardstick, None where either is unknown or there is nothing to divide by."""
    return value / yardstick if value is not None and yardstick else None


def _line(row: Row, scene: str, cll: Row | None) -> dict[str, Any]:
    thesis, thesis_cll = _thesis.figures(row), _thesis.figures(row, "CLL")
    line = {name: getattr(row, name) for name in COLUMNS if hasattr(row, name)}
    line |= {"scene": scene, "seconds_to_cll": ratio(row.median_s, cll and cll.median_s)}
    line |= {f"{name}_mb": megabytes(getattr(row, f"{name}_bytes")) for name in ("search", "list", "scratch", "peak")}
    line["mb_to_cll"] = ratio(row.search_bytes, cll and cll.search_bytes)
    if thesis is not None and thesis_cll is not None:
        line |= {"thesis_method": thesis.method, "thesis_points": thesis.points}
        line |= {"thesis_s": thesis.seconds, "thesis_s_to_cll": ratio(thesis.seconds, thesis_cll.seconds)}
        line |= {"thesis_mb": thesis.megabytes, "thesis_mb_to_cll": ratio(thesis.megabytes, thesis_cll.megabytes)}
    return {name: line.get(name) for name in COLUMNS}
