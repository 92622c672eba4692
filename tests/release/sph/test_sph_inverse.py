"""Inverse problems through whole runs, and the command that solves them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.sph import gradients, inverse


@pytest.mark.slow
def test_a_viscosity_is_found_from_an_early_profile():
    problem = inverse.viscosity(time=2e-4)
    found = inverse.solve(problem, 12)
    assert found.losses[0] > 0.01
    assert abs(np.exp(found.best[0]) - 1) < 0.07  # the profile is the exact one; 18 particles across see thin layers so well


@pytest.mark.slow
def test_a_jet_tells_its_velocity_by_where_and_when_it_lands():
    problem = inverse.jet()
    found = inverse.solve(problem)
    np.testing.assert_allclose(found.best, problem.known, rtol=1e-4)


@pytest.mark.slow
def test_forces_bring_a_droplet_to_rest_at_its_goal():
    problem = inverse.droplet()
    found = inverse.solve(problem, 14)
    assert found.losses[0] > 10  # it falls where it is
    assert found.loss < 1e-2  # 4 mm, 2 cm/s


@pytest.mark.slow
def test_the_memory_of_gradients_grows_as_the_root_of_steps():
    frame = gradients.memory((100, 1600), nx=4)
    rooted, single = (frame[frame["segments"] > 1], frame[frame["segments"] == 1])
    assert rooted["states"].iloc[1] < 5 * rooted["states"].iloc[0]  # four times, and what a step takes
    assert single["states"].iloc[1] > 10 * single["states"].iloc[0]


def test_a_descent_keeps_what_it_tried():
    def loss(x):
        return jnp.sum((x - jnp.arange(3.0)) ** 2 * jnp.array([1.0, 10.0, 100.0]))

    problem = inverse.Problem("bowl", "place", np.ones(3), loss, np.arange(3.0), 1, 3)
    found = inverse.solve(problem)
    np.testing.assert_allclose(found.best, [0, 1, 2], atol=1e-6)
    assert found.tried.shape == (len(found.losses), 3)
    assert found.losses[0] == pytest.approx(101)
    frame = gradients.table(problem, found, 0.12)
    assert list(frame["known"]) == [0.0, 1.0, 2.0]
    assert gradients.draw(problem, found).get_suptitle().startswith("bowl: ")
    assert jax.config.jax_enable_x64
