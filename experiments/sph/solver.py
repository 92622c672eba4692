"""Steps of a scene: the integrators, the Courant condition, and runs of many steps that may be differentiated."""

import jax
import jax.numpy as jnp
from jax import Array

import jfrnn
from experiments.sph import forces, gas, solids, walls
from experiments.sph.forces import Neighbors
from experiments.sph.model import Model, State
from experiments.sph.particles import Flow, GasModel


def begin(model: Flow, s: State, nbrs: Neighbors = None) -> State:
    """Return the state with what its integrator carries from step to step, at the positions and velocities that it has."""
    if isinstance(model, GasModel):
        return gas.begin(model, s)
    return _evaluate(model, s, nbrs) if model.physics.integrator == "symplectic" else s


def courant(model: Flow, s: State) -> Array:
    """Return the time step [s], shape [], that sound, viscosity and acceleration allow; in a gas as `gas.courant` says.

    The least of 0.25 h/(c + |v|), 0.25 √(h/|a|) and, with viscosity, 0.125 h²/ν.
    Source: Monaghan (1992), doi:10.1146/annurev.aa.30.090192.002551; Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776.
    """
    if isinstance(model, GasModel):
        return gas.courant(model, s)
    physics, h = model.physics, model.physics.smoothing
    speed = _greatest(s.v) if s.solid is None else _greatest(s.v) + solids.rim_speed(model, s.solid)
    limits = [0.25 * h / (physics.sound_speed + speed)]
    if physics.viscosity is not None:
        kinematic = physics.viscosity / physics.density if physics.viscosity_form == "source" else physics.viscosity
        limits.append(0.125 * h**2 / kinematic)
    limits.append(0.25 * jnp.sqrt(h / jnp.maximum(_greatest(s.a), jnp.finfo(s.x.dtype).smallest_normal ** (1 / 3))))
    return jnp.min(jnp.stack(limits))


def _greatest(vectors: Array) -> Array:
    """Return the length of the longest vector, shape []; its derivative is 0 instead of NaN where all are 0."""
    square = jnp.max(jnp.sum(vectors * vectors, axis=1), initial=0)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def step(model: Flow, s: State, nbrs: Neighbors = None) -> tuple[State, Neighbors]:
    """Advance by one time step: the scene's own, or what `courant` allows.

    Args:
        model: What acts.
        s: The state, as `begin` or this function returns it.
        nbrs: A neighbor list, which is updated; None: neighbors are found by each sum anew, as always in a gas.

    Returns:
        The state after the step, and the list.
    """
    dt = courant(model, s) if model.step is None else model.step
    if isinstance(model, GasModel):
        s = gas.step(model, s, dt)
    else:
        s, nbrs = _INTEGRATORS[model.physics.integrator](model, s, dt, nbrs)
    return s._replace(time=s.time + dt, last=dt), nbrs


@jax.jit
def advance(model: Flow, s: State, nbrs: Neighbors, steps: Array | int) -> tuple[State, Neighbors]:
    """Run a number of steps, data: one compiled loop serves all numbers."""
    return jax.lax.fori_loop(0, steps, lambda _, carry: step(model, *carry), (s, nbrs))


def density_and_pressure(model: Flow, s: State, nbrs: Neighbors = None) -> tuple[Array, Array]:
    """Return densities [kg/m³] and pressures [Pa] of a state, shape [n] each."""
    return gas.density_and_pressure(model, s) if isinstance(model, GasModel) else forces.density_and_pressure(model, s, nbrs)


@jax.jit
def advance_until(model: Flow, s: State, time: Array | float) -> tuple[State, Array]:
    """Run steps that search until one ends at a time [s] or later; return the state, and how many steps it took."""
    first = (s, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(lambda carry: carry[0].time < time, lambda carry: (step(model, carry[0])[0], carry[1] + 1), first)


def rollout(model: Flow, s: State, steps: int, nbrs: Neighbors = None, segments: int = 1) -> tuple[State, Neighbors]:
    """Run steps such that they can be differentiated in reverse, in the model's numbers and in the state.

    Derivatives are those of the program: a list changes none of them, and where a flow has a kink (a bounce off a tank; artificial
    viscosity between particles that rest) they are those of one side.

    Args:
        model: What acts.
        s: The state, as `begin` returns it.
        steps: How many, static; a multiple of `segments`.
        nbrs: As in `step`.
        segments: Reverse mode keeps the states between segments and runs each segment again: memory for segments + steps/segments
            states. √steps is best.

    Returns:
        The last state, and the list: where its `overflow` is set, pairs were missing: `grow` it, and run again.

    Raises:
        ValueError: `steps` is no multiple of `segments`.
    """
    if segments < 1 or steps % segments:
        raise ValueError(f"steps must be a multiple of segments, got {steps} and {segments}.")

    def one(carry: tuple[State, Neighbors], _: None) -> tuple[tuple[State, Neighbors], None]:
        return step(model, *carry), None

    def segment(carry: tuple[State, Neighbors], _: None) -> tuple[tuple[State, Neighbors], None]:
        return jax.lax.scan(jax.checkpoint(one), carry, None, length=steps // segments)[0], None

    return jax.lax.scan(jax.checkpoint(segment), (s, nbrs), None, length=segments)[0]


def list_neighbors(model: Model, s: State, skin: float, slack: float = 1.3) -> jfrnn.NeighborList:
    """Return a neighbor list of a state with room to move: skin [m], and slots for `slack` times the longest row."""
    entered = forces.active(model, s.time)
    return jfrnn.search(s.x, model.cutoff, box=model.box, active=entered, skin=skin, slack=slack)


def _update(model: Model, s: State, nbrs: Neighbors) -> Neighbors:
    return None if nbrs is None else nbrs.update(s.x, active=forces.active(model, s.time))


def _evaluate(model: Model, s: State, nbrs: Neighbors, dt: Array | None = None) -> State:
    """Bring a carried density or pressure over dt, and return the state with the accelerations of it."""
    rho = forces.densities(model, s, nbrs)
    inverse = forces.corrections(model, s, rho, nbrs)
    if dt is not None:
        s = _carry(model, s, rho, inverse, nbrs, dt)
        rho = s.rho if s.rho is not None else rho
    a, w = forces.accelerations(model, s, forces.fields(model, s, rho, inverse, nbrs), nbrs)
    return s._replace(a=a, w=_besides(model, w, s.last if dt is None else dt))


def _carry(model: Model, s: State, rho: Array, inverse: Array | None, nbrs: Neighbors, dt: Array) -> State:
    """Return the state with its carried density or pressure after dt; where nothing is carried, the state."""
    if s.rho is not None:
        return s._replace(rho=forces.limit_tearing(model, s.rho + dt * forces.carried_rate(model, s, rho, inverse, nbrs)))
    if s.p is not None:
        return s._replace(p=s.p + dt * forces.carried_rate(model, s, rho, inverse, nbrs))
    return s


def _besides(model: Model, sums: Array | None, dt: Array) -> Array | None:
    """Return the velocity by which particles move besides the fluid's: by background pressure, or by shifting."""
    if sums is None:
        return None
    moved = -model.physics.shifting * sums if model.physics.shifting is not None else dt / 2 * sums
    return walls.keep_fluid(model.wall, moved)


def _transport_velocity(model: Model, s: State) -> Array:
    """Return the velocities with which positions change; dummies of walls stay, their velocity is along the wall."""
    return walls.keep_fluid(forces.are_resting(model, s.time), s.v if s.w is None else s.v + s.w)


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

    The rate of what is carried is that of the new positions and the velocities of the middle: of first order. Without dissipation,
    energy drifts with dt; with `_midpoint`, with dt³ on the elliptical drop.
    """
    s = s._replace(v=s.v + dt / 2 * s.a)
    moved = s.x + dt * _transport_velocity(model, s)
    s = s._replace(x=moved) if s.solid is None else solids.keep_out(model, s, moved, s.v, dt, forces.are_resting(model, s.time))
    s = _bounce(model, s)
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
        carried = {}
        if at.rho is not None and base.rho is not None:
            carried["rho"] = forces.limit_tearing(model, base.rho + part * forces.carried_rate(model, at, rho, inverse, nbrs))
        elif at.p is not None and base.p is not None:
            carried["p"] = base.p + part * forces.carried_rate(model, at, rho, inverse, nbrs)
        at = at._replace(x=moved, v=base.v + part * a, **carried)
    return _bounce(model, at), nbrs


_INTEGRATORS = {"leapfrog": _leapfrog, "symplectic": _symplectic, "midpoint": _midpoint}
