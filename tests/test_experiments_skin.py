"""`python -m experiments skin`: a step that keeps its list, beside one that makes it anew."""

from typer.testing import CliRunner

from experiments._cli import app
from experiments._skin import skin_table


def test_rows_say_how_often_the_list_was_made():
    table = skin_table(spacing=1e-3, steps=3, repeats=2)
    assert table["backend"].tolist() == ["warp", "jax"]
    assert table["keep_rebuilds"].tolist() == [0, 0]
    assert table["rebuild_rebuilds"].tolist() == [3, 3]
    assert (table[["keep_ms", "rebuild_ms"]] > 0).all(axis=None)


def test_command():
    result = CliRunner().invoke(app, ["skin", "--spacing", "1e-3", "--steps", "2", "--repeats", "2"])
    assert result.exit_code == 0, result.output
    assert result.output.split()[:3] == ["backend", "points", "skin"]
