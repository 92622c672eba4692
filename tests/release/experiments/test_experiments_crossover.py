import csv
import json

import pytest
from typer.testing import CliRunner

from experiments._cli import app
from experiments.bench import crossover


@pytest.fixture
def tiny(monkeypatch):
    """Measure one small scene."""
    monkeypatch.setattr(crossover.measure, "__defaults__", ((16,),))
    monkeypatch.setattr(crossover, "NEIGHBORS", (30,))


def test_every_backend_gets_a_checked_row(tiny, tmp_path):
    result = CliRunner().invoke(app, ["bench", "crossover", "--out", str(tmp_path), "--repeats", "20"], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.split()[:4] == ["n", "neighbors", "backend", "median_s"]
    with (tmp_path / "cpu.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["backend"] for row in rows] == ["jax", "warp", "brute"]
    for row in rows:
        assert tuple(row) == crossover.COLUMNS
        assert (row["platform"], row["n"], row["neighbors"], row["repeats"]) == ("cpu", "16", "30", "20")
        assert (row["missing"], row["extra"]) == ("0", "0")
        assert 0 < float(row["p10_s"]) <= float(row["median_s"]) <= float(row["p90_s"]) < 1
        assert 0 < float(row["mean_count"]) < int(row["capacity"])


def test_rows_are_on_disk_before_the_next_scene_starts(monkeypatch, tiny, tmp_path):
    def fail_second(n, neighbors, repeats):
        if n > 16:
            raise RuntimeError("stopped")
        yield dict.fromkeys(crossover.COLUMNS, n)

    monkeypatch.setattr(crossover, "_rows", fail_second)
    with pytest.raises(RuntimeError, match="stopped"):
        crossover.measure(tmp_path, 30, sizes=(16, 32))
    (row,) = map(json.loads, (tmp_path / "rows.jsonl").read_text().splitlines())
    assert row["n"] == 16
    monkeypatch.setattr(crossover, "_rows", lambda n, neighbors, repeats: iter([{"n": n}]))
    assert crossover.measure(tmp_path, 30, sizes=(16, 32))["n"].tolist() == [16, 32]  # of which the second alone is measured
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 2


def test_too_few_repeats_are_refused(tmp_path):
    result = CliRunner().invoke(app, ["bench", "crossover", "--out", str(tmp_path), "--repeats", "5"])
    assert result.exit_code == 2
    assert list(tmp_path.iterdir()) == []
