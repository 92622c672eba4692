"""Tables of jax-md: its own tests and examples with our lists in the place of its own, and who is right where lists differ."""

from experiments.jax_md_tests import EXAMPLES, FILES, LISTS
from experiments.pages.rows import Row, markdown, read, whole

ROWS, PROGRAMS = "jax_md/outcomes.csv", "jax_md/programs.csv"


def _outcomes(file: str) -> dict[str, dict[str, str]]:
    """Return the outcomes of each test of a file, by list."""
    found: dict[str, dict[str, str]] = {}
    for row in read(ROWS):
        if row["file"] == file:
            found.setdefault(row["test"], {})[row["list"]] = row["outcome"]
    return found


def own_tests() -> str:
    """Return a line for each file of tests: of those that ran with both lists, how many pass with either, both and one alone."""
    lines = []
    for file in (*FILES, *EXAMPLES):
        both = [outcomes for outcomes in _outcomes(file).values() if set(outcomes) == set(LISTS)]
        both = [outcomes for outcomes in both if set(outcomes.values()) != {"skipped"}]
        if not both:
            continue
        passed = [[outcomes[name] == "passed" for name in LISTS] for outcomes in both]
        counts = [len(both), sum(ours for _, ours in passed), sum(theirs for theirs, _ in passed)]
        counts += [sum(theirs and not ours for theirs, ours in passed), sum(ours and not theirs for theirs, ours in passed)]
        lines.append([f"`{file}`", *map(str, counts)])
    heads = ("tests", ">run", ">pass with jfrnn", ">pass with its own list", ">with its own alone", ">with jfrnn alone")
    return markdown(heads, lines)


def contested() -> str:
    """Return how many pairs each list misses or has too many, where they differ."""
    heads = ("scene", ">particles", ">pairs", ">jax-md misses", ">has too many", ">jfrnn misses", ">has too many")
    return markdown(heads, [[row["case"], *map(whole, [*row.values()][1:])] for row in read("jax_md/contested.csv")])


def programs() -> str:
    """Return what became of whole programs with either list, and by how much their last states differ."""
    rows = {(row["program"], row["list"]): row for row in read(PROGRAMS)}
    lines = []
    for program in dict.fromkeys(program for program, _ in rows):
        theirs, ours = (rows[program, who] for who in LISTS)
        lines.append([program, ours["outcome"], theirs["outcome"], ours["difference"]])
    return markdown(("program", "with jfrnn", "with its own list", ">difference"), lines)


def versions() -> str:
    """Return the commit of jax-sph that was run, and the version of nequix."""
    found = {row["program"].partition(" ")[0]: row["version"] for row in read(PROGRAMS)}
    return f"jax-sph at {found['jax-sph']}, nequix {found['nequix']}"


def _first() -> Row:
    return read(ROWS)[0]


def commit() -> str:
    """Return the commit of jax-md whose tests these are, and the version of JAX with which they ran."""
    return f"commit {_first()['jax_md_commit']}, JAX {_first()['jax']}"


TABLES = {"jax-md-tests": own_tests, "jax-md-contested": contested, "jax-md-programs": programs}
VALUES = {"jax-md-commit": commit, "jax-md-programs": versions}
