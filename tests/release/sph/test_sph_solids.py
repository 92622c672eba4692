"""Walls of triangles: nothing passes them, they push as a half-space of fluid does, and runs beside them can be differentiated."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses, slow
from matplotlib.path import Path as Outline
from poured import changed, scene_of
from test_sph_commands import invoke, read_table

from experiments.sph import answers, scenes
from jfrnn.cases import fluids, meshes
from jfrnn.sph import budget, force_on_solid, health, solids, solver, view
from jfrnn.sph.errors import SceneError
from jfrnn.sph.inside import find_inside
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.model import make_model, make_state

TURNS = fluids.Turning((0.1, -0.2, 0.3), (1.0, 2.0, -0.5), 3.0)


def winding_number(points, corners):
    """Return how often triangles [f, 3, 3] go around points [n, 3]. Source: van Oosterom & Strackee (1983)."""
    r = corners[None] - points[:, None, None]
    length = np.linalg.norm(r, axis=-1)
    volume = np.einsum("nfk,nfk->nf", r[:, :, 0], np.cross(r[:, :, 1], r[:, :, 2]))
    dots = [np.einsum("nfk,nfk->nf", r[:, :, i], r[:, :, j]) * length[:, :, k] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
    return np.arctan2(volume, length.prod(axis=-1) + sum(dots)).sum(axis=1) / (2 * np.pi)


def is_inside(x, scene, time):
    """Say which particles are in the solid of a scene, without the code under test."""
    corners = view.turn_vertices(scene.solid.vertices, scene.solid.turning, time)[scene.solid.faces]
    if scene.dim == 3:
        return np.abs(winding_number(np.asarray(x, np.float64), corners)) > 0.5
    return Outline(corners[:, 0]).contains_points(x)


def beside(solid, positions, spacing=0.1, velocities=None, **physics):
    """Return a scene of particles around a solid."""
    made = fluids.Physics(**{"density": 1.0, "sound_speed": 10.0, "smoothing": 1.5 * spacing, "pressure": "mean"} | physics)
    given = {} if velocities is None else {"velocities": velocities}
    return scene_of(positions, spacing, made, step=0.25 * made.smoothing / (1.2 * made.sound_speed), solid=solid, **given)


@pytest.mark.parametrize("name", ["wendland2", "wendland6", "cubic", "quintic"])
def test_kernels_behind_a_plane(name, dim):
    kernel, h = KERNELS[name], 0.13
    reach = kernel.support * h
    d = jnp.linspace(0, 1, 9) * reach
    area, weight = solids.integrate_missing(kernel, d, h, dim)
    t = (np.arange(200_000) + 0.5) / 200_000 * reach
    rings = {2: 2 * np.ones_like(t), 3: 2 * np.pi * t}[dim] * reach / len(t)
    expected = [np.sum(rings * np.asarray(kernel.value(jnp.sqrt(k**2 + t**2), h, dim))) for k in d]
    np.testing.assert_allclose(area, expected, atol=2e-3 * float(area[0]))
    assert float(weight[0]) == pytest.approx(0.5, abs=2e-3)  # half of space
    fine = jnp.linspace(0, 1, 4001) * reach
    slopes = np.trapezoid(np.asarray(solids.integrate_missing(kernel, fine, h, dim)[0]), fine)
    assert slopes == pytest.approx(float(weight[0]), abs=2e-3)


def test_a_lattice_beside_a_wall_feels_no_gradient():
    """Gradients of the kernel over a lattice that ends at a plane, and the plane's integral, cancel."""
    spacing, h, kernel = 0.1, 0.15, KERNELS["wendland2"]
    places = np.meshgrid(np.arange(-6, 7), np.arange(-6, 7), np.arange(8) + 0.5, indexing="ij")
    sites = np.stack(places, -1).reshape(-1, 3) * spacing
    for layer in range(3):
        here = np.array([0, 0, (layer + 0.5) * spacing])
        r = sites - here
        pull = np.asarray(kernel.pull(jnp.asarray(np.linalg.norm(r, axis=1)), h, 3))
        fluid = -(spacing**3 * pull[:, None] * r).sum(axis=0)[2]
        wall = -float(solids.integrate_missing(kernel, jnp.asarray(here[2:]), h, 3)[0][0])
        scale = float(solids.integrate_missing(kernel, jnp.zeros(1), h, 3)[0][0])
        assert abs(fluid + wall) < 0.04 * scale, layer  # what sums differ from integrals


@pytest.mark.parametrize("dim", [2, 3])
def test_frames_turn_back(dim):
    turning = TURNS if dim == 3 else fluids.Turning((0.1, -0.2), None, 3.0)
    x = np.random.default_rng(0).normal(size=(20, dim))
    scene = beside(fluids.Solid(x, np.zeros((0, dim), np.int32), turning), x)
    there = solids.turning_of(scene, np.float64)
    moved = view.turn_vertices(x, turning, 0.7)
    assert np.ptp(np.linalg.norm(moved - x, axis=1)) > 0.1
    np.testing.assert_allclose(solids.into_frame(jnp.asarray(moved), there, 0.7 * 3.0), x, atol=1e-14)


def test_a_wall_drags_by_the_dynamic_viscosity_of_the_source():
    """μ = ρν of "source" and ν of "morris" are the same fluid, and do the same to a wall that turns."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    sides = np.stack([np.arange(4), (np.arange(4) + 1) % 4], axis=1)
    solid = fluids.Solid(square, sides, fluids.Turning((0.0, 0.0), None, 2.0))
    x, rho, found = np.array([[1.07, 0.2], [0.3, 1.1]]), jnp.asarray([800.0, 1100.0]), []
    for form, viscosity in (("morris", 1.0), ("source", 1000.0)):
        scene = beside(solid, x, velocities=0.3 * x, density=1000.0, viscosity=viscosity, viscosity_form=form)
        model, s = make_model(scene), make_state(scene)
        onto, _ = solids.load(model, s, s.solid, rho, 0 * rho)
        found.append(np.asarray(onto) * (1 if form == "morris" else np.asarray(rho)[:, None] / 1000.0))
        step = float(solver.courant(model, s._replace(v=0 * s.v, solid=None)))
        assert step == pytest.approx(0.125 * 0.15**2 / 1.0)
    np.testing.assert_allclose(*found, rtol=1e-6)
    assert np.abs(found[0]).max() > 1.0
    ball = beside(None, np.zeros((1, 3)), viscosity=1.0, viscosity_form="source")
    refuses(SceneError, "pressure and viscosity_form 'source' are forms in 2D", make_model, ball)


SHARP = meshes.gear(6, 200, 1.0, 2.0, 3.0)


@pytest.mark.parametrize("turning", [fluids.Turning((0.0,) * 3, (0.0, 0.0, 1.0), 2.0), slow(None)])
def test_nothing_passes_however_it_is_thrown(turning):
    """Particles thrown about at random around a gear with few, sharp teeth, many of them farther than its walls are thick."""
    random = np.random.default_rng(1)
    low, high = SHARP[0].min(axis=0) - 0.3, SHARP[0].max(axis=0) + 0.3
    scene = beside(fluids.Solid(*SHARP, turning, thin=False), random.uniform(low, high, (400, 3)), 0.2)
    outside = ~is_inside(scene.positions, scene, 0.0)
    apart = np.array([np.min(np.linalg.norm(SHARP[0][SHARP[1]].mean(axis=1) - x, axis=1)) for x in scene.positions])
    scene = replace(beside(scene.solid, scene.positions[outside & (apart > 0.1)], 0.2), step=0.05)
    signed = solids.clearance(scene, safe_state(scene))
    free = scene.positions[signed > 0.05]
    scene = beside(scene.solid, np.resize(free, scene.positions.shape), 0.2)  # some twice: of one size, programs are used again
    model, s = make_model(scene), make_state(scene)
    out = jax.jit(lambda s, x, v: solids.keep_out(model, s, x, v, jnp.asarray(0.02), None))
    touched = 0
    for k in range(10):
        throw = random.normal(size=s.x.shape) * random.choice([0.02, 0.1, 0.5], (len(s.x), 1))
        s = out(s, s.x + throw, s.v)
        touched += int(np.sum(solids.clearance(scene, s) < 1.01 * solids.GAP * scene.spacing))
        assert not s.solid.tri.overflow
        assert solids.clearance(scene, s).min() > 0.49 * solids.GAP * scene.spacing
        if k % 5 == 4:
            assert not is_inside(s.x, scene, 0.02 * (k + 1)).any()
    assert touched > 50


@pytest.mark.parametrize("turning", [slow(None), fluids.Turning((1.5, 0.5), None, 2.0)])
def test_a_solid_in_a_periodic_box_meets_every_image_of_the_fluid(turning):
    """Fluid that begins some periods farther along moves likewise, and feels the solid likewise; else it would go through."""
    corners, dx = np.array([[1.3, 0.4], [1.6, 0.4], [1.6, 0.7], [1.3, 0.7]]), 0.05
    x = fluids.lattice((0, 0), (40, 20), dx)
    x = x[np.linalg.norm(x - [1.5, 0.5], axis=1) > 0.27 + dx]
    solid = fluids.Solid(corners, np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32), turning)
    box = fluids.Periodic((0.0, 0.0), (2.0, 1.0), (True, True))
    wind = {"velocities": np.tile([1.0, 0.0], (len(x), 1)), "viscosity": 0.01}
    near = replace(beside(solid, x, dx, **wind), periodic=box)
    moved = np.random.default_rng(3).integers(-2, 3, x.shape) * np.array(box.lengths)
    far = replace(near, positions=x + moved)
    probe, ends = force_on_solid(), []
    for scene in (near, far):
        model = make_model(scene)
        s, _ = solver.advance(model, solver.begin(model, make_state(scene)), None, 100)
        assert health.complaint(scene, s) is None
        assert not is_inside(view.wrap_positions(scene, np.asarray(s.x)), scene, float(s.time)).any()
        ends.append((np.asarray(s.x), np.asarray(s.v), probe(model, s)))
    (one, speed, onto), (other, likewise, onto_too) = ends
    np.testing.assert_allclose(other - moved, one, atol=1e-8)
    np.testing.assert_allclose(likewise, speed, atol=1e-6)
    np.testing.assert_allclose(onto_too["torque"], onto["torque"], rtol=1e-5)
    assert np.linalg.norm(onto["force"]) > 0.01
    refuses(
        SceneError,
        "periodic box must be .* m wide along y beside this solid, so that no particle is within reach of two images",
        make_model,
        replace(near, periodic=fluids.Periodic((0.0, 0.0), (2.0, 0.5), (True, True))),
    )
    deep = replace(near, positions=np.concatenate([x, [[3.45, 0.55]]]), masses=np.resize(near.masses, len(x) + 1))
    deep = replace(deep, velocities=np.zeros((len(x) + 1, 2)))
    refuses(SceneError, rf"particle {len(x)} is not", make_state, deep)


def test_any_point_of_the_axis_is_a_center():
    """In a periodic box, too; and a corner that no face names is no part of the solid."""
    vertices, faces = meshes.gear(6, 200, 1.0, 2.0, 0.5)
    vertices, spacing, found = np.concatenate([vertices, np.full((1, 3), 50.0)]), 0.2, []
    grid = np.stack(np.meshgrid(*[np.arange(-4.6, 4.6, spacing)] * 2, indexing="ij"), -1).reshape(-1, 2)
    grid = grid[np.abs(np.linalg.norm(grid, axis=1) - 4.35) < 0.25][::2]
    x = np.concatenate([np.pad(grid, ((0, 0), (0, 1)), constant_values=z) for z in (-0.6, 0.1)])
    box = fluids.Periodic((-5.0, -5.0, -1.7), (10.0, 10.0, 3.4), (True,) * 3)
    for away, turns in ((0.0, 0), (37.0, 1)):
        turning = fluids.Turning((0.0, 0.0, away), (0.0, 0.0, 3.0), 2.0)
        scene = replace(beside(fluids.Solid(vertices, faces, turning), x + turns * np.array(box.lengths), spacing), periodic=box)
        model, s = make_model(scene), make_state(scene)
        assert float(solids.rim_speed(model, s.solid)) == pytest.approx(
            2.0 * np.linalg.norm(vertices[faces][..., :2], axis=2).max()
        )
        found.append(solids.clearance(scene, s))
    assert np.isfinite(found[0]).sum() > 20
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


def bars(low, high, *heights):
    """Return the corners and sides of rectangles from x = low to high, between pairs of heights."""
    corners = np.concatenate([[[low, a], [high, a], [high, b], [low, b]] for a, b in heights])
    return corners, np.arange(len(corners)).reshape(-1, 4)[:, [[0, 1], [1, 2], [2, 3], [3, 0]]].reshape(-1, 2).astype(np.int32)


def test_walls_run_straight_through_a_periodic_box():
    """A channel is the same for fluid anywhere along it; what is not straight, or is thin, or ends at the border, is refused."""
    dx, box = 0.05, fluids.Periodic((0.0, 0.0), (0.5, 1.0), (True, False))
    x = fluids.lattice((0, 0.3), (10, 8), dx)
    jitter = np.random.default_rng(2).uniform(-0.2, 0.2, x.shape) * dx
    wind = {"velocities": np.tile([1.0, 0.2], (len(x), 1)), "viscosity": 0.01}
    channel, ends = fluids.Solid(*bars(-0.3, 0.8, (-0.1, 0.3), (0.7, 1.1))), []
    for moved in (0.0, 1.21):
        scene = replace(beside(channel, x + jitter + [moved, 0.0], dx, **wind), periodic=box)
        model = make_model(scene)
        s, _ = solver.advance(model, solver.begin(model, make_state(scene)), None, 120)
        assert health.complaint(scene, s) is None
        ends.append((np.asarray(s.x) - [moved, 0.0], np.asarray(s.v)))
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-6)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-4)
    assert np.ptp(ends[0][0][:, 0] - x[:, 0]) > 0.05  # walls drag

    def with_solid(corners, sides, turning=None):
        return replace(scene, solid=fluids.Solid(corners, sides, turning))

    short = bars(0.0, 0.5, (-0.1, 0.3), (0.7, 1.1))
    askew = channel.vertices + np.array([0.0, 0.01]) * (channel.vertices[:, :1] > 0)
    refused = [short, (askew, channel.faces), (*short, fluids.Turning((0.0, 0.0), None, 1.0))]
    for each in refused:
        refuses(
            SceneError,
            "periodic box must be .* runs straight through the box, at both ends at least",
            make_model,
            with_solid(*each),
        )
    thin = with_solid(*bars(-0.3, 0.8, (0.2, 0.27)))
    refuses(SceneError, "solid is thinner than the kernel reaches, and may not run through a periodic box", make_state, thin)


@pytest.mark.parametrize(("axis", "fits"), [((0.0, 0.0, 2.0), True), ((0.0, 0.1, 1.0), False)])
def test_shafts_run_through_a_periodic_box_along_their_axis(axis, fits):
    shaft = fluids.Solid(*meshes.gear(6, 200, 1.0, 2.0, 0.5), fluids.Turning((0.0, 0.0, 5.0), axis, 1.0))
    scene = replace(
        beside(shaft, np.array([[4.8, 4.8, 0.0]]), 0.1), periodic=fluids.Periodic((-5.0,) * 3, (10.0, 10.0, 1.3), (True,) * 3)
    )
    if fits:
        make_model(scene)
    else:
        refuses(SceneError, "periodic box must be .* m wide along z beside this solid", make_model, scene)


def safe_state(scene):
    """Return a state of positions that may be anywhere."""
    far = replace(scene, positions=scene.positions + 100)
    s = make_state(far)
    x = jnp.asarray(scene.positions)
    return s._replace(x=x, solid=s.solid._replace(tri=s.solid.tri.update(x)))


def drop_on_gear(nx=10, **physics):
    """A square of fluid that falls onto a turning gear in 2D."""
    spacing = 2.0 / nx
    grid = np.stack(np.meshgrid(np.arange(nx) + 0.5, np.arange(nx) + 0.5), axis=-1).reshape(-1, 2) * spacing + [-1.0, 5.3]
    solid = fluids.Solid(*meshes.gear_outline(8), fluids.Turning((0.0, 0.0), None, -0.8))
    return beside(solid, grid, spacing, np.tile([0.3, -3.0], (len(grid), 1)), sound_speed=50.0, density_diffusion=0.1, **physics)


@pytest.mark.slow
def test_a_drop_on_a_turning_gear():
    scene = drop_on_gear(viscosity=0.05, gravity=(0.0, -1.0), artificial=0.1)
    model, s = make_model(scene), make_state(scene)
    s = solver.begin(model, s)
    for _ in range(5):
        s, _ = solver.advance(model, s, None, 60)
        assert health.complaint(scene, s) is None
        assert not is_inside(s.x, scene, float(s.time)).any()
    assert float(s.solid.angle) == pytest.approx(-0.8 * float(s.time))
    assert solids.clearance(scene, s).min() < scene.spacing  # it is there
    assert np.linalg.norm(s.v, axis=1).max() < 6.0
    assert not s.solid.tri.overflow


@pytest.mark.slow
def test_energy_and_momentum_beside_a_wall_that_stands():
    """A square of fluid thrown at a flat wall: what is lost is lost to the wall, and nothing is gained along it."""
    scene = drop_on_gear(8)
    block = np.array([[-9.0, -1], [9, -1], [9, 0], [-9, 0]]), np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32)
    scene = replace(scene, positions=scene.positions - [0, 5.2], solid=fluids.Solid(*block))
    model, s = make_model(scene), make_state(scene)
    s = solver.begin(model, s)
    total = lambda s: float(budget.kinetic_energy(model, s) + budget.internal_energy(model, s))  # noqa: E731
    first, along = total(s), float(budget.momentum(model, s)[0])
    energies = []
    for _ in range(6):
        s, _ = solver.advance(model, s, None, 40)
        energies.append(total(s))
    assert max(energies) < 1.02 * first
    assert min(energies) > 0.1 * first
    assert float(budget.momentum(model, s)[0]) == pytest.approx(along, rel=1e-9)  # the wall is smooth
    assert float(budget.momentum(model, s)[1]) > -0.5 * 3.0 * scene.masses.sum()  # it has stopped, or turned back
    assert np.asarray(s.x)[:, 1].min() > 0


def test_the_torque_on_a_rotor():
    """Of Couette's flow it is known, and converges with the particles; fluid that turns with the rotor does nothing to it."""
    scene = scenes.rotor(16)
    model, s, r = make_model(scene), make_state(scene), np.linalg.norm(scene.positions, axis=1)
    rod, probe = (scenes.RATE, scenes.INNER, scenes.OUTER), jax.jit(force_on_solid())
    torque = answers.rotor_torque(scenes.FRICTION, *rod)
    for speed, known, off in ((answers.rotor(r, *rod), -torque, 0.05), (scenes.RATE * r, 0, 0.001)):
        v = (speed / r)[:, None] * np.stack([-scene.positions[:, 1], scene.positions[:, 0]], axis=1)
        found = probe(model, s._replace(v=jnp.asarray(v)))
        assert found["torque"] == pytest.approx(known, abs=off * torque)
        np.testing.assert_allclose(found["force"], 0, atol=1e-3 * torque)


@pytest.mark.slow
def test_a_column_at_rest_on_a_wall():
    """Water that stands in an open tank of segments, whose inside is the fluid's side: its weight is borne."""
    spacing = 0.1
    tank = np.array([[0, 0], [1, 0], [1, 2], [1.5, 2], [1.5, -1], [-0.5, -1], [-0.5, 2], [0, 2.0]])
    sides = np.stack([np.arange(8), (np.arange(8) + 1) % 8], axis=1)[:, ::-1].astype(np.int32)
    water = np.stack(np.meshgrid(np.arange(10) + 0.5, np.arange(10) + 0.5), axis=-1).reshape(-1, 2) * spacing
    scene = beside(fluids.Solid(tank, sides), water, spacing, gravity=(0.0, -1.0), sound_speed=15.0, density_diffusion=0.1)
    scene = changed(replace(scene, densities=1 + (1 - water[:, 1]) / 15.0**2), damping=10.0, state="linear")
    model, s = make_model(scene), make_state(scene)
    s, _ = solver.advance(model, solver.begin(model, s), None, 600)
    assert np.asarray(s.x).mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.03)
    assert np.abs(np.asarray(s.v)).max() < 0.15
    depth, p = 1 - np.asarray(s.x)[:, 1], 15.0**2 * (np.asarray(s.rho) - 1)
    middle = np.abs(np.asarray(s.x)[:, 0] - 0.5) < 0.25  # in concave corners, one wall of two pushes
    assert np.abs(p - depth)[middle].max() < 0.15


@pytest.mark.slow
def test_gradients_through_contact():
    """Of how far a square of fluid goes that meets a turning wall, in its velocity and in the rate at which the wall turns."""
    scene = replace(drop_on_gear(4, viscosity=0.05), positions=drop_on_gear(4).positions - [0, 0.1])
    model, s = make_model(scene), make_state(scene)
    weights = jnp.asarray(np.random.default_rng(5).normal(size=s.x.shape))

    @jax.jit
    def end(push, rate):
        here = replace(model, turning=replace(model.turning, rate=rate))
        s2, _ = solver.rollout(here, solver.begin(here, s._replace(v=s.v * (1 + push))), 24, None, 4)
        return jnp.sum(weights * s2.x) + 0.01 * jnp.sum(weights * s2.v), s2.solid.mask.sum()

    at = (jnp.zeros(()), model.turning.rate)
    slopes = jax.jit(jax.grad(lambda *at: end(*at)[0], (0, 1)))(*at)
    assert int(end(*at)[1]) > 0
    for k in range(2):
        up, down = (tuple(x + sign * 1e-6 * (j == k) for j, x in enumerate(at)) for sign in (1, -1))
        assert float(slopes[k]) == pytest.approx(float(end(*up)[0] - end(*down)[0]) / 2e-6, rel=1e-5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"kernel": "poly6"}, "kernel must be 'cubic' or .* or 'wendland6' beside a solid, got 'poly6'"),
        ({"evolve": "summation"}, "evolve must be 'continuity' beside a solid, got 'summation'"),
        ({"shifting": 0.1}, "shifting must be None beside a solid"),
        ({"pressure": "difference"}, "pressure must be 'mean' or 'symmetric' or 'volume' beside a solid"),
        ({"corrected": True}, "corrected must be False beside a solid"),
    ],
)
def test_what_does_not_go_with_a_solid_is_refused(change, match):
    refuses(ValueError, match, make_model, changed(drop_on_gear(2), **change))


def test_fluid_in_the_solid_and_open_meshes_are_refused():
    scene = drop_on_gear(2)
    with pytest.raises(ValueError, match=r"positions of the fluid must be outside the solid by 0.1 spacings: particle 0 is not"):
        make_state(replace(scene, positions=scene.positions - [0, 1.8]))
    large = replace(scene.solid, vertices=20 * scene.solid.vertices)  # so that the drop is deep in it, and sees no face
    with pytest.raises(SceneError, match=r"particle 0 is not. If it seems to be, the faces of the solid are inside out"):
        make_state(replace(scene, solid=large))
    with pytest.raises(ValueError, match="solid must be a closed mesh"):
        make_state(replace(scene, solid=replace(scene.solid, faces=scene.solid.faces[1:])))


def test_fluid_in_a_finely_meshed_solid_is_refused_alike():
    """In the middle of a ball smaller than the cutoff, three times as many triangles are near as anywhere on it."""
    scene = beside(fluids.Solid(*meshes.sphere(0.28, 12)), np.zeros((1, 3)), 0.1)
    refuses(SceneError, r"positions of the fluid must be outside the solid by 0.1 spacings: particle 0 is not", make_state, scene)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("around", [False, True])
def test_which_points_are_far_inside(dim, around):
    """A ring of two circles, or a ball with a hole like a cube; with faces turned around, the fluid is where the solid was."""
    if dim == 3:
        (ball, faces), (hole, sides) = meshes.sphere(1.0, 24), meshes.cube(0.6, 4)
        vertices, faces = np.concatenate([ball, hole]), np.concatenate([faces, sides[:, ::-1] + len(ball)])
    else:
        angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
        circle, next_one = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.roll(np.arange(90), -1)
        vertices = np.concatenate([circle, 0.4 * circle])
        faces = np.concatenate([np.stack([np.arange(90), next_one], axis=1), 90 + np.stack([next_one, np.arange(90)], axis=1)])
    x = np.random.default_rng(0).uniform(-1.5, 1.5, (800, dim))
    size = np.max(np.abs(x), axis=1) / 0.3 if dim == 3 else np.linalg.norm(x, axis=1) / 0.4
    radius, reach = np.linalg.norm(x, axis=1), 0.05
    far = (np.abs(radius - 1) > 0.1) & (np.abs(size - 1) > 0.3)
    expected = (radius < 1) & (size > 1)
    found = find_inside(x[far], reach, vertices[faces[:, ::-1] if around else faces])
    np.testing.assert_array_equal(found, expected[far] != around)
    assert 20 < expected[far].sum() < far.sum() - 20


@pytest.mark.parametrize("integrator", ["symplectic", "midpoint"])
def test_a_fluid_that_tears_keeps_its_density_where_it_is_stretched(integrator):
    apart = np.array([[-0.1, 0, 0], [0.1, 0, 0]])
    least = []
    for tears in (True, False):
        scene = replace(beside(None, apart, 0.2, 2.0 * apart, tears=tears, integrator=integrator), solid=None)
        model, s = make_model(scene), make_state(scene)
        s, _ = solver.advance(model, solver.begin(model, s), None, 20)
        least.append(float(np.min(s.rho)))
    assert least[0] == 1.0
    assert least[1] < 0.99


@pytest.mark.slow
def test_a_coarse_jet_that_breaks_up_stays_calm():
    """Without `tears`, clumps of stretched particles met each other at a thousand times the speed of the jet."""
    scene = fluids.fluid("jet-gear", layers=8, duration=2.8e-3)
    model, s = make_model(scene), make_state(scene)
    s = jax.jit(solver.begin)(model, s, None)
    while float(s.time) < scene.duration:
        s, _ = solver.advance(model, s, None, 200)
        assert health.complaint(scene, s) is None
        assert np.linalg.norm(s.v, axis=1).max() < 60  # the jet has 10 m/s, the tips of the teeth 5.6
    assert solids.clearance(scene, s).min() > 0


@pytest.mark.slow
def test_a_run_of_the_jet_onto_the_gear(tmp_path):
    options = ["jet-gear", "--set", "layers=3", "--set", "faces=400", "--set", "duration=0.0006", "--set", "height=0.001"]
    options += ["--frames", "2", "--dtype", "float32", "--out", str(tmp_path)]
    assert invoke("run", *options)[0] == 0
    table = read_table(tmp_path / "energies.csv")
    assert len(list((tmp_path / "frames").glob("*.png"))) == 3
    assert table["clearance"].min() > 0
    last = sorted((tmp_path / "snapshots").glob("*.npz"))[-1]
    with np.load(last) as saved:
        before = saved["x"]
    last.unlink()
    assert invoke("run", *options)[0] == 0
    with np.load(last) as saved:
        np.testing.assert_allclose(saved["x"], before, atol=1e-6)
