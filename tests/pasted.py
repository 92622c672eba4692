"""A program that runs the Python blocks of pages as they stand, those of a page in order and in a namespace of its own.

It takes the pages as arguments and prints a line for each that ran: `\\0ran`, the page, and how many lines of code it has.
"""

import soon

PROGRAM = (
    soon.PROGRAM
    + """
import sys, traceback
from pathlib import Path

import jax

for page in map(Path, sys.argv[1:]):
    lines, running = [], False
    for line in page.read_text(encoding="utf-8").splitlines():
        fence = line.startswith("```")
        running = line == "```python" if fence else running
        lines.append(line if running and not fence else "")
    jax.config.update("jax_enable_x64", False)
    try:
        exec(compile("\\n".join(lines), str(page), "exec"), {"__name__": page.stem})
    except Exception:
        traceback.print_exc()
    else:
        print("\\0ran", page, sum(map(bool, lines)))
"""
)


def lines_run(output: str) -> dict[str, int]:
    """Return how many lines of code each page has that ran, from what the program printed."""
    found = [line.split() for line in output.splitlines() if line.startswith("\0ran")]
    return {page: int(lines) for _, page, lines in found}
