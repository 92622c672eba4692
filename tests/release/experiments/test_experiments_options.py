"""`python -m experiments bench options`: one option at a time, beside a plain search."""

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments._cli import app


@pytest.mark.slow  # nineteen programs
def test_every_option_gets_a_row(tmp_path):
    result = CliRunner().invoke(
        app, ["bench", "options", "--points", "500", "--rounds", "2", "--backend", "warp", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    table = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert table["option"].is_unique
    assert len(table) == 22
    assert (table[["list_s", "count_s", "list_ratio", "count_ratio"]] > 0).all(axis=None)
    assert set(table["option"][table["sum_s"].isna()]) == {"half", "skin of a tenth"}
    entries = dict(zip(table["option"], table["entries"], strict=True))
    assert 2 * entries["half"] == entries["open, whole list"] == entries["a cutoff per particle, equal"]
    assert entries["include_self"] == entries["open, whole list"] + 500
    assert entries["box, periodic"] > entries["box, periodic along x"] > entries["open, whole list"]
    assert "count_ratio" in result.output
