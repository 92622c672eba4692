"""Notebooks run from the first cell to the last, in a short version: what a cell's metadata `small` replaces is for tests alone."""

import json
import re
from functools import cache

import pytest
import soon
from places import ROOT
from started import run_python

NOTEBOOKS = ROOT / "notebooks"
RUN = (
    soon.PROGRAM
    + """
import json, sys, traceback
from pathlib import Path
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

class Shell(InteractiveShell):
    def enable_gui(self, gui=None):
        pass


shell = Shell.instance()
for path in map(Path, sys.argv[1:]):
    shell.reset()
    shell.enable_matplotlib("inline")
    said, pictures, failed = "", 0, ""
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        code = "".join(cell["source"])
        for shown, short in cell["metadata"].get("small", {}).items():
            assert shown in code, (path, shown)
            code = code.replace(shown, short)
        with shell.display_trap, capture_output() as captured:  # entered before, the trap leaves alone what captures results
            done = shell.run_cell(code)
        said += captured.stdout
        pictures += sum("image/png" in output.data for output in captured.outputs)
        error = done.error_before_exec or done.error_in_exec
        if error:
            failed = "".join(traceback.format_exception(error))
            break
    print("\\0" + json.dumps([path.stem, pictures, said, failed]), flush=True)
"""
)


SAYS = {  # pictures, and what each prints
    "gpu_layouts": (
        2,
        ("NVIDIA H200", "nvalchemi takes", "plan and peak differ by", "warp, ns per particle: corners", " 0 of them wrong"),
    ),
    "open_questions": (
        2,
        ("times as long as cll:", "turned2 tumbled / straight", "warp-update / warp-rebuild, by", "growth: time"),
    ),
    "speed_against_error": (4, ("exact on every scene", "methods with a list give")),
    "thesis_reproduced": (8, ("have a counterpart here", "verdict of the thesis, CLL before")),
    "molecular_dynamics": (2, ("the list was rebuilt", "total energy per particle varies by", "first peak", "pressure")),
    "quickstart": (3, ("sites closer than 3 spacings: 24", "and those at exactly 3:       28", "rebuilt", "unevenness")),
    "pair_sums": (2, ("sums per rebuild on", "one pair sum with backend='warp'")),
    "sph_gradients": (6, ("at the best ε", "m²/s was the first guess", "first guess [1. 0.]", "forces:")),
    "sph_jet": (2, ("particles of oil", "operations in a step", "kinetic energy", "neighbors on average")),
    "sph_validation": (7, ("a perfect fluid is ahead of the experiment", "energy kept to")),
}


def test_every_notebook_is_run():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(SAYS)


SLOW = ("open_questions", "pair_sums", "sph_gradients", "sph_jet", "sph_validation")


@cache
def run(names):
    """Run notebooks in one process, one after another, each in a namespace of its own: pictures, what it printed, how it failed.

    Most of the time of a notebook is the start of a process, and what several of them measure or compile.
    """
    done = run_python("-c", RUN, *(NOTEBOOKS / f"{name}.ipynb" for name in names), cwd=NOTEBOOKS)
    return {name: found for name, *found in (json.loads(line[1:]) for line in done.stdout.splitlines() if line[:1] == "\0")}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in SAYS])
def test_notebook(name):
    drawn, printed, failed = run(SLOW if name in SLOW else tuple(name for name in SAYS if name not in SLOW))[name]
    assert failed == ""
    pictures, said = SAYS[name]
    assert drawn == pictures
    assert [words for words in said if words not in printed] == []


def test_notebooks_take_no_private_names():
    for path in NOTEBOOKS.glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        private = r"\b(?:jfrnn|experiments)\.[\w.]*\b_\w+|import .*\b_\w+|\w\._(?!replace\b)[a-z]\w*"
        assert re.findall(private, code) == [], path.name


def test_printed_lines_fit_a_page():
    """A page of 1280 pixels shows 106 letters beside each other."""
    for path in NOTEBOOKS.glob("*.ipynb"):
        outputs = [out for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] for out in cell.get("outputs", ())]
        printed = "".join("".join(out["text"]) for out in outputs if "text" in out)
        assert [line for line in printed.splitlines() if len(line) > 106] == [], path.name
