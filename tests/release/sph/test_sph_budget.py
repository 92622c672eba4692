"""What the SPH solver must keep: momentum, to rounding; energy, as far as the step allows; and what dissipation takes."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from checked import slow
from poured import changed

from jfrnn.cases import fluids
from jfrnn.sph import budget, solver, states
from jfrnn.sph.model import make_model, make_state

DROP = fluids.fluid("drop", nx=6, duration=0.003)


def run(scene, steps):
    """Return the model, and the state before and after steps."""
    model = make_model(scene, backend="brute")
    nbrs = solver.list_neighbors(model, make_state(scene), 0.5 * scene.spacing, slack=2.0)
    begun = jax.jit(solver.begin)(model, make_state(scene), nbrs)
    after, nbrs = solver.advance(model, begun, nbrs, steps)
    nbrs.check()
    return model, begun, after


def energy(model, s):
    return float(budget.kinetic_energy(model, s) + budget.potential_energy(model, s) + budget.internal_energy(model, s))


@pytest.mark.parametrize("form", ["symmetric", slow("mean"), slow("volume")])
def test_momentum_is_kept_to_rounding(form):
    uneven = replace(DROP, velocities=DROP.velocities + np.random.default_rng(0).normal(size=DROP.velocities.shape) * 20.0)
    model, before, after = run(changed(uneven, pressure=form, tension=1e4), 100)
    total = np.abs(np.asarray(before.v)).sum() * DROP.masses[0]
    assert np.abs(after.v - before.v).sum() * DROP.masses[0] > 0.1 * total  # forces did act
    assert np.abs(budget.momentum(model, after) - budget.momentum(model, before)).max() < 1e-14 * total


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "most", "shrinks"), [("symplectic", 1.5e-3, 1.8), ("midpoint", 1e-4, 4.0)])
def test_energy_without_dissipation_is_kept_as_far_as_the_step_allows(integrator, most, shrinks):
    lossless, drift = changed(DROP, artificial=None, density_diffusion=None, integrator=integrator), []
    for parts in (1, 2):
        model, before, after = run(replace(lossless, step=DROP.step / parts), 60 * parts)
        drift.append(abs(energy(model, after) / energy(model, before) - 1))
    assert drift[0] < most
    assert drift[1] < drift[0] / shrinks


@pytest.mark.slow
def test_the_drop_loses_little_energy_and_gains_none():
    model, s, _ = run(DROP, 0)
    energies = [energy(model, s)]
    for _ in range(6):
        s, _ = solver.advance(model, s, None, 15)
        energies.append(energy(model, s))
    assert (np.diff(energies) < 0).all()
    assert energies[-1] > 0.9 * energies[0]  # six particles along a radius


def test_energies_of_compression_belong_to_their_pressures():
    for pressure, stored in ((states.linear, states.linear_energy), (states.tait, states.tait_energy)):
        constants = (1000.0, 30.0, 7.0)[: 2 + (pressure is states.tait)]
        assert jax.grad(stored)(1040.0, *constants) == pytest.approx(pressure(1040.0, *constants) / 1040.0**2)
        assert stored(1000.0, *constants) == pytest.approx(0)


def test_energy_of_compression_needs_densities():
    scene = changed(DROP, evolve="pressure")
    with pytest.raises(ValueError, match="needs carried densities, got evolve 'pressure': take 'continuity'"):
        budget.internal_energy(make_model(scene), make_state(scene))


def test_a_tank_that_is_open_on_some_sides_has_an_energy():
    """Heights are those over its floor; where there is no wall, over 0."""
    scene = changed(replace(DROP, tank=fluids.Tank((-np.inf, -3.0), (np.inf, np.inf))), restitution=0.5, gravity=(0.5, -2.0))
    x, m = scene.positions, scene.masses
    expected = np.sum(m * (2.0 * (x[:, 1] + 3.0) - 0.5 * x[:, 0]))
    assert float(budget.potential_energy(make_model(scene), make_state(scene))) == pytest.approx(expected, rel=1e-12)
