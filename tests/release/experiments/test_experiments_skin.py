"""`python -m experiments bench skin`: a step that keeps its list, beside one that makes it anew."""

import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments._cli import app
from experiments.bench import skin


@pytest.mark.parametrize("backends", [("warp",), pytest.param(("warp", "jax"), marks=pytest.mark.slow)], ids="+".join)
def test_rows_say_how_often_the_list_was_made(monkeypatch, tmp_path, backends):
    monkeypatch.setattr(skin, "BACKENDS", backends)
    skin.command(1e-3, 3, 2, tmp_path)
    table = pd.read_csv(tmp_path / "cpu.csv")
    assert tuple(table["backend"]) == backends
    assert set(table["keep_rebuilds"]) == {0}
    assert (table["rebuild_rebuilds"] == table["steps"]).all()
    assert (table[["keep_ms", "rebuild_ms"]] > 0).all(axis=None)


def test_command(monkeypatch, tmp_path):
    monkeypatch.setattr(skin, "BACKENDS", ("warp",))
    result = CliRunner().invoke(
        app, ["bench", "skin", "--spacing", "1e-3", "--steps", "2", "--repeats", "2", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    assert result.stdout.split()[:3] == ["backend", "points", "skin"]
    assert "warp" in result.stderr  # on a fine lattice it takes minutes
