"""`python -m experiments bench lj`: a Lennard-Jones liquid whose energy stays, whatever finds its forces."""

import csv

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commanded import told

import jfrnn
from experiments import methods
from experiments.bench import lj, lj_peers
from experiments.pages import liquid as tables


def plain(square):
    return 4 * (square**-6 - square**-3)


def with_other_fade(square):
    """The end of OpenMM's potential and of LAMMPS's lj/mdf."""
    place = jnp.clip((jnp.sqrt(square) - lj_peers.ONSET) / (lj_peers.CUTOFF - lj_peers.ONSET), 0, 1)
    return plain(square) * (1 - place) ** 3 * (1 + 3 * place + 6 * place**2)


POTENTIALS = {
    **{"jax-md dense": lj_peers.energy_of, "jax-md ordered sparse": lj_peers.energy_of, "OpenMM": with_other_fade},
    **{"LAMMPS lj/mdf": with_other_fade, "LAMMPS lj/cut": lambda square: plain(square) - plain(lj_peers.CUTOFF**2)},
}


@pytest.fixture
def liquid(foreign):
    return lj_peers.make_crystal(512)


def test_ways_have_one_energy_and_one_path(liquid):
    """Few steps end at the same positions; the energy stays."""
    runs = {name: lj._run(way, liquid, 0.3, 20, 1) for name, way in lj.WAYS.items() if name != lj.WIDE}
    first = runs["pair_sum"].end
    for run in runs.values():
        np.testing.assert_allclose(run.end.x, first.x, atol=1e-4)
        assert abs(run.ran.columns(512, 20)["drift"]) < 2e-3
    assert float(jnp.max(jnp.abs(first.x - liquid.x))) > 0.1
    assert int(runs["pair_sum, list"].kept.rebuild_count) > 0


@pytest.mark.parametrize("name", lj_peers.PEERS)
def test_peers_have_the_energies_that_their_potentials_give(name, liquid):
    """Before and after twenty steps, so that forces and the integrator are the same, too."""
    peer = lj_peers.PEERS[name]
    if missing := methods.lacks(peer.package):
        pytest.skip(missing)

    def by_search(x, box):
        return jfrnn.pair_sum(lambda r, i, j: POTENTIALS[name](r @ r) / 2, x, lj_peers.CUTOFF, box=box)

    theirs = peer.run(lj_peers.Asked(liquid, 0.3, 20, 1))
    wide = liquid._replace(x=liquid.x.astype(jnp.float64), v=liquid.v.astype(jnp.float64))
    ours = lj._run(lj.WAYS["pair_sum"]._replace(potential=by_search), wide, 0.3, 20, 1).ran
    np.testing.assert_allclose(theirs.potential, ours.potential, rtol=1e-5)
    np.testing.assert_allclose(theirs.kinetic, ours.kinetic, rtol=1e-5)


def test_the_potential_goes_to_zero_smoothly():
    r = np.linspace(0.9, 2.5, 200)
    inside = r[r < lj_peers.ONSET]
    np.testing.assert_allclose(lj_peers.energy_of(jnp.asarray(inside**2)), 4 * (inside**-12 - inside**-6), rtol=1e-12)
    assert abs(float(lj_peers.energy_of(jnp.asarray(6.25)))) < 1e-12
    steps = np.diff(np.asarray(lj_peers.energy_of(jnp.asarray(r[r > 1.9] ** 2))))
    assert np.abs(np.diff(steps)).max() < 5e-4


@pytest.mark.slow  # other benches get their rows and tables in the same way; what is timed here, the test of ways compares
@pytest.mark.filterwarnings("ignore")  # of jax-md
def test_rows(monkeypatch, tmp_path, foreign):
    monkeypatch.setattr(lj, "SKINS", (0.2, 0.3))
    told("bench", "lj", "--sizes", 343, "--steps", 3, "--repeats", 1, "--out", tmp_path)
    table = pd.read_csv(tmp_path / "cpu.csv")
    assert list(table["who"]) == [*lj.WAYS, *lj_peers.PEERS]
    for row in table.to_dict("records"):
        missing = methods.lacks(lj_peers.PEERS[row["who"]].package) if row["who"] in lj_peers.PEERS else None
        assert row["status"] == ("missing" if missing else "ok"), row
        assert row["reason"] == missing or (missing is None and row["steps_per_s"] > 0 and abs(row["drift"]) < 3e-3)
    assert set(table["skin"].dropna()) <= set(lj.SKINS)

    with (tmp_path / "cpu.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["who"] in lj.WAYS]
    monkeypatch.setattr(tables, "read", lambda _: rows)
    assert tables.said("cpu") == "beside no other on 2 cores"
    assert "OpenMM" not in tables.known() + tables.others()
    rows.append(next(row for row in rows if row["who"] == tables.LIST) | {"who": "OpenMM", "peer": "8.6"})
    assert tables.said("cpu") == "1 times OpenMM's on 2 cores"
    assert "(1.0 \N{MULTIPLICATION SIGN})" in tables.known()
    assert "| OpenMM | 8.6 |" in tables.others()


def test_lists_hold_what_the_cutoff_needs(liquid):
    nbrs = lj.WAYS["distances, grad"].keep(liquid, 0.3)
    assert isinstance(nbrs, jfrnn.NeighborList)
    assert nbrs.reverse is not None
    assert nbrs.skin == pytest.approx(0.3)
