"""A weakly compressible fluid: its model and state, the Courant condition, and the integrators."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases.fluids import FluidScene, Physics
from jfrnn.sph import budget, forces, solids, viscosity, walls
from jfrnn.sph.errors import SceneError
from jfrnn.sph.forces import density_and_pressure
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.pairs import Neighbors, reach
from jfrnn.sph.particles import Force, Model, State, active, box_of, wrapped

__all__ = ["begin", "beside", "courant", "density_and_pressure", "energies", "list_neighbors", "make_model", "make_state", "step"]

beside = solids.begin


def make_model(scene: FluidScene, dtype: type, backend: str, force: Force | None) -> Model:
    """Put what acts in a fluid into JAX, numbers of one dtype.

    Raises:
        SceneError: A periodic box is too small for the kernel, or parts of the physics do not go together.
    """

    def array(value: Any) -> Array:  # noqa: ANN401
        return jnp.asarray(value, dtype)

    _check_box(scene)
    _check_parts(scene)
    gravity = None if scene.physics.gravity is None else np.asarray(scene.physics.gravity)
    physics = jax.tree.map(array, replace(scene.physics, gravity=gravity))
    return Model(
        physics=physics,
        m=array(scene.masses),
        wall=None if scene.wall is None else jnp.asarray(scene.wall),
        box=box_of(scene, dtype),
        tank=scene.tank and (array(scene.tank.lower), array(scene.tank.upper)),
        enters=None if scene.enters is None else array(scene.enters),
        step=None if scene.step is None else array(scene.step),
        guided=None if scene.enters is None else array(scene.guided),
        spacing=scene.spacing,
        fluid_count=None if scene.wall is None else _first_wall(scene.wall),
        backend=backend,
        turning=solids.turning_of(scene, dtype),
        outflow=scene.outflow and (array(scene.outflow.lower), array(scene.outflow.upper)),
        force=force,
    )


def _check_box(scene: FluidScene) -> None:
    """Refuse a periodic box in which a particle might meet two images of another, or of the solid: the solver traces its box."""
    if scene.periodic is None:
        return
    least = 2.05 * reach(KERNELS[scene.physics.kernel], scene.physics.smoothing)
    for axis, length, periodic in zip("xyz", scene.periodic.lengths, scene.periodic.axes, strict=False):
        if periodic and length < least:
            raise SceneError(
                f"periodic box must be 2.05 cutoffs wide along {axis}: {least:.6g} m, got {length:.6g} m: take more particles."
            )
    if scene.solid is not None:
        solids.check_images(scene)


def _check_parts(scene: FluidScene) -> None:
    """Refuse what does not compile, or compiles and means nothing."""
    physics = scene.physics
    if physics.integrator == "leapfrog" and physics.evolve != "summation":
        raise SceneError(
            f"integrator 'leapfrog' carries no density or pressure, got evolve {physics.evolve!r}: "
            "take evolve 'summation', or integrator 'symplectic' or 'midpoint'."
        )
    if physics.transport is not None and physics.shifting is not None:
        raise SceneError(
            f"transport and shifting both move particles so that they stay evenly spread, got {physics.transport} and "
            f"{physics.shifting}: take one of them, and None for the other."
        )
    if scene.tank is not None and physics.restitution is None:
        raise SceneError("restitution must be a number from 0 to 1 in a tank, got None: take 1 for walls that take no speed away.")
    if scene.dim != len("xy") and "source" in (physics.pressure, physics.viscosity_form):
        raise SceneError("pressure and viscosity_form 'source' are forms in 2D, whose units are others in 3D: take another form.")
    if scene.solid is not None:
        _check_solid(physics)
    if physics.pressure == "difference" and scene.periodic is None and scene.wall is None:
        raise SceneError(
            "pressure 'difference' does not vanish at a free surface, got a scene without walls or period: "
            "take 'mean', 'symmetric' or 'volume'."
        )


def _check_solid(physics: Physics[float, tuple[float, ...]]) -> None:
    """Refuse what walls of triangles have no integrals for."""
    for name, allowed in (
        ("kernel", ("cubic", "quintic", "wendland2", "wendland4", "wendland6")),  # "poly6" has the gradients of another kernel
        ("evolve", ("continuity",)),
        ("integrator", ("symplectic",)),
        ("pressure", ("mean", "symmetric", "volume")),
        ("viscosity_form", ("morris", "volume", "source")),
    ):
        if getattr(physics, name) not in allowed:
            raise SceneError(f"{name} must be {' or '.join(map(repr, allowed))} beside a solid, got {getattr(physics, name)!r}.")
    for name in ("transport", "shifting", "surface_tension"):
        if getattr(physics, name) is not None:
            raise SceneError(f"{name} must be None beside a solid, whose surface it does not know, got {getattr(physics, name)}.")
    if physics.corrected:
        raise SceneError("corrected must be False beside a solid: what it corrects is what the wall lacks in particles.")


def make_state(scene: FluidScene, dtype: type) -> State:
    """Put the particles of a fluid into JAX, where they are at first.

    Raises:
        SceneError: The solid is not closed, or holds a particle.
    """
    physics = scene.physics
    x, v = jnp.asarray(scene.positions, dtype), jnp.asarray(scene.velocities, dtype)
    zero, solid = jnp.zeros((), dtype), solids.begin(scene, x)
    solids.check_far(scene, x, solid)
    state = State(x, v, zero, jnp.zeros_like(x), zero, solid=solid)
    if scene.outflow is not None:
        state = state._replace(gone=jnp.zeros(scene.n, bool))
    if physics.transport is not None or physics.shifting is not None:
        state = state._replace(w=jnp.zeros_like(x))
    if physics.evolve == "continuity":
        return state._replace(rho=_first(scene.densities, physics.density, x))
    return state._replace(p=_first(scene.pressures, 0.0, x)) if physics.evolve == "pressure" else state


def _first(given: np.ndarray | None, default: float, x: Array) -> Array:
    return jnp.full(x.shape[0], default, x.dtype) if given is None else jnp.asarray(given, x.dtype)


def _first_wall(wall: np.ndarray) -> int | None:
    """Return where the walls begin, None where fluid comes after them."""
    count = int(np.count_nonzero(~wall))
    return None if wall[:count].any() else count


def begin(model: Model, s: State, nbrs: Neighbors) -> State:
    """Return the state with what its integrator carries from step to step, at the positions and velocities that it has."""
    return _evaluate(model, s, nbrs) if model.physics.integrator == "symplectic" else s


def courant(model: Model, s: State) -> Array:
    """Return the time step [s], shape [], that sound, viscosity and acceleration allow.

    The least of 0.25 h/(c + |v|), 0.25 √(h/|a|) and, with viscosity, 0.125 h²/ν; of "fourth", whose fastest mode on a lattice
    decays 2.3 times as fast, half of that. With another Courant number than 0.25, all of them are so much longer or shorter.
    Source: Monaghan (1992), doi:10.1146/annurev.aa.30.090192.002551; Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776.
    """
    physics, h = model.physics, model.physics.smoothing
    speed = _greatest(s.v) if s.solid is None else _greatest(s.v) + solids.rim_speed(model, s.solid)
    limits: list[Array | float] = [0.25 * h / (physics.sound_speed + speed)]
    if physics.viscosity is not None:
        limits.append(viscosity.longest_step(physics.viscosity_form, physics.viscosity, physics.density, h))
    limits.append(0.25 * jnp.sqrt(h / jnp.maximum(_greatest(s.a), jnp.finfo(s.x.dtype).smallest_normal ** (1 / 3))))
    return physics.cfl / 0.25 * jnp.min(jnp.stack(limits))


def _greatest(vectors: Array) -> Array:
    """Return the length of the longest vector, shape []; its derivative is 0 instead of NaN where all are 0."""
    square = jnp.max(jnp.sum(vectors * vectors, axis=1), initial=0)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def list_neighbors(model: Model, s: State, skin: float, slack: float) -> jfrnn.NeighborList | None:
    """Return a neighbor list with a skin [m], and slots for `slack` times the longest row; None beside a thin solid."""
    if s.solid is not None and s.solid.sight is not None:  # which pairs it parts, changes in every step
        return None
    return jfrnn.search(s.x, model.cutoff, box=model.box, active=active(model, s), skin=skin, slack=slack)


def energies(model: Model, s: State) -> dict[str, Array]:
    """Return kinetic and potential energy [J; in 2D J/m], shape [] each, by name."""
    return {"kinetic": budget.kinetic_energy(model, s), "potential": budget.potential_energy(model, s)}


def step(model: Model, s: State, dt: Array, nbrs: Neighbors) -> tuple[State, Neighbors]:
    """Advance by a time step [s] as the physics says; the list, where there is one, is updated."""
    s, nbrs = _INTEGRATORS[model.physics.integrator](model, s, dt, nbrs)
    return (s if s.gone is None or model.outflow is None else _let_go(model, s, s.gone, *model.outflow)), nbrs


def _let_go(model: Model, s: State, gone: Array, lower: Array, upper: Array) -> State:
    """Return the state without the particles of the fluid that are outside of the corners [m]; they rest where they left."""
    x = wrapped(model, s.x)
    outside = jnp.any((x < lower) | (x > upper), axis=1)
    if model.wall is not None:
        outside = outside & ~model.wall
    if model.enters is not None:
        outside = outside & (s.time >= model.enters)
    gone = gone | outside
    return s._replace(gone=gone, v=jnp.where(gone[:, None], 0, s.v), a=jnp.where(gone[:, None], 0, s.a))


def _update(model: Model, s: State, nbrs: Neighbors) -> Neighbors:
    return None if nbrs is None else nbrs.update(s.x, active=active(model, s))


def _evaluate(model: Model, s: State, nbrs: Neighbors, dt: Array | None = None) -> State:
    """Bring a carried density or pressure over dt, and return the state with the accelerations of it."""
    rho = forces.densities(model, s, nbrs)
    inverse = forces.corrections(model, s, rho, nbrs)
    if dt is not None:
        s = s._replace(**_carry(model, s, s, rho, inverse, nbrs, dt))
        rho = s.rho if s.rho is not None else rho
    a, w = forces.accelerations(model, s, forces.fields(model, s, rho, inverse, nbrs), nbrs, dt)
    return s._replace(a=a, w=_besides(model, w, s.last if dt is None else dt))


def _carry(
    model: Model, base: State, at: State, rho: Array, inverse: Array | None, nbrs: Neighbors, dt: Array | float
) -> dict[str, Array]:
    """Return the density or pressure that `base` carries after dt, at the rates of `at`; nothing where none is carried."""
    if base.rho is not None:
        return {"rho": forces.limit_tearing(model, base.rho + dt * forces.carried_rate(model, at, rho, inverse, nbrs))}
    return {} if base.p is None else {"p": base.p + dt * forces.carried_rate(model, at, rho, inverse, nbrs)}


def _besides(model: Model, sums: Array | None, dt: Array) -> Array | None:
    """Return the velocity by which particles move besides the fluid's: by background pressure, or by shifting."""
    if sums is None:
        return None
    moved = -model.physics.shifting * sums if model.physics.shifting is not None else dt / 2 * sums
    return walls.keep_fluid(model.wall, moved)


def _transport_velocity(model: Model, s: State) -> Array:
    """Return the velocities with which positions change; dummies of walls stay, their velocity is along the wall."""
    return walls.keep_fluid(forces.are_resting(model, s), s.v if s.w is None else s.v + s.w)


def _bounce(model: Model, s: State) -> State:
    if model.tank is None:
        return s
    assert model.physics.restitution is not None, "`make_model` refuses a tank without it"
    x, v = walls.bounce(s.x, s.v, *model.tank, model.physics.restitution)
    return s._replace(x=x, v=v)


def _leapfrog(model: Model, s: State, dt: Array, nbrs: Neighbors) -> tuple[State, Neighbors]:
    """Kick, then drift: velocities stand half a step before positions, so the first kick is half as long."""
    nbrs = _update(model, s, nbrs)
    s = _evaluate(model, s, nbrs)
    s = s._replace(v=s.v + (s.last + dt) / 2 * s.a)
    return _bounce(model, s._replace(x=s.x + dt * _transport_velocity(model, s))), nbrs


def _symplectic(model: Model, s: State, dt: Array, nbrs: Neighbors) -> tuple[State, Neighbors]:
    """Kick half, drift, carry density or pressure on at the new positions, kick half (velocity Verlet).

    The rate of what is carried is that of the new positions and the velocities of the middle, and so are viscosity and damping: of
    first order. Without dissipation, energy drifts with dt; with `_midpoint`, with dt³ on the elliptical drop. An own force is of
    second order, also in velocities, which it is given at the time of the positions.
    """
    s = s._replace(v=s.v + dt / 2 * s.a)
    moved = s.x + dt * _transport_velocity(model, s)
    s = s._replace(x=moved) if s.solid is None else solids.keep_out(model, s, moved, s.v, dt, forces.are_resting(model, s))
    s = _bounce(model, s._replace(time=s.time + dt))
    nbrs = _update(model, s, nbrs)
    s = _evaluate(model, s, nbrs, dt)
    return s._replace(v=s.v + dt / 2 * s.a), nbrs


def _midpoint(model: Model, s: State, dt: Array, nbrs: Neighbors) -> tuple[State, Neighbors]:
    """Half a step to the rates of its middle, then the whole step with those: Runge-Kutta of second order, two evaluations."""
    at, base = s, s
    for share in (0.5, 1.0):
        nbrs = _update(model, at, nbrs)
        rho = forces.densities(model, at, nbrs)
        inverse = forces.corrections(model, at, rho, nbrs)
        a, w = forces.accelerations(model, at, forces.fields(model, at, rho, inverse, nbrs), nbrs)
        at = at._replace(a=a, w=_besides(model, w, dt))
        part = share * dt
        moved = base.x + part * _transport_velocity(model, at)
        at = at._replace(x=moved, v=base.v + part * a, time=base.time + part, **_carry(model, base, at, rho, inverse, nbrs, part))
    return _bounce(model, at), nbrs


_INTEGRATORS = {"leapfrog": _leapfrog, "symplectic": _symplectic, "midpoint": _midpoint}
