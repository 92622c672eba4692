"""`python -m experiments skin`: a step that keeps its list, beside one that makes it anew."""

import pytest
from typer.testing import CliRunner

from experiments import _skin
from experiments._cli import app


@pytest.mark.parametrize("backends", [("warp",), pytest.param(("warp", "jax"), marks=pytest.mark.slow)], ids="+".join)
def test_rows_say_how_often_the_list_was_made(monkeypatch, backends):
    monkeypatch.setattr(_skin, "BACKENDS", backends)
    table = _skin.skin_table(spacing=1e-3, steps=3, repeats=2)
    assert tuple(table["backend"]) == backends
    assert set(table["keep_rebuilds"]) == {0}
    assert set(table["rebuild_rebuilds"]) == {3}
    assert (table[["keep_ms", "rebuild_ms"]] > 0).all(axis=None)


def test_command(monkeypatch):
    monkeypatch.setattr(_skin, "BACKENDS", ("warp",))
    result = CliRunner().invoke(app, ["skin", "--spacing", "1e-3", "--steps", "2", "--repeats", "2"])
    assert result.exit_code == 0, result.output
    assert result.stdout.split()[:3] == ["backend", "points", "skin"]
    assert "scans: " in result.stderr  # on a fine lattice it takes minutes
