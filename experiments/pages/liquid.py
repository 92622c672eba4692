"""A Lennard-Jones liquid beside jax-md, OpenMM and LAMMPS: tables of pages and a sentence, of what its rows hold."""

from functools import partial

from experiments._look import factor
from experiments.pages.rows import TIMES, Row, machine, markdown, number, read, whole

OURS = {
    "pair_sum": "`pair_sum`, searches in each step",
    "pair_sum, list": "`pair_sum(neighbors=)`, list with a skin",
    "pair_sum, list, float64": "`pair_sum(neighbors=)`, list with a skin, float64",
    "distances, grad": "`distances` and `jax.grad`, list with a skin",
}
LIST = "pair_sum, list"  # speaks for us
WIDE = f"{LIST}, float64"
LIBRARIES = {"OpenMM": "OpenMM", "LAMMPS": "LAMMPS, float64", "jax-md": "jax-md"}  # and their heads of a table
MACHINES = ("gpu", "cpu")


def rows_of(platform: str) -> list[Row]:
    """Return the rows of a platform that have times."""
    return [row for row in read(f"lj/{platform}.csv") if row["steps_per_s"]]


def speeds(rows: list[Row], who: str) -> dict[int, Row]:
    """Return the fastest row of a way, or of a library of others, for each number of particles."""
    best: dict[int, Row] = {}
    for row in rows:
        if row["who"] == who or (who in LIBRARIES and row["who"].startswith(who)):
            before = best.get(int(row["n"]))
            best[int(row["n"])] = row if before is None or _speed(row) > _speed(before) else before
    return best


def behind(rows: list[Row], library: str) -> list[float]:
    """Return how many times a library's steps per second ours are, in order, where both were measured."""
    ours, theirs = speeds(rows, LIST), speeds(rows, library)
    return sorted(_speed(ours[n]) / _speed(theirs[n]) for n in ours if n in theirs)


def said(platform: str) -> str:
    """Return how many times the steps per second of each library ours are, as in "2 to 3 times OpenMM's on an H200"."""
    rows, spans = rows_of(platform), []
    for library in LIBRARIES:
        if ratios := behind(rows, library):
            low, high = factor(ratios[0]), factor(ratios[-1])
            spans.append(f"{low if low == high else f'{low} to {high}'} times {library}'s")
    where = machine(rows)
    return f"{', '.join(spans) or 'beside no other'} on {'an ' if where.startswith('H') else ''}{where}"


def known() -> str:
    """Return steps per second of our list, and of the fastest way of each library that was measured."""
    of_all = {platform: rows_of(platform) for platform in MACHINES}
    others = {WIDE: "jfrnn, float64"} | LIBRARIES
    others = {who: title for who, title in others.items() if any(speeds(rows, who) for rows in of_all.values())}
    lines = []
    for rows in of_all.values():
        ours, theirs = speeds(rows, LIST), {who: speeds(rows, who) for who in others}
        for n, row in sorted(ours.items()):
            cells = [_beside(row, of.get(n), who) for who, of in theirs.items()]
            drift = f"{float(row['drift']):.0e}".replace("e-0", "e-")
            lines.append([machine(rows), whole(n), number(row["steps_per_s"]), *cells, drift])
    return markdown(("on", ">particles", ">jfrnn", *(f">{title}" for title in others.values()), ">jfrnn: drift"), lines)


def _beside(ours: Row, row: Row | None, who: str) -> str:
    if row is None:
        return ""
    times = f" ({number(_speed(ours) / _speed(row), digits=2)} {TIMES})" if who in LIBRARIES else ""
    return number(row["steps_per_s"]) + times


def _speed(row: Row) -> float:
    return float(row["steps_per_s"])


def table(column: str) -> str:
    """Return a column of all ways, over machines and numbers of particles."""
    of_all = {platform: rows_of(platform) for platform in reversed(MACHINES)}
    columns = [(platform, n) for platform, rows in of_all.items() for n in sorted({int(row["n"]) for row in rows})]
    ways = list(dict.fromkeys([*OURS, *(row["who"] for rows in of_all.values() for row in rows)]))
    lines = []
    for who in ways:
        best = {platform: speeds(rows, who) for platform, rows in of_all.items()}
        found = [best[platform].get(n) for platform, n in columns]
        if any(found):
            lines.append([OURS.get(who, who), *(number((row or {}).get(column)) for row in found)])
    return markdown(("way", *(f">{machine(of_all[platform])}, {whole(n)}" for platform, n in columns)), lines)


def others() -> str:
    """Return the ways that are not plainly ours, with their versions and with what about them is another thing."""
    found: dict[str, list[Row]] = {}
    for row in [row for platform in MACHINES for row in rows_of(platform)]:
        found.setdefault(row["who"], []).append(row)
    lines = []
    for who, rows in found.items():
        version, differs = ({row.get(column) or "" for row in rows} for column in ("peer", "differs"))
        if any((*version, *differs)):
            lines.append([OURS.get(who, who), *("; ".join(sorted(filter(None, each))) for each in (version, differs))])
    return markdown(("way", "version", "what differs from ours in float32"), lines)


TABLES = {
    "liquid-known": known,
    "liquid": partial(table, "steps_per_s"),
    "liquid-drift": partial(table, "drift"),
    "liquid-others": others,
}
VALUES = {f"liquid-{platform}": partial(said, platform) for platform in MACHINES}
