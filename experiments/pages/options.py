"""What options cost, on a CPU and a GPU: tables, the column of README's table of engines, and what the picture of spreads draws."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from experiments.pages.rows import Row, machine, markdown, number, one, read, whole

FIRST = "the first row"
AS_MANY = "one cutoff, as many pairs"
_WHATS = {"list": "list", "count": "counts", "sum": "sum"}
_PEERS = {"scipy": "SciPy", "hashgrid": "HashGrid"}
_COSTS = {  # names of values in pages, and the options whose lists they tell of
    "box": "box, periodic",
    "skewed": "box, skewed",
    "batch": "batch of 100 systems, superposed",
    "excluded": "excluded pairs",
    "two": "a cutoff per particle within a factor of 2, gather",
    "plummer": "57 neighbors each, a Plummer sphere",
    "species": "a cutoff per pair of two species",
}


class Machine(NamedTuple):
    """What was measured on one machine: its name and rows, which are over the first where they do not say what they are over."""

    name: str
    rows: list[Row]

    def row(self, option: str, beside: str) -> Row:
        """Return the row of an option that was compared with this, an empty one where there is none."""
        found = one(self.rows, option=option) or {}
        return found if found.get("beside", FIRST) == beside else {}


def machines() -> list[Machine]:
    """Return the CPU, whose rows lead, and the GPU."""
    return [Machine(machine(rows), rows) for rows in (read(f"options/{name}_warp.csv") for name in ("cpu", "gpu"))]


def options() -> str:
    """Return what each option costs, as a multiple of the first row."""
    where = machines()
    lines = [row for row in where[0].rows if not _about_cutoffs(row)]
    columns = [(each, f"{what}_ratio", title) for each in where for what, title in _WHATS.items()]
    return _table(lines, columns, lambda row: row["option"])


def cutoffs() -> str:
    """Return what cutoffs of many kinds cost, as a multiple of one or of what they name, and how far peers are behind counts."""
    where = machines()
    columns = []
    for each in where:
        columns += [(each, f"{what}_ratio", title) for what, title in _WHATS.items()]
        columns += [(each, f"{peer}_behind", title) for peer, title in _PEERS.items()]
    lines = [row for row in where[0].rows if _about_cutoffs(row)]
    said = {AS_MANY: "", FIRST: ", against the plain search above"}
    return _table(lines, columns, lambda row: row["option"] + said.get(row["beside"], f", against {row['beside']}"))


def by_arrays() -> str:
    """Return what options cost the engine `jax` on a CPU."""
    rows = [row for row in read("options/cpu_jax.csv") if row["status"] == "ok"]
    where = Machine(machine(rows), rows)
    columns = [(where, f"{what}_ratio", title) for what, title in _WHATS.items()]
    said = {AS_MANY: "", FIRST: ""}
    return _table(rows, columns, lambda row: row["option"] + said.get(row["beside"], f", against {row['beside']}"))


def _about_cutoffs(row: Row) -> bool:
    return bool(row["spread"]) or row["beside"] != FIRST


def _table(rows: list[Row], columns: list[tuple[Machine, str, str]], name: Callable[[Row], str]) -> str:
    """Return a table of columns, each of one machine, the first of which names it; less empty columns and rows."""
    found = [[_cell(each.row(row["option"], row["beside"]), column) for row in rows] for each, column, _ in columns]
    there = [k for k in range(len(rows)) if any(cells[k] for cells in found)]
    kept = [place for place, cells in enumerate(found) if any(cells)]
    named, titles = set[str](), list[str]()
    for each, _, title in (columns[place] for place in kept):
        titles.append(f">{title}" + f", {each.name}" * (each.name not in named))
        named.add(each.name)
    lines = [[name(rows[k]), *(found[place][k] for place in kept)] for k in there]
    return markdown(("option", *titles), lines)


def _cell(row: Row, column: str) -> str:
    """Return a ratio; of a peer whose counts differ, by how many pairs they are off, too."""
    differs = row.get(column.replace("behind", "differs")) if column.endswith("behind") else None
    said = f" ({whole(differs)} off)" if differs not in (None, "", "0") else ""
    return "" if not row.get(column) else f"{_times(row[column])}{said}"


def _times(ratio: object) -> str:
    return number(ratio, digits=2 if float(str(ratio)) < 1 else 3)


def _cost(option: str) -> str:
    """Return what an option makes of a list, on each machine that it was measured on."""
    where = machines()
    beside = (one(where[0].rows, option=option) or {}).get("beside", FIRST)
    return ", ".join(filter(None, (_cell(each.row(option, beside), "list_ratio") for each in where)))


def _density() -> str:
    """Return what a plain density takes over a plain list, on each machine that it was measured on."""
    rows = [each.rows[0] for each in machines()]
    return ", ".join(_times(float(row["sum_s"]) / float(row["list_s"])) for row in rows if row.get("sum_s"))


def spread_rows(where: Machine) -> list[Row]:
    """Return the rows of uniform points with cutoffs over ever larger factors, which make as many pairs."""
    return [
        row for row in where.rows if "cutoffs over a factor of" in row["option"] or row["option"] == "a cutoff per particle, equal"
    ]


TABLES = {"options": options, "cutoffs": cutoffs, "options-jax": by_arrays}
VALUES: dict[str, Callable[[], str]] = {f"cost-{name}": partial(_cost, option) for name, option in _COSTS.items()}
VALUES |= {"cost-density": _density, "cost-where": lambda: ", ".join(each.name for each in machines())}
