"""`python -m experiments bench latency`: what is timed, and that nothing wrong is."""

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments import methods
from experiments._cli import app
from experiments.bench import latency, table

OURS = ["x + 1", "list", "counts", "density", "density, gradient"]
N = 16


@pytest.fixture(scope="module")
def scene():
    return latency._make_scene(N)


@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_way_gets_a_row_and_none_twice(tmp_path, foreign):
    words = ["bench", "latency", "--sizes", str(N), "--repeats", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    rows = (tmp_path / "rows.jsonl").read_bytes()
    assert CliRunner().invoke(app, words).stdout == result.stdout
    assert (tmp_path / "rows.jsonl").read_bytes() == rows
    rows = pd.read_csv(tmp_path / "cpu.csv")
    assert (rows["n"] == N).all()
    ours = rows[rows["who"].isin(["jax", "jfrnn"])]
    assert list(ours["what"]) == OURS
    assert (ours["status"] == "ok").all()
    assert (ours["wrong"] == 0).all()
    assert (ours[["waited_us", "step_us", "waited_ratio", "step_ratio"]] > 0).all(axis=None)
    assert tuple(ours.loc[ours["what"] == "x + 1", ["waited_ratio", "step_ratio"]].iloc[0]) == (1, 1)
    theirs = rows[~rows["who"].isin(["jax", "jfrnn"])]
    assert list(theirs["what"]) == ["dense list", "sparse list", "cells", "all pairs"]
    for _, row in theirs.iterrows():
        missing = methods.lacks(row["who"])
        assert row["status"] == ("ok" if missing is None else "missing")
        assert missing is None or row["reason"] == missing


def test_of_a_wrong_answer_no_time_is_taken(scene):
    nearer = scene._replace(cutoff=0.8 * scene.cutoff)
    for way in latency._ways():
        if way.who == "jfrnn":
            made = latency._prepare(way._replace(make=lambda scene, way=way: way.make(nearer)), scene)
            row = {}
            assert not table.judge(row, made.wrong, 0)
            assert (row["status"], row["wrong"] > 0) == ("failed", True), way.what
            assert row["reason"] == f"the answer is wrong for {row['wrong']} particles"


def test_an_error_is_a_row(scene):
    def make(scene):
        raise RuntimeError("no such thing")

    row = {}
    assert table.ask(row, None, lambda: latency._prepare(next(latency._ways())._replace(make=make), scene)) is None
    assert row == {"status": "failed", "reason": "RuntimeError: no such thing"}


def test_counts_of_lists_of_others(scene):
    i, k = np.nonzero(scene.idx < N)
    pairs = np.stack([i, scene.idx[i, k]])
    padded = np.pad(pairs, ((0, 0), (0, 3)), constant_values=N)
    assert latency._wrong_counts_of_sparse(scene, padded) == 0
    assert latency._wrong_counts_of_sparse(scene, padded[:, 1:]) == 1
    assert latency._wrong_counts_of_dense(scene, scene.idx) == 0
    assert latency._wrong_counts_of_dense(scene, np.where(scene.idx == scene.idx[0, 0], N, scene.idx)) > 0
    assert latency._wrong_rows(scene, (scene.idx[:, ::-1], scene.counts)) == 0
    moved = np.where(np.arange(N)[:, None] == 3, np.roll(scene.idx, 1, axis=0), scene.idx)
    assert latency._wrong_rows(scene, (moved, scene.counts)) == 1
