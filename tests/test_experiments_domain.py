"""`python -m experiments domain`: one row per separation, every pair found in each."""

import reference
from typer.testing import CliRunner

from experiments._cli import app
from experiments._domain import domain_table
from jfrnn import cases


def test_pairs_do_not_depend_on_the_separation_and_are_the_oracle_s():
    table = domain_table([10.0, 1e4], 200)
    assert table["separation"].tolist() == [10.0, 1e4]
    assert table["cells"][1] > 1e6 * table["cells"][0]
    for separation, pairs in zip(table["separation"], table["pairs"]):
        scene = cases.scene("two-blobs", n=200, separation=separation)
        assert pairs == len(reference.reference_pairs(scene.positions, scene.cutoff, half=True))


def test_command():
    result = CliRunner().invoke(app, ["domain", "20", "--points", "60"])
    assert result.exit_code == 0, result.output
    assert result.output.split()[:3] == ["separation", "cells", "median"]
    refused = CliRunner().invoke(app, ["domain", "--", "-5"])
    assert refused.exit_code == 2
    assert "separation" in refused.output
