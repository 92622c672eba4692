"""Derivatives through whole runs of the SPH solver, against central differences, and the memory that they take."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from poured import changed, scene_of

from jfrnn.cases import fluids
from jfrnn.sph import solver
from jfrnn.sph.model import make_model, make_state

RANDOM = np.random.default_rng(0)
SITES = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2) / 6
PLACES, SPEEDS = SITES + 0.02 * RANDOM.normal(size=SITES.shape), 0.3 * RANDOM.normal(size=SITES.shape)
PHYSICS = fluids.Physics(density=1.0, sound_speed=5.0, smoothing=0.2, state="linear", viscosity=0.1)
BLOB = scene_of(PLACES, 1 / 6, PHYSICS, velocities=SPEEDS, step=2e-3)


def stirred(scene):
    """Return a scene whose fluid moves at random: at rest, artificial viscosity and bounces have kinks."""
    v = 0.1 * scene.physics.sound_speed * np.random.default_rng(1).normal(size=scene.velocities.shape)
    return replace(scene, velocities=scene.velocities + (v if scene.wall is None else v * ~scene.wall[:, None]))


def make_loss(scene, steps, segments, name, backend="brute", skin=None):
    """Return a function of velocities along a direction and of one number of the physics, and where to take its gradient."""
    model, s = make_model(scene, backend=backend), make_state(scene)
    nbrs = None if skin is None else solver.list_neighbors(model, s, skin * scene.spacing)
    weights, along = (jnp.asarray(np.random.default_rng(seed).normal(size=s.v.shape)) for seed in (2, 3))
    if scene.wall is not None:
        along = jnp.where(scene.wall[:, None], 0, along)

    def loss(push, number):
        here = replace(model, physics=replace(model.physics, **{name: number}))
        begun = solver.begin(here, s._replace(v=s.v + scene.physics.sound_speed * push * along), nbrs)
        end, after = solver.rollout(here, begun, steps, nbrs, segments)
        missed = False if after is None else after.overflow
        moved = jnp.sum(weights * end.x) / scene.spacing + jnp.sum(weights * end.v) / model.physics.sound_speed
        return jnp.where(missed, jnp.nan, moved)

    return loss, (jnp.zeros(()), getattr(model.physics, name))


def worst_error(loss, at):
    """Return the larger of both relative errors of a gradient against central differences, each at its best step."""
    both = jax.jit(jax.value_and_grad(loss, (0, 1)))  # one program, compiled once
    gradient, worst = both(*at)[1], 0.0
    for k, scale in enumerate((1.0, float(at[1]))):
        errors = []
        for share in 10.0 ** np.arange(-7, -2):
            ends = [both(*(x + sign * share * scale * (j == k) for j, x in enumerate(at)))[0] for sign in (1, -1)]
            difference = float(ends[0] - ends[1]) / (2 * share * scale)
            errors.append(abs(float(gradient[k]) / difference - 1))
        worst = max(worst, min(errors))
    return worst


def test_ten_steps_over_a_list():
    assert worst_error(*make_loss(BLOB, 10, 2, "viscosity", skin=0.3)) < 1e-8


CASES = {
    "list": (BLOB, 50, 10, "viscosity", {"skin": 0.3}),
    "pair sums": (BLOB, 50, 10, "viscosity", {}),
    "pair sums in kernels": (BLOB, 10, 2, "viscosity", {"backend": "warp"}),
    "a hundred steps": (BLOB, 100, 10, "sound_speed", {"skin": 0.3}),
    "summation, leapfrog": (changed(BLOB, evolve="summation", integrator="leapfrog"), 50, 10, "viscosity", {"skin": 0.3}),
    "midpoint": (changed(BLOB, integrator="midpoint"), 10, 2, "viscosity", {"skin": 0.3}),
    "Courant steps": (replace(BLOB, step=None), 10, 2, "viscosity", {"skin": 0.3}),
    "corrected gradients at a free surface": (changed(BLOB, corrected=True), 50, 10, "viscosity", {"skin": 0.3}),
    "EDAC, corrected, shifted, periodic": (fluids.fluid("taylor-green", nx=8), 50, 10, "viscosity", {"skin": 0.3}),
    "dummies of walls, Tait, artificial viscosity": (
        stirred(fluids.fluid("dam-break-2d", nx=4)),
        50,
        10,
        "artificial",
        {"skin": 0.5},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_runs(name):
    scene, steps, segments, number, how = CASES[name]
    assert worst_error(*make_loss(scene, steps, segments, number, **how)) < 1e-6


@pytest.mark.parametrize("still", [True, False])
def test_the_courant_step_has_a_gradient_where_nothing_moves(still):
    model = make_model(replace(BLOB, step=None), backend="brute")
    s = make_state(BLOB)._replace(a=jnp.full(SITES.shape, 0.0 if still else 1.0))
    slope = jax.grad(lambda v: solver.courant(model, s._replace(v=v)))(jnp.zeros_like(s.v))
    np.testing.assert_array_equal(slope, 0)
    assert np.isfinite(jax.grad(lambda a: solver.courant(model, s._replace(a=a)))(s.a)).all()


@pytest.mark.slow
def test_memory_of_reverse_mode_grows_as_the_root_of_steps():
    def scratch(steps, segments):
        loss, at = make_loss(BLOB, steps, segments, "viscosity", skin=0.3)
        return jax.jit(jax.grad(loss)).lower(*at).compile().memory_analysis().temp_size_in_bytes

    s = make_state(BLOB)
    nbrs = solver.list_neighbors(make_model(BLOB), s, 0.3 * BLOB.spacing)
    carry = sum(leaf.nbytes for leaf in jax.tree.leaves((s, nbrs)))
    few, many, plain = scratch(100, 10), scratch(10_000, 100), scratch(10_000, 1)
    assert many - few < 2.5 * 2 * 90 * carry  # 90 states more between segments, 90 more within one
    assert plain - few > 9_000 * 0.5 * carry


@pytest.mark.parametrize("evolve", ["continuity", "pressure"])
def test_leapfrog_refuses_what_it_does_not_carry(evolve):
    with pytest.raises(ValueError, match=f"carries no density or pressure, got evolve '{evolve}': take evolve 'summation', or"):
        make_model(changed(BLOB, integrator="leapfrog", evolve=evolve))


def test_differences_of_pressure_refuse_a_free_surface():
    with pytest.raises(ValueError, match="pressure 'difference' does not vanish at a free surface, got a scene without walls"):
        make_model(changed(BLOB, pressure="difference"))


@pytest.mark.slow
def test_a_run_says_how_its_list_ended():
    model, s = make_model(BLOB, backend="brute"), make_state(BLOB)
    _, nbrs = solver.rollout(model, solver.begin(model, s), 4, solver.list_neighbors(model, s, 0.01 * BLOB.spacing))
    assert nbrs.rebuild_count > 0
    assert not nbrs.overflow
