"""`python -m experiments bench ties`: lattices beside the same scenes moved at random, each count compared with the oracle."""

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments._cli import app


@pytest.mark.slow  # thirty programs
def test_every_kind_of_sites_gets_a_row_that_was_checked(tmp_path):
    result = CliRunner().invoke(app, ["bench", "ties", "--cube", "1000", "--rounds", "2", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    table = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert len(table) == 2 * 5
    assert (table["wrong"] == 0).all()
    assert (table["checked"] == 1000).all()
    whole = table[table["sites"].isin(["spacing 1", "spacing 1/64"])]["neighbors"]
    assert whole.nunique() == 1  # strictly less: no tie is a pair
    assert (table[["count_s", "list_s", "density_s"]] > 0).all(axis=None)
