"""`python -m experiments bench arrays`: what is timed, and that nothing wrong is."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments import methods
from experiments._cli import app
from experiments.bench import arrays

OURS = ["list", "counts", "density", "density, gradient", "list in a box"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_way_gets_a_row(tmp_path, foreign):
    words = ["bench", "arrays", "--sides", "6", "--repeats", "2", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    frame = pd.read_csv(tmp_path / "cpu.csv")
    assert list(frame["layout"].unique()) == ["jitter", "ties"]
    ours = frame[frame["who"] == "jfrnn"]
    assert list(ours["what"]) == OURS + OURS[:2]
    assert (ours["status"] == "ok").all()
    assert (ours["wrong"] == 0).all()
    assert (ours[["lower_s", "compile_s", "waited_ms", "step_ms"]] > 0).all(axis=None)
    for _, row in frame[~frame["who"].isin(["jfrnn", "XLA"])].iterrows():
        missing = methods.lacks(row["who"])
        assert row["status"] == ("ok" if missing is None else "missing")
        assert missing is None or row["reason"] == missing


def test_a_wrong_answer_is_seen():
    scene = arrays._make_scene(5, "ties")
    distances = np.linalg.norm(np.asarray(scene.x)[:, None] - np.asarray(scene.x), axis=2)
    rows = [[j for j in np.flatnonzero(row < 3) if j != i] for i, row in enumerate(distances)]
    width = max(map(len, rows))
    idx = np.array([row + [len(rows)] * (width - len(row)) for row in rows])
    assert arrays._wrong_rows(scene, (jnp.asarray(idx), jnp.asarray(scene.counts))) == 0
    idx[3, 0], idx[7, 1] = 3, idx[7, 0]
    assert arrays._wrong_rows(scene, (jnp.asarray(idx), None)) == 2
    tied = idx.copy()
    tied[9, 0] = np.flatnonzero(distances[9] == 3)[0]
    assert arrays._wrong_rows(scene, (jnp.asarray(tied), None)) == 3
