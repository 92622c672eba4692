"""The report as one page that needs nothing besides: tables that sort, pictures inside."""

import base64
import math
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from experiments import _table

TEMPLATE = Path(__file__).parent / "report.html.j2"
SHOWN = (  # column, title, digits
    *(
        ("scene", "scene", ""),
        ("points", "points", "d"),
        ("method", "method", ""),
        ("median_s", "s", ".3g"),
        ("low_s", "from", ".3g"),
    ),
    *(("high_s", "to", ".3g"), ("processes", "processes", "d"), ("seconds_ratio", "/ {}", ".3g"), ("search_mb", "MB", ".1f")),
    *(("mb_ratio", "MB / {}", ".3g"), ("list_mb", "list MB", ".1f"), ("scratch_mb", "scratch MB", ".1f")),
    *(("planned_list_mb", "planned list", ".1f"), ("planned_scratch_mb", "planned scratch", ".1f"), ("missing", "missing", "d")),
    *(("extra", "extra", "d"), ("density_error", "density error", ".1e"), ("gradient_error", "gradient error", ".1e")),
    *(("jump_error", "jump error", ".1e"), ("t_ksearch", "t_ksearch", ".3g"), ("t_frsearch", "t_frsearch", ".3g")),
    *(("t_processing", "t_processing", ".3g"), ("rebuilt", "rebuilt", ".2g"), ("thesis_method", "thesis", "")),
    *(("thesis_s", "thesis s", ".2f"), ("thesis_s_to_cll", "thesis s / CLL", ".3g"), ("thesis_mb", "thesis MB", ".1f")),
    *(("thesis_mb_to_cll", "thesis MB / CLL", ".3g"),),
)


def write(path: Path, title: str, origin: str, lines: list[dict[str, Any]], notes: str, pictures: list[Path]) -> None:
    """Write the page.

    Args:
        path: Where it goes.
        title: Of the sweep.
        origin: Machine, versions and date.
        lines: As `_table.lines` returns them; columns that are empty in all of them are left out.
        notes: Markdown, one item per line.
        pictures: PNG files, which are put into the page.
    """
    columns = [column for column in SHOWN if any(line[column[0]] is not None for line in lines)]
    rows = [[_cell(line, name, digits) for name, _, digits in columns] for line in lines]
    images = [(picture.stem.replace("_", " "), base64.b64encode(picture.read_bytes()).decode()) for picture in pictures]
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        title=title,
        origin=origin,
        titles=[text.format(lines[0]["yardstick"]) for _, text, _ in columns],
        rows=rows,
        notes=_items(notes),
        images=images,
    )
    path.write_text(page, encoding="utf-8")


def _cell(line: dict[str, Any], name: str, digits: str) -> dict[str, Any]:
    """Return the text of a cell, the value that it is sorted by, and its class."""
    value = line[name]
    if value is None:
        status = f"{line['status']}: {line['reason'] or ''}" if name == "median_s" and line["status"] != "ok" else ""
        return {"text": status.split(":")[0], "hint": status, "by": "", "kind": "none"}
    if not digits:
        return {"text": value, "hint": "", "by": value, "kind": "text"}
    text = format(value, digits).replace(",", " ") if math.isfinite(value) else str(value)
    about = _table.pairs_mark(line) if name in ("missing", "extra") else ""
    about = _table.noise_mark(line) if name == "seconds_ratio" else about
    kind = "wrong" if name in ("missing", "extra") and value else "number"
    partial = name == "processes" and bool(line["reason"])
    return {"text": about + text + " !" * partial, "hint": line["reason"] if partial else "", "by": value, "kind": kind}


def _items(notes: str) -> list[Markup]:
    """Return the items of a list in Markdown, of which only bold and code are known."""
    items = [" ".join(item.split()) for item in notes.strip().removeprefix("- ").split("\n- ")]
    return [Markup(_between(_between(str(Markup.escape(item)), "**", "b"), "`", "code")) for item in items]


def _between(text: str, mark: str, tag: str) -> str:
    parts = text.split(mark)
    return "".join(part if number % 2 == 0 else f"<{tag}>{part}</{tag}>" for number, part in enumerate(parts))
