"""The programs of the gallery run, small, and do what they say."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
GALLERY = ROOT / "examples" / "gallery"
CHECKS = {
    "lennard_jones": "energies = main(side=6, chunks=2); assert np.ptp(energies.sum(axis=1)) < 0.01",
    "dam_break": "(x, v, rho), change = main(nx=5, steps=30, differentiated=10); assert np.isfinite(x).all() and change > 0",
    "crystals": "found = main(); assert found[0][2] < 1e-4 < found[1][2] and all(-0.07 < energy < -0.06 for _, energy, _ in found)",
    "grains": "radius, seen = main(across=5, up=5, frames=3); assert (seen[-1][:, 1] < seen[0][:, 1]).all()",
    "learned": "losses = main(steps=60); assert losses[-1] < 0.2 * losses[0]",
    "gear": "x, vertices, faces = main(n=40, chunks=2, faces=200); assert np.isfinite(x).all() and x[:, 1].max() < 20",
    "devices": "x, device = main(n=300, chunks=1); assert (np.bincount(device) > 60).all() and len(np.bincount(device)) == 4",
}
SLOW = ("dam_break", "learned", "gear", "devices")
RUN = """
import importlib, json, sys
import matplotlib
matplotlib.use("agg")
import numpy as np
for name, check in json.loads(sys.argv[1]).items():
    exec(check, {"main": importlib.import_module(name).main, "np": np})
"""


def test_every_program_is_run():
    programs = {path.stem: path.read_text(encoding="utf-8") for path in GALLERY.glob("*.py")}
    assert set(programs) == set(CHECKS)
    assert max(text.count("\n") for text in programs.values()) <= 80
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert [name for name in programs if f"gallery/{name}.py" not in page] == []


@pytest.mark.parametrize(
    "names", [sorted(set(CHECKS) - set(SLOW)), pytest.param(SLOW, marks=pytest.mark.slow)], ids=["quick", "slow"]
)
def test_programs(names):
    """In one process: most of their time is its start, and what they compile."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    told = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{GALLERY}", "XLA_FLAGS": flags}
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", RUN, json.dumps({name: CHECKS[name] for name in names})]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=told)
    assert done.returncode == 0, done.stdout + done.stderr
