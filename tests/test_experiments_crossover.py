import csv

import pytest
from typer.testing import CliRunner

from experiments import _crossover
from experiments._cli import app


@pytest.fixture
def tiny(monkeypatch):
    """Measure one small scene."""
    monkeypatch.setattr(_crossover, "SIZES", (16,))
    monkeypatch.setattr(_crossover, "NEIGHBORS", (30,))


def test_every_backend_gets_a_checked_row(tiny, tmp_path):
    result = CliRunner().invoke(app, ["crossover", "--out", str(tmp_path), "--repeats", "20"], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.strip() == str(tmp_path / "cpu.csv")
    with (tmp_path / "cpu.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["backend"] for row in rows] == ["jax", "warp", "brute"]
    for row in rows:
        assert tuple(row) == _crossover.COLUMNS
        assert (row["platform"], row["n"], row["neighbors"], row["repeats"]) == ("cpu", "16", "30", "20")
        assert (row["missing"], row["extra"]) == ("0", "0")
        assert 0 < float(row["p10_s"]) <= float(row["median_s"]) <= float(row["p90_s"]) < 1
        assert 0 < float(row["mean_count"]) < int(row["capacity"])


def test_rows_are_on_disk_before_the_next_scene_starts(monkeypatch, tiny, tmp_path):
    def fail_second(n, neighbors, repeats):
        if n > 16:
            raise RuntimeError("stopped")
        yield dict.fromkeys(_crossover.COLUMNS, n)

    monkeypatch.setattr(_crossover, "_rows", fail_second)
    with pytest.raises(RuntimeError, match="stopped"):
        _crossover.measure(tmp_path, sizes=(16, 32))
    assert len((tmp_path / "cpu.csv").read_text().splitlines()) == 2


def test_too_few_repeats_are_refused(tmp_path):
    result = CliRunner().invoke(app, ["crossover", "--out", str(tmp_path), "--repeats", "5"])
    assert result.exit_code == 2
    assert list(tmp_path.iterdir()) == []
