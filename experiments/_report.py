"""The report of a sweep: reads its rows and nothing else; prints a short table, writes report.md, table.csv and pictures."""

import csv
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments import _table, methods
from experiments._errors import UsageError
from experiments._rows import SearchRow, read_latest

TITLES = ("scene", "points", "method", "s", "±", "/ {}", "MB", "/ {}", "missing", "extra", "density error", "gradient error")
TITLES += ("thesis", "s", "/ CLL", "MB", "/ CLL")
TEXT_COLUMNS = ("scene", "method", "thesis")
PRINTED = ("s", "MB", "missing", "extra")
ABSENT = "·"

NOTES = """\
- **s**: median time of a search, from raw positions to the finished result, without compilation; of several processes the median of
  their medians.
- **±**: half the interval that holds the median with a probability of 95 %, in per cent of it; five processes can tell 93.75 % at
  most, four 87.5 %, three 75 %. It belongs to the medians of several processes, or, in brackets, to the repeats of one.
  table.csv tells how many there are of each.
- **MB**: peak resident memory of the process during its first search, over what was resident after compilation; 10^6 bytes. On a
  GPU the peak of its memory over what it held at first: positions, list and scratch, or what the compiler tried out, if that is
  more.
- **/ cll**, or another method's name in a sweep that has no `cll`: divided by the row of that method on the same scene, process by
  process of the same round on the same kind of machine. `≈`: within noise: the interval of that ratio holds 1 (of one process: the
  intervals of both overlap). `?`: fewer than three such rounds, or repeats too few to tell.
- **missing**, **extra**: unordered pairs against the exact answer on the given floats, distance < cutoff. A method without a pair
  list (`~`) shows only the surplus and the deficit of each particle. Among more than two million particles (`~`, too), 20 000 are
  compared.
- **density error**, **gradient error**: of a poly6 density over the neighbors that were found and of its gradient, the largest of
  all particles, over the mean density, and over that per cutoff; `pair-sum` makes such a density itself.
- **thesis**: Table 6.1 of J. Peifle, Implementation of a Nearest-Neighbor Search for Particle Simulation in Sparse Computational
  Domains, KIT, February 2019: the method closest to ours, its total time, the largest resident set of its process, and both
  divided by its own CLL. Its machine was another, so only ratios compare.
- `warp`, `pair-sum`, `jax`, `brute`, `freud`, `pykdtree` and what runs inside JAX may use all cores, the others one thread. Lists
  hold each pair once or in both directions, as the method gives them.
- `*`: other processes kept more than a quarter of a core busy meanwhile (`others_cores` in table.csv). Methods on all cores then
  look slower than they are. `°`: the repeats took too little time together to tell whether other processes worked.
- table.csv holds all times, compilation included; rows.jsonl all that was measured.
"""


def report(folder: Path) -> None:
    """Print the table of a sweep and the paths of its files: report.md, table.csv and the pictures, beside the rows.

    Raises:
        UsageError: The folder holds no rows.
    """
    rows = read_latest(folder)
    if not rows:
        raise UsageError(f"{folder}: no rows; fill it with `python -m experiments run CONFIG.toml --out {folder}`")
    from experiments import _plots, _statistics

    lines = _table.lines(rows)
    pictures = _plots.draw_all(_statistics.summarize(rows), folder, describe_origin(rows))
    write_csv(lines, folder / "table.csv")
    (folder / "report.md").write_text(markdown(rows, lines, pictures), encoding="utf-8")
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 80
    console.print(rich_table(lines))
    for text in (*remarks(lines), describe_origin(rows)):
        console.print(text, soft_wrap=True)
    for path in (folder / "report.md", folder / "table.csv", *pictures):
        console.print(str(path), soft_wrap=True)


def _title(rows: list[SearchRow]) -> str:
    return ", ".join(_distinct(row.config or "" for row in rows)) or "rows"


def describe_origin(rows: Iterable[SearchRow]) -> str:
    """Say on what, with what, beside what and when the rows were measured, from the rows alone."""
    rows = list(rows)
    machines = _distinct(_describe_machine(row.machine) for row in rows if row.machine)
    packages = ("jax", "scipy", "warp-lang")
    versions = _distinct(", ".join(f"{name} {row.versions[name]}" for name in packages if row.versions.get(name)) for row in rows)
    commits = _distinct(f"commit {row.commit[:10]}{' with changes' if row.dirty else ''}" for row in rows if row.commit)
    others = max((row.others_cores or 0.0 for row in rows), default=0.0)
    beside = [f"others kept up to {others:.1f} cores busy"] if others > _table.NOTEWORTHY_CORES else []
    dates = sorted({row.time[:10] for row in rows if row.time})
    when = " to ".join(dict.fromkeys((dates[0], dates[-1]))) if dates else ""
    return " · ".join(" / ".join(part) for part in (machines, versions, commits, beside, [when]) if any(part))


def _distinct(texts: Iterable[str]) -> list[str]:
    return [text for text in dict.fromkeys(texts) if text]


def _describe_machine(machine: dict[str, Any]) -> str:
    memory = machine.get("memory_bytes")
    size = f", {memory / 2**30:.0f} GiB" if memory else ""
    return f"{machine.get('cpu')}, {machine.get('cores')} cores{size}"


def titles(lines: list[dict[str, Any]]) -> list[str]:
    """Return the titles of the columns, with the name of the method that ratios divide by."""
    return [title.format(lines[0]["yardstick"]) for title in TITLES]


def cells(line: dict[str, Any]) -> list[str]:
    """Return what the printed table shows of a line, a text per entry of `TITLES`."""
    return [
        *(line["scene"], _count(line["points"]), line["method"]),
        *(
            _table.busy_mark(line) + _seconds(line["median_s"]),
            _spread(line),
            _table.noise_mark(line) + _ratio(line["seconds_ratio"]),
            _megabytes(line["search_mb"]),
            _ratio(line["mb_ratio"]),
        ),
        *(_errors(line, "missing"), _errors(line, "extra"), _relative(line["density_error"]), _relative(line["gradient_error"])),
        line["thesis_method"] or ABSENT,
        *(_seconds(line["thesis_s"], 2), _ratio(line["thesis_s_to_cll"])),
        *(_megabytes(line["thesis_mb"]), _ratio(line["thesis_mb_to_cll"])),
    ]


def _count(value: int | None) -> str:
    return ABSENT if value is None else _table.count(value)


def _errors(line: dict[str, Any], name: str) -> str:
    return _table.pairs_mark(line) + _count(line[name])


def _relative(value: float | None) -> str:
    return ABSENT if value is None else f"{value:.1e}" if value else "0"


def _seconds(value: float | None, digits: int = 4) -> str:
    """Return a time with so many decimals, and more where they would leave fewer than three figures."""
    if value is None:
        return ABSENT
    digits = max(digits, 2 - math.floor(math.log10(value))) if 0 < value < 0.01 else digits
    return f"{value:.{digits}f}"


def _spread(line: dict[str, Any]) -> str:
    """Return half the interval of the median in per cent, in brackets where it is that of one process."""
    if line["low_s"] is None or not line["median_s"] or not line["confidence"]:
        return ABSENT
    text = f"{50 * (line['high_s'] - line['low_s']) / line['median_s']:.1f} %"
    return text if line["processes"] > 1 else f"({text})"


def _megabytes(value: float | None) -> str:
    return ABSENT if value is None else f"{value:.1f}"


def _ratio(value: float | None) -> str:
    if value is None:
        return ABSENT
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def rich_table(lines: list[dict[str, Any]]) -> Table:
    """Return the printed table, scene by scene: what has figures, or says why it has none, but for what is not installed.

    It fits a terminal of 80 columns, where long names of scenes are broken; `report.md` has more columns, and `table.csv` all.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for title in PRINTED:
        table.add_column(title, justify="right", no_wrap=True)
    previous = None
    for line in split_absent(lines)[0]:
        if line["scene"] != previous:
            if previous is not None:
                table.add_section()
            table.add_row(Text(f"{line['scene']}, {_count(line['points'])} points", "bold"))
            previous = line["scene"]
        wrong = [Text(_errors(line, name), "yellow" if line[name] else "") for name in ("missing", "extra")]
        ok = line["status"] == "ok"
        seconds = _table.busy_mark(line) + _seconds(line["median_s"]) if ok else line["status"]
        table.add_row(f"  {line['method']}", seconds, _megabytes(line["search_mb"]), *wrong, style=None if ok else "dim")
    return table


def split_absent(lines: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the lines of methods that are there, and what is said of the others: a line each would tell no more."""
    absent = dict.fromkeys(line["method"] for line in lines if line["status"] == "missing")
    said = [f"not installed: {', '.join(absent)} ({methods.HOW_TO_INSTALL})"] if absent else []
    return [line for line in lines if line["status"] != "missing"], said


def remarks(lines: list[dict[str, Any]]) -> list[str]:
    """Return what is to be said below the printed table: what is not installed, and what its marks mean, where they occur."""
    said = split_absent(lines)[1]
    marks = {_table.busy_mark(line) for line in lines}
    if "*" in marks:
        said.append("*: other processes kept more than a quarter of a core busy meanwhile, so that this time may be too long")
    if "°" in marks:
        said.append("°: repeats took too little time to tell whether other processes worked meanwhile")
    if any(_table.pairs_mark(line) for line in lines):
        said.append("~: told from counts of neighbors, or from a sample of the particles")
    return [*said, "s: median time of a search; MB: its peak memory, 10^6 bytes; missing, extra: pairs against the exact answer"]


def write_csv(lines: list[dict[str, Any]], path: Path) -> None:
    """Write the lines with all their columns."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, _table.COLUMNS)
        writer.writeheader()
        writer.writerows(lines)


def markdown(rows: list[SearchRow], lines: list[dict[str, Any]], pictures: list[Path]) -> str:
    """Return report.md."""
    head = [" | ".join(titles(lines)), " | ".join(":---" if title in TEXT_COLUMNS else "---:" for title in TITLES)]
    shown, absent = split_absent(lines)
    body = [" | ".join(cells(line)) for line in shown]
    table = [f"| {text} |" for text in (*head, *body)]
    failed = [(line, f"{line['status']}: " if line["status"] != "ok" else "") for line in shown if line["reason"]]
    unfinished = [f"- {line['scene']}, {line['method']}: {status}{line['reason']}" for line, status in failed]
    reasons = ["## Rows, and processes of them, without figures", "", *unfinished, ""] if unfinished else []
    images = [f"![{path.stem.replace('_', ' ')}]({path.name})" for path in pictures]
    return "\n".join(
        [
            f"# Sweep {_title(rows)}",
            "",
            describe_origin(rows),
            "",
            *table,
            "",
            *(f"{text}\n" for text in absent),
            NOTES,
            *reasons,
            *images,
            "",
        ]
    )
