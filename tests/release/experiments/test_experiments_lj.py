"""`python -m experiments bench lj`: a Lennard-Jones liquid whose energy stays, whatever finds its forces."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import jfrnn
from experiments import methods
from experiments._cli import app
from experiments.bench import lj


@pytest.fixture
def liquid(foreign):
    return lj.make_crystal(512)


def test_ways_have_one_energy_and_one_path(liquid):
    """Few steps end at the same positions; the energy stays."""
    runs = {name: lj._run(way, liquid, 0.3, 20, 1) for name, way in lj.WAYS.items()}
    first = runs["pair_sum"]
    for run in runs.values():
        np.testing.assert_allclose(run.x, first.x, atol=1e-4)
        assert abs(run.drift) < 2e-3
    assert float(jnp.max(jnp.abs(first.x - liquid.x))) > 0.1
    assert int(runs["pair_sum, list"].kept.rebuild_count) > 0


def test_the_potential_goes_to_zero_smoothly():
    r = np.linspace(0.9, 2.5, 200)
    inside = r[r < lj.ONSET]
    np.testing.assert_allclose(lj.energy_of(jnp.asarray(inside**2)), 4 * (inside**-12 - inside**-6), rtol=1e-12)
    assert abs(float(lj.energy_of(jnp.asarray(6.25)))) < 1e-12
    steps = np.diff(np.asarray(lj.energy_of(jnp.asarray(r[r > 1.9] ** 2))))
    assert np.abs(np.diff(steps)).max() < 5e-4


def test_rows(monkeypatch, tmp_path, foreign):
    monkeypatch.setattr(lj, "SKINS", (0.2, 0.3))
    given = ["bench", "lj", "--sizes", "343", "--steps", "3", "--repeats", "1", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    table = pd.read_csv(tmp_path / "cpu.csv")
    assert list(table["who"]) == [*lj.WAYS, *lj.JAX_MD]
    ours = table[table["who"].isin(lj.WAYS)]
    assert (ours["status"] == "ok").all()
    assert (ours["steps_per_s"] > 0).all()
    assert (ours["drift"].abs() < 3e-3).all()
    assert set(ours["skin"].dropna()) <= set(lj.SKINS)
    if methods.lacks("jax-md"):
        peers = table[table["who"].isin(lj.JAX_MD)]
        assert (peers["status"] == "missing").all()
        assert peers["reason"].str.contains("jax_md").all()


def test_lists_hold_what_the_cutoff_needs(liquid):
    nbrs = lj.WAYS["distances, grad"].keep(liquid, 0.3)
    assert isinstance(nbrs, jfrnn.NeighborList)
    assert nbrs.reverse is not None
    assert nbrs.skin == pytest.approx(0.3)
