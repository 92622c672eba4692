"""A gas whose smoothing lengths follow its density: sums and forces, Sedov's blast, gradients, what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses
from poured import changed
from test_sph_commands import invoke as command
from test_sph_commands import read_table

from experiments.sph import answers
from experiments.sph.validation import CASES, Seen
from jfrnn.cases import fluids
from jfrnn.sph import budget, gas, health, probes, snapshots, solver
from jfrnn.sph.errors import SceneError
from jfrnn.sph.model import make_model, make_state

GAMMA, RATIO = 1.4, 1.3
RANDOM = np.random.default_rng(0)
CLOUD = fluids.GasScene(
    name="cloud",
    positions=RANDOM.normal(size=(40, 2)),  # dense in its middle, thin around it
    velocities=RANDOM.normal(size=(40, 2)),
    masses=RANDOM.uniform(0.5, 1.5, 40) / 40,
    spacing=0.3,
    duration=1.0,
    step=0.005,
    physics=fluids.Gas(heat_ratio=GAMMA, smoothing_ratio=RATIO),
    energies=RANDOM.uniform(1, 2, 40),
)
LOSSLESS, VISCOUS = (changed(CLOUD, artificial=alpha) for alpha in (0.0, 1.0))  # one program


def density_of(r, h, masses):
    """Return Σ m W of distances [n, n], the Wendland kernel C2 of each row's h."""
    q = r / h[:, None]
    return (7 / (4 * np.pi) / h[:, None] ** 2 * np.maximum(1 - q / 2, 0) ** 4 * (2 * q + 1)) @ masses


def densities(x, masses):
    """Return densities and lengths such that ρ h² = m η², by bisection."""
    r = np.linalg.norm(x[:, None] - x, axis=2)
    low, high = np.full(len(x), 1e-3), np.full(len(x), 50.0)
    for _ in range(60):
        middle = (low + high) / 2
        short = density_of(r, middle, masses) * middle**2 < masses * RATIO**2
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return masses * (RATIO / middle) ** 2, middle


@pytest.fixture(scope="module")
def begun():
    begin = jax.jit(solver.begin)
    return tuple(begin(make_model(scene, backend="brute"), make_state(scene)) for scene in (LOSSLESS, VISCOUS))


def test_lengths_follow_the_density(begun):
    rho, h = densities(CLOUD.positions, CLOUD.masses)
    assert h.max() / h.min() > 4
    np.testing.assert_allclose(begun[0].gas.h, h, rtol=1e-9)
    np.testing.assert_allclose(gas.density_and_pressure(make_model(CLOUD), begun[0])[0], rho, rtol=1e-9)


def test_forces_are_the_derivative_of_the_energy_at_constant_entropy(begun):
    """Bisected lengths move with the particles, so that this is the energy's whole derivative."""
    x, masses = CLOUD.positions, CLOUD.masses
    entropy = CLOUD.energies / densities(x, masses)[0] ** (GAMMA - 1)
    for i, axis in ((0, 0), (7, 1), (int(np.linalg.norm(x, axis=1).argmax()), 0)):
        energies = []
        for sign in (1, -1):
            moved = x.copy()
            moved[i, axis] += sign * 1e-5
            energies.append(masses @ (entropy * densities(moved, masses)[0] ** (GAMMA - 1)))
        assert begun[0].a[i, axis] * masses[i] == pytest.approx(-(energies[0] - energies[1]) / 2e-5, rel=1e-5, abs=1e-8)


def test_lengths_have_the_derivative_of_those_that_follow_the_density(begun):
    """Of lengths that are right, a pass of Newton's method has the derivative by which they stay so."""
    model, h, along = make_model(LOSSLESS, backend="brute"), begun[0].gas.h, RANDOM.normal(size=CLOUD.positions.shape)

    def lengths(x):
        return gas.improve(model, h, gas.sum_density(model, x, h))

    rates = jax.jit(lambda x, v: jax.jvp(lengths, (x,), (v,))[1])(CLOUD.positions, along)
    more, less = (densities(CLOUD.positions + change * along, CLOUD.masses)[1] for change in (1e-5, -1e-5))
    np.testing.assert_allclose(rates, (more - less) / 2e-5, rtol=1e-6, atol=1e-7)


def test_what_forces_do_is_taken_from_thermal_energy_and_viscosity_heats(begun):
    plain, viscous = begun
    for s in begun:
        power = CLOUD.masses * np.sum(s.v * s.a, axis=1)
        assert np.abs(power).sum() > 1
        assert abs(power.sum() + CLOUD.masses @ s.gas.heating) < 1e-13 * np.abs(power).sum()
        assert np.abs(CLOUD.masses @ s.a).max() < 1e-14 * np.abs(power).sum()
    heat = np.asarray(viscous.gas.heating - plain.gas.heating)
    assert (heat >= -1e-14).all() and heat.max() > 0.1


def test_a_gas_without_viscosity_computes_none():
    lengths = []
    for scene in (CLOUD, VISCOUS):
        model, s = make_model(scene, backend="brute"), make_state(scene)
        lengths.append(str(jax.jit(solver.step).trace(model, s).jaxpr).count(" = "))
    assert lengths[0] < lengths[1] - 10


def test_sedov_constants_jumps_and_mass():
    """Of E = α R^(d+2) ρ/t², α is 0.851072 in space and 0.311357/0.75⁴ in the plane: Kamm & Timmes (2007), LA-UR-07-2849."""
    for dim, alpha in ((3, 0.851072), (2, 0.311357 / 0.75**4)):
        blast = answers.sedov(1.0, dim=dim)
        assert blast.front ** -(dim + 2) == pytest.approx(alpha, rel=1e-4)
        held = np.trapezoid(blast.rho * blast.r ** (dim - 1), blast.r) * dim
        assert held == pytest.approx(blast.front**dim, rel=1e-5)  # what the front has swept
        speed = 2 / (dim + 2) * blast.front
        assert (blast.rho[-1], blast.v[-1], blast.p[-1]) == pytest.approx((6, speed / 1.2, speed**2 / 1.2))
    refuses(ValueError, "heat_ratio must be above 1 and below 2, got 2", answers.sedov, 1.0, heat_ratio=2.0)


def test_the_exact_blast_meets_its_targets_and_another_misses_them():
    scene, case = fluids.gas("sedov"), CASES["sedov"]
    r = np.linalg.norm(scene.positions, axis=1)
    for factor, met in ((1.0, True), (1.15, False)):
        seen = []
        for time in case.times:
            blast = answers.sedov(factor * time)
            rho, speed = np.interp(r, blast.r, blast.rho, right=1.0), np.interp(r, blast.r, blast.v, right=0.0)
            v = (scene.positions / r[:, None] + (factor - 1) * RANDOM.normal(size=scene.positions.shape)) * speed[:, None]
            kinetic = scene.masses @ (v**2).sum(axis=1) / 2
            seen.append(Seen(time, scene.positions, v, 0 * r, kinetic, 0.0, rho, factor - kinetic, 30.0))
        front, density, _, sideways, energy, resolution = case.judge(scene, seen)[0]
        assert [figure.met for figure in (front, density, sideways, energy, resolution)] == [met] * 4 + [True]


def speed_up(scene, steps, segments):
    """Return the kinetic energy at the end as a function of the factor of all thermal energies at first."""
    model, s = make_model(scene, backend="brute"), make_state(scene)

    def kinetic(factor):
        hot = s._replace(gas=s.gas._replace(u=factor * s.gas.u))
        return budget.kinetic_energy(model, solver.rollout(model, solver.begin(model, hot), steps, None, segments)[0])

    return jax.jit(jax.value_and_grad(kinetic))


@pytest.mark.slow
@pytest.mark.parametrize("step", [2e-3, None])
def test_gradients_through_a_blast_are_those_of_differences(step):
    scene = fluids.gas("sedov", nx=8, step=step)
    kinetic = speed_up(scene, 20, 5)
    slope, more, less = float(kinetic(1.0)[1]), *(float(kinetic(1 + change)[0]) for change in (1e-4, -1e-4))
    assert slope > 0.05
    assert slope == pytest.approx((more - less) / 2e-4, rel=1e-6)


@pytest.mark.slow
def test_a_blast_is_alike_at_any_energy():
    """E R⁻⁴ t² is a constant: at one time, with steps that scale, all energies are a fixed share of the first."""
    scene = fluids.gas("sedov", nx=24)
    model, share = make_model(scene), []
    for factor in (1.0, 4.0):
        hot = replace(scene, energies=factor * scene.energies)
        s, *_ = solver.advance_until(model, jax.jit(solver.begin)(model, make_state(hot)), None, 0.1 / np.sqrt(factor))
        share.append(float(budget.kinetic_energy(model, s)) / factor)
    assert share[0] == pytest.approx(share[1], rel=1e-9)


@pytest.mark.slow
def test_a_blast_in_space_keeps_its_energy():
    scene = fluids.gas("sedov", nx=12, dim=3)
    model = make_model(scene)
    s, *_ = solver.advance_until(model, jax.jit(solver.begin)(model, make_state(scene)), None, 0.05)
    assert sum(map(float, solver.energies(model, s).values())) == pytest.approx(1, abs=1e-3)
    assert float(jnp.max(gas.density_and_pressure(model, s)[0])) > 2


@pytest.mark.parametrize("heat", [1e-2, 1e-8])
def test_cold_clouds_that_meet_keep_their_energy(heat):
    """Before they meet, neither sound nor the divergence of the flow says how soon they do."""
    blocks = [fluids.lattice((place, 0.0), (8, 8), 0.05) for place in (0.0, 0.6)]
    x, drift = np.concatenate(blocks), np.array([[100.0, 0.0]])  # the same as seen by who flies past
    scene = fluids.GasScene(
        name="clouds",
        positions=x,
        velocities=drift + np.where(np.arange(len(x))[:, None] < 64, 1.0, -1.0) * [1.0, 0.0],
        masses=np.full(len(x), 0.05**2),
        spacing=0.05,
        duration=0.2,
        step=None,
        physics=fluids.Gas(heat_ratio=GAMMA, smoothing_ratio=RATIO, artificial=1.0),
        energies=np.full(len(x), heat),
    )
    model = make_model(scene)
    first = jax.jit(solver.begin)(model, make_state(scene))
    s, _, steps = solver.advance_until(model, first, None, scene.duration)
    before, after = (sum(map(float, solver.energies(model, each._replace(v=each.v - drift)).values())) for each in (first, s))
    assert after == pytest.approx(before, rel=1e-2) and steps < 100
    assert s.gas.u.max() > 0.1


def invoke(*arguments):
    return command("run", "sedov", *arguments)[2]


def test_a_snapshot_holds_a_gas_and_a_line_its_energies(begun, tmp_path):
    model, s = make_model(VISCOUS), begun[1]
    snapshots.save(s, VISCOUS, *map(np.asarray, gas.density_and_pressure(model, s)), tmp_path, 3)
    again, step = snapshots.latest(tmp_path, VISCOUS)
    assert step == 3
    jax.tree.map(np.testing.assert_array_equal, again, s)
    line = snapshots.energies(model, s, VISCOUS)
    kinetic, heat = VISCOUS.masses @ (VISCOUS.velocities**2).sum(axis=1) / 2, VISCOUS.masses @ VISCOUS.energies
    assert (line["kinetic"], line["thermal"], line["total"]) == pytest.approx((kinetic, heat, kinetic + heat))
    assert line["resolution"] == float(s.gas.h.max() / s.gas.h.min())
    assert health.complaint(VISCOUS, s) is None
    ill = s._replace(gas=s.gas._replace(u=s.gas.u.at[5].set(jnp.nan)))
    assert health.complaint(VISCOUS, ill) == "particle 5 has thermal energy nan"


@pytest.mark.slow
def test_a_run_tells_its_energies_and_goes_on(tmp_path):
    short = ("--set", "nx=8", "--frames", 2, "--no-pictures", "--out", tmp_path)
    invoke("--set", "duration=0.04", *short)
    of, text = read_table(tmp_path / "energies.csv"), (tmp_path / "energies.csv").read_text()
    assert of["kinetic"][-1] > 0.03
    np.testing.assert_allclose(of["kinetic"] + of["thermal"], 1.0, atol=1e-3)
    np.testing.assert_allclose(of["total"], of["kinetic"] + of["thermal"], rtol=1e-11)
    assert of["resolution"][-1] > of["resolution"][0] >= 1
    last = sorted((tmp_path / "snapshots").glob("*.npz"))[-1]
    last.unlink()
    invoke("--set", "duration=0.04", *short)
    assert (tmp_path / "energies.csv").read_text() == text


def test_what_a_gas_has_not_is_refused(begun, tmp_path):
    with pytest.raises(ValueError, match="wall must be None in a scene of a gas, which is in open space"):
        make_model(replace(CLOUD, wall=np.zeros(40, bool)))
    model, s = make_model(CLOUD), begun[0]
    refuses(SceneError, "pressure_at is a probe of fluids, got a gas", probes.pressure_at([(0.0, 0.0)]), model, s)
    refuses(SceneError, "force_on_walls is a probe of fluids, got a gas", probes.force_on_walls(), model, s)
    said = invoke("--neighbors", "list", "--out", tmp_path)
    assert "neighbors 'list': which pairs scene 'sedov' has changes in every step" in said
    assert "says nothing of thermal energies" in invoke("--initial", tmp_path / "x.csv")
    refuses(ValueError, "name must be a known scene of a gas, got 'sea': take one of sedov", fluids.gas, "sea")
