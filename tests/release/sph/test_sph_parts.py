"""Parts of the SPH solver, each alone: kernels, equations of state, terms of pairs, corrections, walls."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow
from poured import changed, scene_of

from jfrnn.cases import fluids
from jfrnn.sph import correction, density, pressure, solver, states, surface, transport, viscosity, walls
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.model import make_model, make_state
from jfrnn.sph.pairs import Pair, total

SMOOTHING = 0.13


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_are_normalized_and_end_at_their_support(name, dim):
    kernel, h = KERNELS[name], SMOOTHING
    r = (np.arange(200_000) + 0.5) / 200_000 * kernel.support * h
    shells = {2: 2 * np.pi * r, 3: 4 * np.pi * r**2}[dim] * kernel.support * h / len(r)
    assert np.sum(shells * np.asarray(kernel.value(jnp.asarray(r), h, dim))) == pytest.approx(1, rel=1e-9)
    beyond = jnp.array([1.0, 1.5]) * kernel.support * h
    assert not np.asarray(kernel.value(beyond, h, dim)).any()
    assert not np.asarray(kernel.slope(beyond, h, dim)).any()


@pytest.mark.parametrize("name", KERNELS)
def test_slopes_are_the_derivatives_of_kernels(name, dim):
    kernel, r = KERNELS[name], jnp.linspace(0.01, 0.999, 50) * KERNELS[name].support * SMOOTHING
    derivative = jax.vmap(jax.grad(lambda r: kernel.value(r, SMOOTHING, dim)))(r)
    np.testing.assert_allclose(kernel.slope(r, SMOOTHING, dim), derivative, rtol=1e-9, atol=1e-9 * float(jnp.abs(derivative).max()))


def test_equations_of_state_and_their_inverses():
    rho = jnp.linspace(980.0, 1050.0, 7)
    np.testing.assert_allclose(states.linear_density(states.linear(rho, 1000.0, 30.0), 1000.0, 30.0), rho, rtol=1e-14)
    np.testing.assert_allclose(states.tait_density(states.tait(rho, 1000.0, 30.0, 7.0), 1000.0, 30.0, 7.0), rho, rtol=1e-14)
    slope = jax.grad(lambda rho: states.tait(rho, 1000.0, 30.0, 7.0))(1000.0)
    assert slope == pytest.approx(30.0**2)


def make_pair(r, name="quintic"):
    return Pair(jnp.asarray(r), KERNELS[name], 0.1)


def particle(m, rho, p, v, w, even, mean):
    """Return what terms read of a particle, whose transport velocity is that of the fluid."""
    given = {"m": m, "rho": rho, "specific": 1 / rho, "volume": m / rho, "p": p, "v": v, "u": v, "w": w, "even": even, "mean": mean}
    return {name: np.asarray(value) for name, value in given.items()}


VALUES = (
    particle(1.1, 900.0, 20.0, [0.1, 0.3], [0.02, 0.0], 1.1, 7.0),
    particle(1.4, 1100.0, -5.0, [-0.4, 0.2], [0.0, -0.01], 0.9, 4.0),
)


def forces(r, i, j):
    """Return the force on i, mass times acceleration."""
    pair = make_pair(r)
    gradient = -pair.pull * pair.r
    terms = {
        **{f"pressure {key}": lambda key=key: pressure.PRESSURES[key](pair, i, j) * gradient for key in pressure.PRESSURES},
        **{f"viscosity {key}": lambda key=key: viscosity.VISCOSITIES[key](pair, i, j, 0.01) for key in viscosity.VISCOSITIES},
        "less the mean pressure": lambda: pressure.volume(pair, *pressure.less_mean(i, j)) * gradient,
        "artificial": lambda: viscosity.artificial(pair, i, j, 3.0) * gradient,
        "cohesion": lambda: surface.cohesion(pair, i, j, 2.0, 0.3),
        "transport": lambda: transport.transport(pair, i, j, 50.0),
        "advected": lambda: transport.advect(pair, i, j, gradient),
    }
    return terms, i["m"]


@pytest.mark.parametrize("name", forces([0.1, 0.05], *VALUES)[0])
def test_forces_of_a_pair_are_opposite_where_a_form_keeps_momentum(name):
    (there, mass_i), (back, mass_j) = forces([0.06, 0.05], *VALUES), forces([-0.06, -0.05], *VALUES[::-1])
    there, back = mass_i * there[name](), mass_j * back[name]()
    assert np.abs(there).max() > 0
    keeps = name not in ("pressure difference", "less the mean pressure")  # as their docstrings say
    assert np.allclose(there, -back, rtol=1e-12, atol=0) == keeps


def test_viscosity_is_that_of_morris():
    """Eq. 22 of Morris, Fox & Zhu (1997), with dynamic viscosities of both particles, by NumPy."""
    (i, j), r, h, nu = VALUES, np.array([0.1, 0.05]), 1e-6, 0.01
    slopes = [float(KERNELS["quintic"].value(jnp.asarray(np.linalg.norm(r) + side * h), 0.1, 2)) for side in (1, -1)]
    gradient = -r / np.linalg.norm(r) * (slopes[0] - slopes[1]) / (2 * h)  # at i, of W(x_i - x_j)
    mu = nu * i["rho"] + nu * j["rho"]
    expected = j["m"] * mu * (-r @ gradient) / (i["rho"] * j["rho"] * (r @ r)) * (i["v"] - j["v"])
    np.testing.assert_allclose(viscosity.morris(make_pair(r), i, j, nu), expected, rtol=1e-7)


def test_pressures_are_those_of_edac_with_a_transport_velocity():
    """Ramachandran & Puri (2019) by NumPy: volumes 1/ΣW, and pressures less the mean over the particles that the kernel reaches."""
    scene = replace(fluids.fluid("taylor-green", nx=8, jitter=0.3, transport=100.0), velocities=np.zeros((64, 2)))
    scene = changed(scene, viscosity=None)
    p = np.random.default_rng(1).normal(1000.0, 1.0, 64)
    model, s = make_model(scene, backend="brute"), make_state(scene)
    a = jax.jit(solver.begin)(model, s._replace(p=jnp.asarray(p))).a
    r = scene.positions[:, None] - scene.positions
    r -= np.round(r)
    distance, kernel, h = np.linalg.norm(r, axis=-1), KERNELS["quintic"], scene.physics.smoothing
    m, near = scene.masses[0], distance < kernel.support * h
    number = kernel.value(jnp.asarray(distance), h, 2).sum(axis=1)  # 1/V
    gradient = np.asarray(kernel.slope(jnp.asarray(distance), h, 2))[..., None] * r / np.maximum(distance, 1e-9)[..., None]
    rho, mean = m * np.asarray(number), (near @ p) / near.sum(axis=1)
    between = rho[None] * (p - mean)[:, None] + rho[:, None] * (p[None] - mean[:, None])
    between /= rho[:, None] + rho
    volumes = (m / rho[:, None]) ** 2 + (m / rho) ** 2
    expected = -np.sum((volumes * between)[..., None] * gradient, axis=1) / m
    np.testing.assert_allclose(a, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", KERNELS)
def test_the_pull_of_a_kernel_is_its_slope_over_the_distance(name):
    r = np.linspace(0.01, 0.35, 60)
    for dim in (2, 3):
        np.testing.assert_allclose(KERNELS[name].pull(r, 0.1, dim), KERNELS[name].slope(r, 0.1, dim) / r, rtol=1e-12)


def test_coincident_particles_have_no_force_and_finite_derivatives():
    def push(r):
        pair = make_pair(r)
        return jnp.sum(pair.pull * pair.r) + pair.weight + pair.distance

    assert np.isfinite(jax.grad(push)(jnp.zeros(2))).all()
    assert not np.asarray(make_pair([0.0, 0.0]).pull * jnp.zeros(2)).any()


def lattice(n, dim, seed=0, jitter=0.1):
    sites = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return jnp.asarray(sites + jitter / n * np.random.default_rng(seed).uniform(-1, 1, sites.shape))


def test_density_of_a_lattice(dim):
    n, kernel = {2: 20, 3: 10}[dim], KERNELS["quintic"]
    x = lattice(n, dim, jitter=0.0)
    inner = (jnp.abs(x - 0.5) < 0.5 - 3 / n).all(axis=1)
    m = jnp.full(len(x), 1.0 / n**dim)
    rho = total(lambda pair, i, j: density.summation(pair, j), x, {"m": m}, kernel, 1 / n, backend="brute")
    rho = rho + m * kernel.value(jnp.zeros(()), 1 / n, dim)
    np.testing.assert_allclose(rho[inner], 1.0, rtol=2e-3)


@pytest.mark.parametrize(("dim", "n", "h", "share"), [(2, 16, 2.0, 0.05), slow(3, 8, 1.5, 0.12)])
def test_continuum_tension_presses_as_laplace_says(dim, n, h, share):
    """Σ m a·x = -∫ d p dV, p = (d-1) σ/R, of a ball whose particles are not in order."""
    spacing, kernel = 1 / n, KERNELS["wendland2"]
    x = lattice(2 * n, dim) * 2 - 1
    x = x[jnp.sum(x**2, axis=1) < 1]
    m, rho = jnp.full(len(x), spacing**dim), jnp.ones(len(x))
    values = {"m": m, "rho": rho}
    normals = total(lambda pair, i, j: surface.inward(pair, j), x, values, kernel, h * spacing)
    directions, known = surface.directions(normals, h * spacing)
    sums = total(surface.bend, x, values | {"normal": directions, "known": known}, kernel, h * spacing)
    a = surface.continuum(sums, normals, known, rho, jnp.asarray(0.3))
    volume = spacing**dim * len(x)
    radius = (volume / {2: np.pi, 3: 4 / 3 * np.pi}[dim]) ** (1 / dim)
    assert jnp.sum(m[:, None] * a * x) == pytest.approx(-dim * (dim - 1) * 0.3 / radius * volume, rel=share)
    assert not np.asarray(a)[np.linalg.norm(x, axis=1) < 1 - 3 * h * spacing].any()
    assert np.isfinite(jax.grad(lambda n: jnp.sum(surface.directions(n, 0.1)[0]))(jnp.zeros((3, dim)))).all()


@pytest.mark.parametrize(("dim", "kernel"), [(2, "wendland2"), (3, "poly6"), slow(2, "poly6"), slow(3, "wendland2")])
def test_corrected_gradients_are_exact_for_linear_fields(dim, kernel):
    """Also those of poly6, which are the spiky kernel's: a = -c² ∇ρ/ρ by the form "difference"."""
    n = {2: 12, 3: 7}[dim]
    x, slope = np.asarray(lattice(n, dim, jitter=0.3)), np.arange(1.0, dim + 1)
    h = {"wendland2": 1.5, "poly6": 3.0}[kernel] / n
    physics = fluids.Physics(density=1.0, sound_speed=2.0, smoothing=h, kernel=kernel, state="linear", corrected=True)
    scene = scene_of(x, 1 / n, physics, densities=1 + 0.1 * x @ slope)
    model, s = make_model(scene, backend="brute"), make_state(scene)
    a = solver.begin(replace(model, physics=replace(model.physics, pressure="difference")), s).a
    np.testing.assert_allclose(a * s.rho[:, None], np.broadcast_to(-0.4 * slope, x.shape), rtol=1e-9)


def test_few_neighbors_leave_gradients_as_they_are():
    moments = jnp.stack([jnp.eye(2), jnp.zeros((2, 2)), 1e-9 * jnp.ones((2, 2))])
    np.testing.assert_array_equal(correction.inverse(moments), jnp.broadcast_to(jnp.eye(2), (3, 2, 2)))


def test_particles_bounce_off_the_tank():
    x, v = jnp.array([[-0.1, 0.5], [0.5, 1.2], [0.5, 0.5]]), jnp.array([[-1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    x, v = walls.bounce(x, v, jnp.zeros(2), jnp.ones(2), jnp.asarray(0.5))
    np.testing.assert_array_equal(x, [[0.0, 0.5], [0.5, 1.0], [0.5, 0.5]])
    np.testing.assert_array_equal(v, [[0.5, 2.0], [3.0, -2.0], [5.0, 6.0]])


def test_walls_show_hydrostatic_pressure_and_hold_the_fluid():
    x = lattice(10, 2, jitter=0.0)
    gravity, wall = jnp.array([0.0, -9.81]), x[:, 1] < 0.3
    p = jnp.where(wall, 0, 1000.0 * 9.81 * (1 - x[:, 1]))
    v = jnp.where(wall[:, None], jnp.array([0.2, 0.0]), jnp.array([1.0, 0.0]))
    values = {"wall": wall, "rho": jnp.full(100, 1000.0), "p": p, "v": v}
    sums = total(walls.wall_terms, x, values, KERNELS["quintic"], 0.1, backend="brute")
    shown, held = walls.extrapolate(sums, v, gravity)
    met = np.asarray(wall & (sums["weight"] > 0))
    assert met.sum() == 20
    np.testing.assert_allclose(shown[met], 1000.0 * 9.81 * (1 - x[met, 1]), rtol=1e-12)
    np.testing.assert_allclose(held[met], np.broadcast_to([-0.6, 0.0], (20, 2)), atol=1e-12)


def test_what_walls_show_has_derivatives_where_they_barely_meet_the_fluid():
    """Weights whose squares are below the least float32 are those of no neighbor."""

    ones = jnp.ones(2, jnp.float32)

    def shown(weight):
        sums = {"weight": weight, "p": weight * 1e3, "v": weight[:, None] * ones, "moment": weight[:, None] * ones}
        pressure, velocity = walls.extrapolate(sums, jnp.zeros((3, 2), jnp.float32), jnp.array([0.0, -9.81], jnp.float32))
        return jnp.sum(pressure) + jnp.sum(velocity)

    weights = jnp.array([1e-30, 1e-15, 1.0], jnp.float32)
    assert np.isfinite(jax.grad(shown)(weights)).all()
    assert np.isfinite(shown(weights))
