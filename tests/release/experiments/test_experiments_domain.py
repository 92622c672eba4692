"""`python -m experiments bench domain`: one row per separation, every pair found in each."""

import pandas as pd
import reference
from typer.testing import CliRunner

from experiments._cli import app
from experiments.bench import domain
from jfrnn import cases


def test_pairs_do_not_depend_on_the_separation_and_are_the_oracle_s(tmp_path):
    domain.command([10.0, 1e4], 200, tmp_path)
    table = pd.read_csv(tmp_path / "cpu.csv")
    assert table["separation"].tolist() == [10.0, 1e4]
    assert table["cells"][1] > 1e6 * table["cells"][0]
    for separation, pairs in zip(table["separation"], table["pairs"]):
        scene = cases.scene("two-blobs", n=200, separation=separation)
        assert pairs == len(reference.reference_pairs(scene.positions, scene.cutoff, half=True))


def test_command(tmp_path):
    result = CliRunner().invoke(app, ["bench", "domain", "20", "--points", "60", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert result.stdout.split()[:3] == ["separation", "cells", "median_ms"]
    refused = CliRunner().invoke(app, ["bench", "domain", "--", "-5"])
    assert refused.exit_code == 2
    assert "separation" in refused.output
