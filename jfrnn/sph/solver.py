"""Steps of a scene, and runs of many steps that may be differentiated."""

import jax
import jax.numpy as jnp
from jax import Array

import jfrnn
from jfrnn.sph.model import State, kind_of
from jfrnn.sph.pairs import Neighbors
from jfrnn.sph.particles import Flow


def begin(model: Flow, s: State, nbrs: Neighbors = None) -> State:
    """Return the state with what its integrator carries from step to step, at the positions and velocities that it has."""
    return kind_of(model).begin(model, s, nbrs)


def courant(model: Flow, s: State) -> Array:
    """Return the time step [s], shape [], that is stable: `fluid.courant` and `gas.courant` say which one."""
    return kind_of(model).courant(model, s)


def step(model: Flow, s: State, nbrs: Neighbors = None, until: Array | None = None) -> tuple[State, Neighbors]:
    """Advance by one time step: the scene's own, or what `courant` allows.

    Args:
        model: What acts.
        s: The state, as `begin` or this function returns it.
        nbrs: A neighbor list, which is updated; None: neighbors are found by each sum anew, as always in a gas.
        until: Time [s], shape [], later than that of the state, at which the last step ends: it is cut; None: no step is.

    Returns:
        The state after the step, and the list.
    """
    dt = courant(model, s) if model.step is None else model.step
    end = s.time + dt
    if until is not None:
        last = until <= end + 1e-6 * dt + 4 * jnp.finfo(dt.dtype).eps * jnp.abs(until)  # no step of rounding alone comes after it
        dt, end = jnp.where(last, until - s.time, dt), jnp.where(last, until, end)
    s, nbrs = kind_of(model).step(model, s, dt, nbrs)
    return s._replace(time=end, last=dt), nbrs


@jax.jit
def advance(model: Flow, s: State, nbrs: Neighbors, steps: Array | int) -> tuple[State, Neighbors]:
    """Run a number of steps, data: one compiled loop serves all numbers."""
    return jax.lax.fori_loop(0, steps, lambda _, carry: step(model, *carry), (s, nbrs))


def density_and_pressure(model: Flow, s: State, nbrs: Neighbors = None) -> tuple[Array, Array]:
    """Return densities [kg/m³] and pressures [Pa] of a state, shape [n] each."""
    return kind_of(model).density_and_pressure(model, s, nbrs)


def energies(model: Flow, s: State) -> dict[str, Array]:
    """Return the energies [J; in 2D J/m], shape [] each, by name: kinetic, and potential or, of a gas, thermal."""
    return kind_of(model).energies(model, s)


@jax.jit
def advance_until(
    model: Flow, s: State, nbrs: Neighbors, until: Array | float, most: Array | int = 1 << 30
) -> tuple[State, Neighbors, Array]:
    """Run steps to a time [s], of which the last is cut to end at it, but no more than `most`; return how many steps it took."""
    until = jnp.asarray(until, s.x.dtype)
    first = (s, nbrs, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(
        lambda carry: (carry[0].time < until) & (carry[2] < most),
        lambda carry: (*step(model, carry[0], carry[1], until), carry[2] + 1),
        first,
    )


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


def list_neighbors(model: Flow, s: State, skin: float, slack: float = 1.3) -> jfrnn.NeighborList | None:
    """Return a neighbor list of a state with room to move, or None where no list serves two steps, as in a gas.

    Args:
        model: What acts.
        s: The state.
        skin: How far the list reaches beyond the cutoff [m].
        slack: Slots of a row over its longest row.
    """
    return kind_of(model).list_neighbors(model, s, skin, slack)
