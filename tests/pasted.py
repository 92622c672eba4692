"""A program that runs the Python blocks of pages as they stand, those of a page in order and in a namespace of its own.

A block of text right behind a block of Python has to be what that block prints. The program takes the pages as arguments and prints
a line for each that ran: `\\0ran`, the page, and how many lines of code it has.
"""

import soon

PROGRAM = (
    soon.PROGRAM
    + """
import contextlib, io, re, sys, traceback
from pathlib import Path

import jax

BLOCK = re.compile(r"^```python\\n(.*?)^```\\n(?:\\n```text\\n(.*?)^```\\n)?", re.DOTALL | re.MULTILINE)

for page in map(Path, sys.argv[1:]):
    text, names, count = page.read_text(encoding="utf-8"), {"__name__": page.stem}, 0
    jax.config.update("jax_enable_x64", False)
    try:
        for block in BLOCK.finditer(text):
            above = text.count("\\n", 0, block.start(1)) * "\\n"
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(above + block[1], str(page), "exec"), names)
            if block[2] is not None and printed.getvalue() != block[2]:
                raise ValueError(f"{page} says that this is printed:\\n{block[2]}but it is:\\n{printed.getvalue()}")
            count += sum(map(bool, block[1].splitlines()))
    except Exception:
        traceback.print_exc()
    else:
        print("\\0ran", page, count)
"""
)


def lines_run(output: str) -> dict[str, int]:
    """Return how many lines of code each page has that ran, from what the program printed."""
    found = [line.split() for line in output.splitlines() if line.startswith("\0ran")]
    return {page: int(lines) for _, page, lines in found}
