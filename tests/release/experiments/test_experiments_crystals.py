"""`python -m experiments bench crystals`: what is timed, and that nothing wrong is."""

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments import methods
from experiments._cli import app
from experiments.bench import crystals


@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_way_gets_a_row_and_none_twice(tmp_path, foreign):
    words = ["bench", "crystals", "--sizes", "3x12", "--repeats", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    rows = (tmp_path / "rows.jsonl").read_bytes()
    assert CliRunner().invoke(app, words).stdout == result.stdout
    assert (tmp_path / "rows.jsonl").read_bytes() == rows
    found = pd.read_csv(tmp_path / "cpu.csv")
    assert list(found["who"]) == ["jfrnn", "jfrnn", "nvalchemi", "vesin"]
    for _, row in found.iterrows():
        missing = None if row["who"] == "jfrnn" else methods.lacks(row["who"])
        assert row["status"] == ("ok" if missing is None else "missing")
        assert missing is not None or (row["waited_ms"] > 0 and row["wrong"] == 0)


def test_a_size_is_systems_and_atoms():
    result = CliRunner().invoke(app, ["bench", "crystals", "--sizes", "3"])
    assert result.exit_code == 2
    assert "say systems x atoms of each" in result.output
    assert crystals._read_size("256x100") == (256, 100)
