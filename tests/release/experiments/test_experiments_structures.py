"""`python -m experiments bench structures`: every library gets its rows, and those that are there found the same pairs."""

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments._cli import app
from experiments.bench import structures


@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_library_gets_its_rows(tmp_path, foreign):
    words = ["bench", "structures", "--count", "4", "--repeats", "20", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    rows = pd.read_csv(tmp_path / "cpu.csv")
    assert sorted(rows["who"]) == sorted([*structures.LIBRARIES * 2, "jfrnn"])
    done = rows[rows["status"] == "ok"]
    assert set(done["who"]) >= {"jfrnn"}
    assert (done.groupby(done["atoms"].fillna(0))["pairs"].nunique() == 1).all()
