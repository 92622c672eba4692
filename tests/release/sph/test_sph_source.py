"""Scenes of the 2D source: the energies that its equations give when all particles move at once, and closed forms."""

import jax
import numpy as np
import pytest
from checked import slow
from places import ROOT

from jfrnn.cases import fluids
from jfrnn.sph import budget, solver
from jfrnn.sph.model import make_model, make_state

REFERENCE = ROOT / "experiments" / "reference"


def make(name, backend="brute"):
    scene = fluids.fluid(name)
    model = make_model(scene, backend=backend)
    return model, solver.begin(model, make_state(scene))


@pytest.mark.parametrize("name", [slow("one"), slow("two"), slow("three"), "four"])
def test_energies_over_20_000_steps(name):
    model, s = make(name)
    energies = jax.jit(lambda s: (s.time, budget.kinetic_energy(model, s), budget.potential_energy(model, s)))
    expected = np.loadtxt(REFERENCE / f"sph2d_{name}_simultaneous.csv", delimiter=",", skiprows=2)
    found = []
    for steps in np.diff(np.round(expected[:, 0] / 1e-4).astype(int), prepend=0):
        s, _ = solver.advance(model, s, None, steps)
        found.append(energies(s))
    found = np.array(found)
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-11)
    np.testing.assert_allclose(found[:, 1:], expected[:, 1:3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[:, 1:].sum(axis=1), expected[:, 3], rtol=1e-9)


@pytest.mark.slow
def test_closed_forms_of_a_falling_particle():
    model, s = make("one")
    y, v = [], []
    walk = jax.jit(lambda s: solver.step(model, s)[0])
    for _ in range(40):
        s = walk(s)
        y.append(float(s.x[0, 1]))
    n = np.arange(1, 41)
    np.testing.assert_allclose(y, 0.5 - 0.5 * 9.81 * (1e-4 * n) ** 2, rtol=1e-14)
    s, _ = solver.advance(model, s, None, 3160 - 40)
    assert s.x[0, 1] > 0.01
    s, _ = solver.advance(model, s, None, 1)  # the first wall hit is at step 3161
    assert s.x[0, 1] == 0.01
    s, _ = solver.advance(model, s, None, 60_000)
    for _ in range(2):
        s = walk(s)
        v.append(abs(float(s.v[0, 1])))
    assert max(v) == pytest.approx(0.5 * 9.81 * 1e-4 / 1.5, rel=1e-3)  # a resting particle keeps e·g·dt/(1 + e)
