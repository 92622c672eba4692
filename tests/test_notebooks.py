"""Notebooks run from the first cell to the last, in a short version."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook(path):
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    command = [sys.executable, "-c", EXECUTE, str(path), str(NOTEBOOKS)]
    environment = os.environ | {"JFRNN_NOTEBOOK_SMALL": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "pictures: 2" in done.stdout
    assert "sums per rebuild on" in done.stdout
    assert "one pair sum with backend='warp'" in done.stdout
