"""Known answers: what a flow must be at its times, from closed forms and tables."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

REFERENCE = Path(__file__).parent.parent / "reference"
VORTEX_STEP = 0.05  # of `vortices` [1/(kU)]; half of it changes dissipation at Re 100 by less than 1e-7
DRAG = np.pi**2 * 100.0  # of the slowest mode of a channel [1/s]: ν π²/H² with ν = 100 m²/s, H = 1 m


def poiseuille(y: np.ndarray, time: float, top_speed: float = 1.25, drag: float = DRAG) -> np.ndarray:
    """Return the velocity [m/s] between plates at rest, y in [0, 1] of their distance H, after a force of 8ν top_speed/H² began.

    `drag` is νπ²/H² [1/s]. Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776, eq. 31.
    """
    k = np.arange(1, 200, 2)
    modes = np.sin(np.pi * k * y[:, None]) * np.exp(-drag * k**2 * time) / k**3
    return 4 * top_speed * (y * (1 - y) - 8 / np.pi**3 * modes.sum(axis=1))


def couette(y: np.ndarray, time: float, lid: float = 1.25) -> np.ndarray:
    """Return the velocity [m/s] between a plate at rest and one that moves, y in [0, 1] m (ν = 100 m²/s).

    Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776, eq. 33.
    """
    k = np.arange(1, 200)
    modes = (-1.0) ** k / k * np.sin(np.pi * k * y[:, None]) * np.exp(-DRAG * k**2 * time)
    return lid * (y + 2 / np.pi * modes.sum(axis=1))


def rotor(r: np.ndarray, rate: float, inner: float, outer: float) -> np.ndarray:
    """Return the velocity [m/s] along circles of radii r between a rod of radius `inner` that turns and a tube of radius `outer`.

    Source: Couette (1890), Ann. Chim. Phys. 21, 433; Landau & Lifshitz, Fluid Mechanics, §18.
    """
    return rate * inner**2 / (outer**2 - inner**2) * (outer**2 / r - r)


def rotor_torque(viscosity: float, rate: float, inner: float, outer: float) -> float:
    """Return the torque on that rod per length and density of the fluid, 4πνω R1²R2²/(R2² - R1²), against its turning."""
    return 4 * np.pi * viscosity * rate * inner**2 * outer**2 / (outer**2 - inner**2)


def vortices(times: np.ndarray, reynolds: float, n: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return kinetic energies per mass of Taylor-Green vortices in 3D and their dissipation, 2ν times the enstrophy, at times.

    What they decay to has no closed form. A Fourier series of a cube, whose products are made on a grid; the upper third of its
    numbers is left out, so that products are exact (Orszag 1971). Viscosity is an exponential factor, the rest is integrated by
    Runge-Kutta of fourth order. The speed at first and the number of its waves, k, are 1, as in Brachet et al. (1983),
    doi:10.1017/S0022112083001159: times are in 1/(kU), rising, from 0 on, multiples of `VORTEX_STEP`, and `reynolds` is U/(kν). 48
    points of the grid along an axis have a dissipation at Re 100 within 6e-4 of that of 64.
    """
    waves = np.stack(np.meshgrid(*[np.fft.fftfreq(n, 1 / n)] * 2, np.fft.rfftfreq(n, 1 / n), indexing="ij"))
    square = np.sum(waves**2, axis=0)
    kept = np.max(np.abs(waves), axis=0) < n / 3
    counts = np.where((waves[2] == 0) | (waves[2] == n / 2), 1, 2) / n**6  # others stand for two waves of the real field
    decay = np.exp(-square * VORTEX_STEP / 2 / reynolds)

    def rate(v: np.ndarray) -> np.ndarray:
        """Return the part of v × curl v that has no divergence."""
        speed, curl = (np.fft.irfftn(each, (n,) * 3, axes=(1, 2, 3)) for each in (v, 1j * np.cross(waves, v, axis=0)))
        force = np.where(kept, np.fft.rfftn(np.cross(speed, curl, axis=0), axes=(1, 2, 3)), 0)
        return force - waves * np.sum(waves * force, axis=0) / np.maximum(square, 1)

    x, y, z = np.meshgrid(*[2 * np.pi * np.arange(n) / n] * 3, indexing="ij")
    start = np.stack([-np.cos(x) * np.sin(y) * np.cos(z), np.sin(x) * np.cos(y) * np.cos(z), 0 * z])
    v, found = np.fft.rfftn(start, axes=(1, 2, 3)), []
    for steps in np.diff(np.round(times / VORTEX_STEP), prepend=0):
        for _ in range(int(steps)):
            a = rate(v)
            b = rate(decay * (v + VORTEX_STEP / 2 * a))
            c = rate(decay * v + VORTEX_STEP / 2 * b)
            d = rate(decay**2 * v + VORTEX_STEP * decay * c)
            v = decay**2 * v + VORTEX_STEP / 6 * (decay**2 * a + 2 * decay * (b + c) + d)
        power = counts * np.sum(np.abs(v) ** 2, axis=0)
        found.append((np.sum(power) / 2, np.sum(square * power) / reynolds))
    kinetic, dissipated = np.array(found).T
    return kinetic, dissipated


def drop_axis(times: np.ndarray, rate: float = 100.0) -> np.ndarray:
    """Return the half major axis of a disc of radius 1 m whose motion (-rate x, rate y) makes it an ellipse, at times [s].

    With half axes 1/b and b, and v = A y, incompressible and without pressure at its surface: b' = A b and
    A' = A² (1 - b⁴)/(1 + b⁴). Source: Monaghan (1994), doi:10.1006/jcph.1994.1034, sec. 5.1.
    """

    def rates(_: float, now: np.ndarray) -> list[float]:
        b, a = now
        return [a * b, a**2 * (1 - b**4) / (1 + b**4)]

    return solve_ivp(rates, (0, max(times)), [1.0, rate], t_eval=times, rtol=1e-11, atol=1e-11).y[0]


def table(name: str) -> np.ndarray:
    """Return the numbers of a table in `experiments/reference`."""
    return np.loadtxt(REFERENCE / f"{name}.csv", delimiter=",", comments=("#", "t,", "T,"))


def interpolate(x: np.ndarray, values: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """Return values [n], at positions [m], shape [n, 2], at points, shape [k, 2]: from planes fitted to the particles within reach.

    Particles are weighed by a Wendland kernel.
    """
    found = []
    for point in points:
        apart = (x - point) / reach
        q = np.sqrt((apart**2).sum(axis=1))
        near = q < 1
        root = np.sqrt((1 - q[near]) ** 4 * (4 * q[near] + 1))
        plane = np.column_stack([np.ones(near.sum()), apart[near]])
        found.append(np.linalg.lstsq(plane * root[:, None], values[near] * root, rcond=None)[0][0])
    return np.array(found)


class Blast(NamedTuple):
    """Sedov's solution behind the shock at a moment.

    Attributes:
        front: Radius of the shock [m].
        r: Radii [m], rising from 0 to the front, shape [k].
        rho: Densities there, those before the shock being 1, shape [k].
        v: Velocities outwards [m/s], shape [k].
        p: Pressures [Pa], shape [k].
    """

    front: float
    r: np.ndarray
    rho: np.ndarray
    v: np.ndarray
    p: np.ndarray


def sedov(time: float, energy: float = 1.0, heat_ratio: float = 1.4, dim: int = 2, count: int = 4001) -> Blast:
    """Return the blast [J; in 2D J/m] that is set free at a point in a cold gas of density 1 at rest, at a time [s].

    Source: Sedov (1959), Similarity and Dimensional Methods in Mechanics, ch. 4, in the form of Kamm & Timmes (2007),
    LA-UR-07-2849, for a uniform density. Their parameter V runs such that radii are nearly equidistant; the energy behind a front
    at 1, which sets the scale, is a sum of trapezia. For a ratio of heats that is not between 1 and 2 the solution has another
    form.
    """
    if not 1 < heat_ratio < 2:
        raise ValueError(f"heat_ratio must be above 1 and below 2, got {heat_ratio}.")
    j, g = dim, heat_ratio
    a, b, c = (j + 2) * (g + 1) / 4, (g + 1) / (g - 1), (j + 2) * g / 2
    d, e = (j + 2) * (g + 1) / ((j + 2) * (g + 1) - 2 * (2 + j * (g - 1))), (2 + j * (g - 1)) / 2
    a0, a2, a3, a5 = 2 / (j + 2), -(g - 1) / (2 * (g - 1) + j), j / (2 * (g - 1) + j), -2 / (2 - g)
    a1 = (j + 2) * g / (2 + j * (g - 1)) * (2 * j * (2 - g) / (g * (j + 2) ** 2) - a2)
    a4 = (j + 2) / (2 - g) * a1
    x2 = np.linspace(0, 1, count) ** (-1 / a2)
    parameter = (x2 / b + 1) / c
    x1, x3, x4 = a * parameter, d * (1 - e * parameter), b * (1 - c / g * parameter)
    r = x1**-a0 * x2**-a2 * x3**-a1
    rho = b * x2**a3 * x3**a4 * x4**a5
    v, p = x1 * r, x1 ** (a0 * j) * x3 ** (a4 - 2 * a1) * x4 ** (1 + a5)
    v, p = 2 / (g + 1) * v, 2 / (g + 1) * p  # in units of the speed of the front and of its square
    around = 2 * np.pi * (dim - 1) * r ** (dim - 1)
    held = np.trapezoid((rho * v**2 / 2 + p / (g - 1)) * around, r)
    front = (energy * (j + 2) ** 2 / 4 / held * time**2) ** (1 / (j + 2))
    speed = 2 / (j + 2) * front / time
    return Blast(float(front), front * r, rho, speed * v, speed**2 * p)
