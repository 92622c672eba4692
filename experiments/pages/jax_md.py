"""The table of jax-md's own tests, run with our lists in the place of its own: how many pass with either."""

from experiments.jax_md_tests import FILES, LISTS
from experiments.pages.rows import Row, markdown, read

ROWS = "jax_md/outcomes.csv"


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
    for file in FILES:
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


def _first() -> Row:
    return read(ROWS)[0]


def commit() -> str:
    """Return the commit of jax-md whose tests these are, and the version of JAX with which they ran."""
    return f"commit {_first()['jax_md_commit']}, JAX {_first()['jax']}"


TABLES = {"jax-md-tests": own_tests}
VALUES = {"jax-md-commit": commit}
