"""Scenes with known answers: how each is run, what is measured, and what it has to be."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from experiments._library import taylor_green_velocity
from experiments.sph import answers, scenes
from jfrnn.cases.fluids import FluidScene, GasScene, Scene
from jfrnn.sph import probes, solver
from jfrnn.sph.particles import Flow, State

Curves = dict[str, list[list[float]]]


class Seen(NamedTuple):
    """The fluid at a moment: time [s], positions, velocities, pressures, kinetic and potential energy [J]; no walls.

    A gas has also densities, its thermal energy [J], and its largest smoothing length over the smallest; a fluid beside a wall of
    segments the torque on it [N].
    """

    time: float
    x: np.ndarray
    v: np.ndarray
    p: np.ndarray
    kinetic: float
    potential: float
    rho: np.ndarray | None = None
    thermal: float = 0.0
    resolution: float = 1.0
    torque: float = 0.0


class Figure(NamedTuple):
    """What was measured, and the range in which it has to be."""

    quantity: str
    measured: float
    low: float | None
    high: float

    @property
    def met(self) -> bool:
        """Whether it is in its range; what is not finite is not."""
        return bool((self.low is None or self.measured >= self.low) and self.measured <= self.high)


@dataclass(frozen=True)
class Case:
    """A scene, when it is looked at, and what is said about what was seen.

    Attributes:
        scene: Name of a scene, or what makes one.
        times: When it is looked at [s].
        judge: (scene, what was seen) -> figures, and curves by name, each [x, y], for the picture.
        settings: Of the scene.
        backend: Of `jfrnn.pair_sum`.
        axes: What the picture has along its axes.
        force: An own force, as `make_model` takes it.
    """

    scene: str | Callable[..., FluidScene]
    times: tuple[float, ...]
    judge: Callable[[Any, list[Seen]], tuple[list[Figure], Curves]]
    settings: dict[str, Any] = field(default_factory=dict)
    backend: str = "auto"
    axes: tuple[str, str] = ("time [s]", "energy [J]")
    force: Callable[[State], Array] | None = None


@jax.jit
def _measures(model: Flow, s: State) -> tuple[Array, Array, dict[str, Array]]:
    held = solver.energies(model, s)
    if s.solid is not None:
        held["torque"] = probes.force_on_solid()(model, s)["torque"]
    return *solver.density_and_pressure(model, s), held


def look(scene: Scene, model: Flow, s: State) -> Seen:
    """Return what is to be seen of a state."""
    fluid = np.ones(scene.n, bool) if scene.wall is None else ~scene.wall
    rho, p, energies = _measures(model, s)
    held = {name: float(energies.get(name, 0)) for name in ("kinetic", "potential", "thermal", "torque")}
    x, v, p, rho = (np.asarray(each)[fluid] for each in (s.x, s.v, p, rho))
    return Seen(float(s.time), x, v, p, rho=rho, resolution=1.0 if s.gas is None else float(s.gas.h.max() / s.gas.h.min()), **held)


def relative(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the L2 norm of the difference over that of what is exact."""
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def curve(x: np.ndarray, y: np.ndarray) -> list[list[float]]:
    """Return a curve as lists of five digits."""
    return [[float(f"{value:.5g}") for value in values] for values in (x, y)]


def means(x: np.ndarray, y: np.ndarray, edges: np.ndarray) -> list[list[float]]:
    """Return the mean of y within each pair of edges of x that holds any, over the mean of x there."""
    counts, x_sums, y_sums = (np.histogram(x, edges, weights=weights)[0] for weights in (None, x, y))
    some = counts > 0
    return curve(x_sums[some] / counts[some], y_sums[some] / counts[some])


def few(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Energies of one to four particles; what is below 1 mJ is compared to 1e-12 J."""
    expected = answers.table(f"sph2d_{scene.name}_simultaneous")
    found = np.array([[at.kinetic, at.potential] for at in seen])
    error = np.abs(found - expected[:, 1:3]) / (np.abs(expected[:, 1:3]) + 1e-3)
    curves = {}
    for k, name in enumerate(("kinetic", "potential")):
        curves[f"{name}, measured"] = curve(expected[::10, 0], found[::10, k])
        curves[f"{name}, known"] = curve(expected[:, 0], expected[:, 1 + k])
    return [Figure("energies, largest relative error", float(error.max()), None, 1e-9)], curves


def taylor_green(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Kinetic energy against the exact decay, and the mean error of speeds."""
    times = np.array([at.time for at in seen])
    kinetic, exact = np.array([at.kinetic for at in seen]), 0.25 * np.exp(-16 * np.pi**2 * times / 100)
    last = seen[-1]
    speed, known = (np.linalg.norm(v, axis=1) for v in (last.v, taylor_green_velocity(last.x, last.time, 100.0)))
    l1, coarse = float(np.abs(speed - known).mean() / known.mean()), scene.spacing > 1 / 40
    figures = [
        Figure("kinetic energy, relative error, t = 2", abs(float(kinetic[-1] / exact[-1]) - 1), None, 0.02 if coarse else 0.01),
        Figure("l1 of speed, t = 2", l1, None, 0.04 if coarse else 0.01),
    ]
    return figures, {"measured": curve(times, kinetic), "known": curve(times, exact)}


def vortices_in_3d(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Kinetic energy and its dissipation, between the times looked at, against a computation with a Fourier series."""
    assert scene.physics.viscosity is not None, "what dissipates"
    times, kinetic = 2 * np.pi * np.array([at.time for at in seen]), np.array([at.kinetic for at in seen])
    near = np.round(times / answers.VORTEX_STEP) * answers.VORTEX_STEP  # less than a step of the particles away
    energies, rates = answers.vortices(near, 1 / (2 * np.pi * scene.physics.viscosity))
    known = energies - rates * (times - near)
    found, exact = (-np.diff(each) / np.diff(times) for each in (kinetic, known))
    energy, rate = {16: (0.03, 0.05), 32: (0.01, 0.02)}.get(round(1 / scene.spacing), (0.005, 0.01))
    figures = [
        Figure("kinetic energy, largest relative error, t ≤ 10/kU", float(np.abs(kinetic / known - 1).max()), None, energy),
        Figure("dissipation, relative L2, t ≤ 10/kU", relative(found, exact), None, rate),
        Figure("largest dissipation over known", float(found.max() / exact.max()), 1 - energy, 1 + energy),
    ]
    middles = (times[1:] + times[:-1]) / 2
    return figures, {"measured": curve(middles, found), "known": curve(near, rates)}


def reverse_poiseuille(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Profiles of two flows beside each other, against that between plates."""
    drag = np.pi**2 * scenes.SPEED / scenes.REYNOLDS / scenes.WIDTH

    def exact(y: np.ndarray, time: float) -> np.ndarray:
        y = y / scenes.WIDTH % 2
        return np.where(y < 1, 1, -1) * answers.poiseuille(y % 1, time, scenes.SPEED, drag)

    curves, errors, y = {}, [], np.linspace(0, 1, 81)
    for at in seen:
        known = exact(at.x[:, 1], at.time)
        errors.append(relative(at.v, np.stack([known, 0 * known], axis=1)))
        curves[f"t = {at.time:.2g} s, measured"] = means(at.x[:, 1] % 1, at.v[:, 0], np.linspace(0, 1, 41))
        curves[f"t = {at.time:.2g} s, known"] = curve(y, exact(y, at.time))
    return _of_profiles(seen, errors, 0.02 if scene.spacing > 1 / 40 else 0.01), curves


def _of_profiles(seen: list[Seen], errors: list[float], target: float) -> list[Figure]:
    """Return what is said of profiles, each of which has an error."""
    measured = {f"t = {seen[-1].time:.2g}": errors[-1], "largest of all times": max(errors)}
    return [Figure(f"velocity, relative L2, {when}", error, None, target) for when, error in measured.items()]


def rotor(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Torque on a rod that turns in a tube, and the velocities between them, when the flow is steady."""
    rod = scenes.RATE, scenes.INNER, scenes.OUTER
    last, torque = seen[-1], -answers.rotor_torque(scenes.FRICTION, *rod)
    r = np.linalg.norm(last.x, axis=1)
    around = (last.x[:, 0] * last.v[:, 1] - last.x[:, 1] * last.v[:, 0]) / r
    line = np.linspace(scenes.INNER, scenes.OUTER, 51)
    figures = [
        Figure(f"torque, relative error, t = {last.time:.2g}", abs(last.torque / torque - 1), None, 0.01),
        Figure(f"velocity, relative L2, t = {last.time:.2g}", relative(around, answers.rotor(r, *rod)), None, 0.01),
    ]
    return figures, {
        "measured": means(r, around, np.linspace(scenes.INNER, scenes.OUTER, 21)),
        "known": curve(line, answers.rotor(line, *rod)),
    }


def channel(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Profiles between plates."""
    exact = {"poiseuille": answers.poiseuille, "couette": answers.couette}[scene.name]
    errors = [relative(at.v[:, 0], exact(at.x[:, 1], at.time)) for at in seen]
    curves, edges, y = {}, np.linspace(0, 1, 31), np.linspace(0, 1, 61)
    for at in seen:
        curves[f"t = {at.time:.2g} s, measured"] = means(at.x[:, 1], at.v[:, 0], edges)
        curves[f"t = {at.time:.2g} s, known"] = curve(y, exact(y, at.time))
    return _of_profiles(seen, errors, 0.007), curves


def cavity(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Velocities along the middle lines of the cavity, Re = 100."""
    figures, curves, last = [], {}, seen[-1]
    for k, (name, line, target) in enumerate((("u", "ghia1982_u_x0.5", 0.008), ("v", "ghia1982_v_y0.5", 0.010))):
        known = answers.table(line)[:, :2]
        at = np.full((len(known), 2), 0.5)
        at[:, 1 - k] = known[:, 0]
        found = answers.interpolate(last.x, last.v[:, k], at, 2.5 * scene.spacing)
        figures.append(
            Figure(f"{name}, RMS, t = {last.time:.3g}", float(np.sqrt(((found - known[:, 1]) ** 2).mean())), None, target)
        )
        dense = np.full((81, 2), 0.5)
        dense[:, 1 - k] = np.linspace(0, 1, 81)
        curves[f"{name}, measured"] = curve(dense[:, 1 - k], answers.interpolate(last.x, last.v[:, k], dense, 2.5 * scene.spacing))
        curves[f"{name}, known"] = curve(*known.T)
    return figures, curves


def drop(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """The half major axis of the ellipse: by second moments and by its outermost particle, against the disc."""
    times, start = np.array([at.time for at in seen]), (scene.positions[:, 1] ** 2).mean()
    exact = answers.drop_axis(times)
    moments = np.sqrt([(at.x[:, 1] ** 2).mean() / start for at in seen])
    outermost = np.array([np.abs(at.x[:, 1]).max() / np.abs(scene.positions[:, 1]).max() for at in seen])
    figures = [
        Figure("major axis by second moment, relative error", float(abs(moments[-1] / exact[-1] - 1)), None, 0.005),
        Figure("major axis by outermost particle, relative error", float(abs(outermost[-1] / exact[-1] - 1)), None, 0.005),
    ]
    return figures, {"measured": curve(times, moments), "known": curve(times, exact)}


def square_drop(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Pressure in the middle over Laplace's σ/R, and how round the rim is: its distance from the center over R, the volume's."""
    tension = scene.physics.surface_tension
    assert tension is not None, "a drop that nothing makes round"
    radius = np.sqrt(scene.n / np.pi) * scene.spacing
    inside = [float(at.p[np.linalg.norm(at.x, axis=1) < radius / 2].mean() * radius / tension) for at in seen]
    last = seen[-1]
    angles, distances = np.arctan2(*last.x.T), np.linalg.norm(last.x, axis=1)
    sectors = np.linspace(-np.pi, np.pi, 17)
    rim = np.array([distances[(angles >= a) & (angles <= b)].max() for a, b in pairwise(sectors)])
    rim = (rim + scene.spacing / 2) / radius
    figures = [
        Figure("pressure inside over Laplace's, mean of late times", float(np.mean(inside[len(inside) // 2 :])), 0.9, 1.1),
        Figure("rim over R, largest deviation of 16", float(np.abs(rim - 1).max()), None, 0.05),
    ]
    times = np.array([at.time for at in seen])
    return figures, {"measured": curve(times, np.array(inside)), "known": curve(times, np.ones_like(times))}


def hydrostatic(scene: FluidScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """Pressure over height, damping being over, and the largest speed left."""
    height, last = 0.9, seen[-1]
    worst = max(relative(at.p, 1000 * (height - at.x[:, 1])) for at in seen)
    y = np.linspace(0, height, 2)
    figures = [Figure("pressure, relative L2, largest after damping", worst, None, 0.01)]
    return figures, {"measured": means(last.x[:, 1], last.p, np.linspace(0, 0.95, 39)), "known": curve(y, 1000 * (height - y))}


def dam_break(scene: FluidScene, seen: list[Seen], perfect: bool = True) -> tuple[list[Figure], Curves]:
    """The front in column widths over t√(2g/a), as far as the tank lets it run; times count from the start, nothing is shifted.

    A perfect fluid is 20 % ahead of the experiment at T = 1.2: what holds the front back there (how the column was let go; friction
    and surface tension, where the tongue is thin) is no part of the scene. So water of little artificial viscosity, which is nearly
    `perfect`, is compared with that, too; much of it stands for what holds the water in the experiment.
    """
    times = np.array([at.time for at in seen]) * np.sqrt(2 * 9.81)
    front = np.array([at.x[:, 0].max() + scene.spacing / 2 for at in seen])
    early = times[(times > 0.1) & (times < 1.65)]
    computed = np.interp(early, *answers.table("perfect_fluid_n2_2").T)
    error = np.abs(front[np.searchsorted(times, early)] / computed - 1)
    figures = [Figure("front, a perfect fluid, T < 1.65, largest relative deviation", float(error.max()), None, 0.10)] * perfect
    curves = {"measured": curve(times, front), "a perfect fluid, computed": curve(early, computed)}
    for size in ("1.125", "2.25"):
        known = answers.table(f"martin_moyce_a{size}_n2_2")
        met = known[(known[:, 1] < 3.9) & (known[:, 0] < times[-1])]
        error = np.abs(np.interp(met[:, 0], times, front) / met[:, 1] - 1)
        figures.append(Figure(f"front, a = {size} in, largest relative deviation", float(error.max()), None, 0.10))
        curves[f"a = {size} in, known"] = curve(*met.T)
    return figures, curves


def sedov(scene: GasScene, seen: list[Seen]) -> tuple[list[Figure], Curves]:
    """The front and the densities of a blast, in shells of a particle spacing, against Sedov's; its energies, its resolution.

    The front is where densities, from outside, come up to half of what is between those before it and the largest.
    """
    energy, gamma = float(scene.masses @ scene.energies), scene.physics.heat_ratio
    edges, curves, fronts, errors, peaks = np.arange(scene.positions.max(), step=scene.spacing), {}, [], [], []
    for at in seen:
        r, exact = np.linalg.norm(at.x, axis=1), answers.sedov(at.time, energy, gamma, scene.dim)
        assert at.rho is not None, "of a gas"
        counts, radii, sums = (np.histogram(r, edges, weights=weights)[0] for weights in (None, r, at.rho))
        radii, shells = (each[counts > 0] / counts[counts > 0] for each in (radii, sums))
        edge = np.flatnonzero(shells > (1 + shells.max()) / 2)[-1]
        front = np.interp(-(1 + shells.max()) / 2, -shells[edge : edge + 2], radii[edge : edge + 2])
        fronts.append(abs(front / exact.front - 1))
        peaks.append(shells.max() / exact.rho[-1])
        known = np.interp(r, exact.r, exact.rho, right=1.0)
        volumes = np.where(r < 1.2 * exact.front, scene.masses / at.rho, 0)
        errors.append(volumes @ np.abs(at.rho - known) / (volumes @ known))
        curves[f"t = {at.time:.2g} s, measured"] = curve(radii, shells)
        after = [np.append(each, more) for each, more in ((exact.r[::20], [exact.front, edges[-1]]), (exact.rho[::20], [1.0, 1.0]))]
        curves[f"t = {at.time:.2g} s, known"] = curve(*after)
    last = seen[-1]
    outwards = np.sum(last.v * last.x, axis=1) ** 2 / np.sum(last.x**2, axis=1)
    sideways = 1 - scene.masses @ outwards / (2 * last.kinetic)
    drift = max(abs((at.kinetic + at.thermal) / energy - 1) for at in seen)
    figures = [
        Figure("radius of the front, largest relative error", max(fronts), None, 0.02),
        Figure(f"density, relative L1, t = {last.time:.2g}", errors[-1], None, 0.12),
        Figure(f"largest density over exact, t = {last.time:.2g}", peaks[-1], 0.75, 1.1),
        Figure(f"share of kinetic energy that is not outwards, t = {last.time:.2g}", sideways, None, 0.003),
        Figure("total energy, largest relative drift", drift, None, 1e-4),
        Figure(f"largest smoothing length over the smallest, t = {last.time:.2g}", last.resolution, 8.0, 1000.0),
    ]
    return figures, curves


def _times(end: float, count: int) -> tuple[float, ...]:
    return tuple(float(end * (k + 1) / count) for k in range(count))


_held_back = functools.partial(dam_break, perfect=False)
_CHANNEL = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
_BRACHET = tuple(k / 4 / np.pi for k in range(21))  # t = 0 to 10 in 1/(kU), k = 2π/m: Re 100 of Brachet et al. (1983)
_PROFILE = ("y [m]", "velocity [m/s]")
_FEW_TIMES = (1e-4, *(0.01 * k for k in range(1, 201)))
_FRONT = ("t √(2g/a)", "front [column widths]")
CASES = {
    **{name: Case(name, _FEW_TIMES, few, backend="brute") for name in ("one", "two", "three", "four")},
    **{
        f"taylor-green{name}": Case("taylor-green", _times(2.0, 20), taylor_green, settings)
        for name, settings in (
            ("-25", {"nx": 25, "jitter": 0.2}),
            ("", {"jitter": 0.2}),
            ("-transport-25", {"nx": 25, "jitter": 0.2, "transport": 100.0}),
            ("-transport", {"jitter": 0.2, "transport": 100.0}),
        )
    },
    **{
        f"drop{name}": Case("drop", _times(0.0076, 20), drop, {"nx": nx}, axes=("time [s]", "half major axis [m]"))
        for name, nx in (("-20", 20), ("", 40), ("-60", 60))
    },
    "square-drop": Case("square-drop", _times(3.0, 12), square_drop, axes=("time [s]", "pressure inside [Laplace's]")),
    "hydrostatic": Case("hydrostatic", (2.5, 3.0, 3.5, 4.0), hydrostatic, axes=("y [m]", "pressure [Pa]")),
    "dam-break-20": Case("dam-break-2d", _times(0.8, 80), dam_break, {"nx": 20}, axes=_FRONT),
    "dam-break-40": Case("dam-break-2d", _times(0.8, 80), dam_break, {"nx": 40}, axes=_FRONT),
    **{
        f"dam-break-viscous-{nx}": Case("dam-break-2d", _times(0.8, 80), _held_back, {"nx": nx, "artificial": alpha}, axes=_FRONT)
        for nx, alpha in ((20, 0.2), (40, 0.4))  # α times smoothing length, a viscosity, is the same
    },
    **{
        f"reverse-poiseuille-{nx}": Case(
            scenes.reverse_poiseuille, (0.25, 0.5, 1.0, 2.5), reverse_poiseuille, {"nx": nx}, axes=_PROFILE, force=scenes.reverse
        )
        for nx in (20, 40)
    },
    **{
        f"rotor-{layers}": Case(scenes.rotor, (1.0, 2.0), rotor, {"layers": layers}, axes=("r [m]", "velocity [m/s]"))
        for layers in (10, 20, 40)
    },
    "sedov": Case("sedov", (0.05, 0.1, 0.15), sedov, axes=("r [m]", "density [kg/m²]")),
    "couette": Case("couette", _CHANNEL, channel, axes=_PROFILE),
    "poiseuille": Case("poiseuille", _CHANNEL, channel, axes=_PROFILE),
    "cavity": Case("cavity", _times(25.0, 25), cavity, axes=("y, x [m]", "velocity [m/s]")),
    **{
        f"taylor-green-3d-{nx}": Case(
            "taylor-green",
            _BRACHET,
            vortices_in_3d,
            {"nx": nx, "dim": 3, "reynolds": 200 * np.pi, "jitter": 0.2},
            axes=("t kU", "dissipation [kU³]"),
        )
        for nx in (16, 32, 64)
    },
}
"""By name, long ones last."""
