"""Scenes of fluids and gases: particles, and what acts on them, as plain data. What is None is not there, and is not computed."""

from __future__ import annotations  # `get_type_hints` can then be told what Number and Vector stand for

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

Kernel = Literal["cubic", "quintic", "wendland2", "wendland4", "wendland6", "poly6"]
Floats = tuple[float, ...]
Number = TypeVar("Number", covariant=True)  # float in a scene; an array of shape [] in a solver, which may trace it
Vector = TypeVar("Vector", covariant=True)  # likewise `Floats`, or an array of shape [d]


@dataclass(frozen=True)
class Physics(Generic[Number, Vector]):
    """State what acts in a scene: words choose an equation, numbers are its constants, and None leaves it out.

    Args:
        density: Rest density ρ0 [kg/m³; in 2D kg/m²].
        sound_speed: Artificial speed of sound c [m/s], about ten times the largest velocity.
        smoothing: Smoothing length h [m]. The cutoff is the kernel's support times h.
        kernel: Smoothing kernel; "poly6" takes the spiky kernel for gradients, as the 2D source does.
        evolve: What follows the compression: "summation" (density, summed anew), "continuity" (density, carried along), or
            "pressure" (EDAC: the pressure is carried along).
        state: Pressure of a density: "linear", c²(ρ-ρ0), or "tait", ρ0c²/γ·((ρ/ρ0)^γ - 1).
        exponent: γ of "tait".
        pressure: Form of the pressure force: "symmetric", "mean", "volume", "difference"; "source" is that of the 2D source.
        viscosity: Kinematic viscosity ν [m²/s] of laminar viscosity; with "source" the dynamic one, μ.
        viscosity_form: "morris", "volume", "fourth" (of fourth order in h, with shorter steps), or "source", that of the 2D source.
        artificial: Monaghan's α of artificial viscosity.
        density_diffusion: δ of δ-SPH, about 0.1.
        pressure_diffusion: ν of EDAC [m²/s]: what smooths a carried pressure.
        transport: Background pressure [Pa] of the transport velocity, which keeps particles evenly spread.
        shifting: Strength of particle shifting.
        tension: Strength of cohesion [m³/s²/kg · kg], see `jfrnn.sph.surface`.
        surface_tension: σ [N/m] of a free surface, as a continuum force.
        corrected: Gradients of the kernel are renormalized, so that linear fields have exact gradients.
        gravity: Acceleration [m/s²], one number per axis.
        damping: Rate [1/s] at which velocities decay besides, so that sound does while a scene settles.
        damped_until: When damping ends [s]; None: never.
        restitution: Share of the normal velocity that a particle keeps at the walls of the `Tank` around the scene.
        slip: Walls of dummy particles do not hold the fluid along them.
        tears: The fluid gives way where it is stretched: a density that is carried along does not fall below that at rest. Without
            it, a jet that breaks up pulls its particles together in pairs and clumps.
        integrator: "leapfrog" (kick, drift), "symplectic" (kick, drift, kick), or "midpoint" (Runge-Kutta of second order). In the
            first two, viscosity and damping are of first order in time, and in "leapfrog" an own force that goes by velocities.
        cfl: Courant number of a scene without a step: its steps are cfl h/(c + |v|) or, by viscosity and accelerations, shorter.
    """

    density: Number
    sound_speed: Number
    smoothing: float
    kernel: Kernel = "wendland2"
    evolve: Literal["summation", "continuity", "pressure"] = "continuity"
    state: Literal["linear", "tait"] = "tait"
    exponent: float = 7.0
    pressure: Literal["symmetric", "mean", "volume", "difference", "source"] = "symmetric"
    viscosity: Number | None = None
    viscosity_form: Literal["morris", "volume", "fourth", "source"] = "morris"
    artificial: Number | None = None
    density_diffusion: Number | None = None
    pressure_diffusion: Number | None = None
    transport: Number | None = None
    shifting: Number | None = None
    tension: Number | None = None
    surface_tension: Number | None = None
    corrected: bool = False
    gravity: Vector | None = None
    damping: Number | None = None
    damped_until: Number | None = None
    restitution: Number | None = None
    slip: bool = False
    tears: bool = False
    integrator: Literal["leapfrog", "symplectic", "midpoint"] = "symplectic"
    cfl: Number = 0.25  # pyright: ignore[reportAssignmentType] - a scene's; a solver gives all numbers


WORDS = (
    "smoothing", "kernel", "evolve", "state", "exponent", "pressure",
    "viscosity_form", "corrected", "slip", "tears", "integrator",
)  # fmt: skip
"""Fields of `Physics` that choose what is computed; the others are numbers that may be traced."""


@dataclass(frozen=True)
class Gas(Generic[Number]):
    """State what acts in an ideal gas whose smoothing lengths follow its density: numbers are constants, None leaves a part out.

    Args:
        heat_ratio: Ratio of specific heats γ: p = (γ-1)ρu.
        smoothing_ratio: Smoothing length over the distance of particles, η: h = η (m/ρ)^(1/d).
        kernel: Smoothing kernel.
        artificial: Monaghan's α of artificial viscosity, without which there are no shocks.
    """

    heat_ratio: Number
    smoothing_ratio: Number
    kernel: Kernel = "wendland2"
    artificial: Number | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Hold particles and what is around them.

    Args:
        name: Name of the scene.
        positions: Particle positions [m], float64, shape [n, d].
        velocities: Velocities [m/s], float64, shape [n, d]; those of wall particles stay.
        masses: Masses [kg], float64, shape [n].
        spacing: Particle distance [m].
        duration: Time that is simulated [s].
        step: Time step [s]; None: it follows from the Courant condition, anew in every step.
        wall: Which particles are dummies of a wall, bool, shape [n]; None: there are none.
        periodic: Lower corner and lengths of a box that repeats itself [m], and along which axes; None: space is open.
        tank: Lower and upper corner of a box that particles bounce off [m], for `physics.restitution`; None: there is none.
        bounds: Lower and upper corner [m] of what a picture shows.
        sealed: Lower and upper corner [m] of what no particle of the fluid may leave, infinite where there is no wall; None: there
            are none.
        enters: When each particle enters [s], shape [n]; until then it waits and takes no part. None: all are there.
        guided: How long a particle that entered keeps its velocity [s], whatever acts on it: each, those that are there at first as
            well; or of shape [n].
        outflow: Lower and upper corner [m] of what particles of the fluid leave for good, infinite where they cannot; None: they
            stay.
        densities: Densities at first [kg/m³], shape [n], where they are carried; None: the rest density.
        pressures: Pressures at first [Pa], shape [n], where they are carried; None: 0.
        solid: A wall of triangles, outside of which the fluid is; None: there is none.
    """

    name: str
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    masses: NDArray[np.float64]
    spacing: float
    duration: float
    step: float | None
    wall: NDArray[np.bool_] | None = None
    periodic: Periodic | None = None
    tank: Tank | None = None
    bounds: Tank | None = None
    sealed: Tank | None = None
    enters: NDArray[np.float64] | None = None
    guided: float | NDArray[np.float64] = 0.0
    outflow: Tank | None = None
    densities: NDArray[np.float64] | None = None
    pressures: NDArray[np.float64] | None = None
    solid: Solid | None = None

    @property
    def n(self) -> int:
        """Number of particles."""
        return self.positions.shape[0]

    @property
    def dim(self) -> int:
        """Number of axes."""
        return self.positions.shape[1]


@dataclass(frozen=True, eq=False)
class FluidScene(Scene):
    """Hold a weakly compressible fluid.

    Args:
        physics: What acts.
    """

    physics: Physics[float, Floats] = field(kw_only=True)


@dataclass(frozen=True, eq=False)
class GasScene(Scene):
    """Hold an ideal gas in open space.

    Args:
        physics: What acts.
        energies: Specific thermal energies at first [J/kg], shape [n].
    """

    physics: Gas[float] = field(kw_only=True)
    energies: NDArray[np.float64] = field(kw_only=True)


@dataclass(frozen=True)
class Tank:
    """A box by its lower and upper corner [m]."""

    lower: Floats
    upper: Floats


@dataclass(frozen=True)
class Periodic:
    """A box that repeats itself: lower corner and lengths [m], and along which axes it does."""

    lower: Floats
    lengths: Floats
    axes: tuple[bool, ...]


@dataclass(frozen=True)
class Turning(Generic[Number, Vector]):
    """How a solid turns: around a center [m], along an axis (in 2D none), at a rate [rad/s] counterclockwise as seen against it."""

    center: Vector
    axis: Vector | None
    rate: Number


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed wall of triangles, in 2D of segments.

    Args:
        vertices: Corners at time 0 [m], shape [v, d].
        faces: Vertices of each triangle, counterclockwise as seen from the fluid, integers, shape [f, d]; in 2D segments,
            counterclockwise around what holds no fluid.
        turning: How it turns; None: it stays.
        thin: Whether particles on two sides of it must not feel each other through it, which each step then sees to; None: where
            faces that look away from each other are nearer than the kernel reaches.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    turning: Turning[float, Floats] | None = None
    thin: bool | None = None


def inflow(
    layer: NDArray[np.float64], velocity: Sequence[float], spacing: float, duration: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return particles that enter layer by layer, each a spacing behind the one before.

    Args:
        layer: Where the particles of a layer enter [m], shape [k, d].
        velocity: With which they do [m/s], d numbers.
        spacing: Particle distance [m].
        duration: How long they come [s].

    Returns:
        Positions and velocities, shape [layers · k, d], and when each enters [s], shape [layers · k]: for `Scene`.
    """
    speed = float(np.linalg.norm(velocity))
    layers = int(duration * speed / spacing * (1 + 1e-12))  # a whole number of them is not lost to rounding
    enters = np.arange(layers, dtype=np.float64) * spacing / speed
    positions = np.tile(layer, (len(enters), 1))
    return positions, np.broadcast_to(np.asarray(velocity, float), positions.shape).copy(), np.repeat(enters, len(layer))


def lattice(lower: Sequence[float], counts: Sequence[int], spacing: float) -> NDArray[np.float64]:
    """Return the centers of cells of this size from a lower corner on, shape [n, d], x slowest."""
    axes = [np.float64(low) + (np.arange(count) + 0.5) * spacing for low, count in zip(lower, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
