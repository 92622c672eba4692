"""Notebooks run from the first cell to the last, in a short version."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import methods

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
EXECUTE = """
import sys
import nbclient, nbformat

notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": sys.argv[2]}}).execute()
outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
print(*[output.get("text", "") for output in outputs if output.output_type == "stream"])
print("pictures:", sum("image/png" in output.get("data", {}) for output in outputs))
"""


SAYS = {  # pictures, and what each prints
    "gpu_layouts": (
        2,
        ("NVIDIA H200", "nvalchemi takes", "plan and peak differ by", "warp, ns per particle: corners", " 0 of them wrong"),
    ),
    "open_questions": (
        2,
        ("times as long as cll", "turned2 tumbled / straight", "no rows of warp-update and warp-rebuild", "growth: time"),
    ),
    "speed_against_error": (4, ("exact on every scene", "methods with a list give")),
    "thesis_reproduced": (7, ("have a counterpart here", "verdict of the thesis, CLL before")),
    "molecular_dynamics": (2, ("the list was rebuilt", "total energy per particle varies by", "first peak", "pressure")),
    "quickstart": (3, ("sites closer than 3 spacings: 24", "and those at exactly 3:       28", "rebuilt", "unevenness")),
    "pair_sums": (2, ("sums per rebuild on", "one pair sum with backend='warp'")),
    "sph_gradients": (6, ("at the best ε", "m²/s was the first guess", "first guess [1. 0.]", "forces:")),
    "sph_jet": (2, ("particles of oil", "operations in a step", "kinetic energy", "neighbors on average")),
    "sph_validation": (6, ("a perfect fluid is ahead of the experiment", "energy kept to")),
}


def test_every_notebook_is_run():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(SAYS)


SLOW = ("open_questions", "pair_sums", "sph_gradients", "sph_jet", "sph_validation")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in SAYS])
def test_notebook(name):
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    command = [sys.executable, "-c", EXECUTE, str(NOTEBOOKS / f"{name}.ipynb"), str(NOTEBOOKS)]
    environment = os.environ | {"JFRNN_NOTEBOOK_SMALL": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    pictures, said = SAYS[name]
    if name == "open_questions":
        two = ("no rows of {} and {}", "step: {} / {}")[not methods.lacks("nanoflann-dynamic")]
        said += (two.format("nanoflann-dynamic", "nanoflann-rebuild"),)
    assert f"pictures: {pictures}" in done.stdout
    assert [words for words in said if words not in done.stdout] == []


def test_notebooks_take_no_private_names():
    for path in NOTEBOOKS.glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        private = r"\b(?:jfrnn|experiments)\.[\w.]*\b_\w+|import .*\b_\w+|\w\._(?!replace\b)[a-z]\w*"
        assert re.findall(private, code) == [], path.name
