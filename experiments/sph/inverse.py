"""Inverse problems: what a run starts from, found from what it ends with, by gradients in reverse through all of its steps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import minimize

from experiments._library import LAYERS, free
from experiments.sph import answers
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene, lattice
from jfrnn.sph import solver
from jfrnn.sph.model import Model, State, make_model, make_state


@dataclass(frozen=True)
class Problem:
    """What is sought, and what says how far off a guess is.

    Attributes:
        name: Of the problem.
        unknown: What is sought, with its unit.
        start: First guess, shape [k].
        loss: Parameters, shape [k] -> how far what a run ends with is from what is asked for, shape []; 0 where it is the same.
        known: What should be found, shape [k], where that is known.
        steps: Of a run.
        particles: Walls included.
    """

    name: str
    unknown: str
    start: np.ndarray
    loss: Callable[[Array], Array]
    known: np.ndarray | None
    steps: int
    particles: int


class Found(NamedTuple):
    """What was tried: parameters, shape [evaluations, k], and losses, shape [evaluations]; the best, and its loss."""

    tried: np.ndarray
    losses: np.ndarray
    best: np.ndarray
    loss: float


def solve(problem: Problem, evaluations: int = 30) -> Found:
    """Go down a loss by its gradient (L-BFGS): each evaluation is a run, and the run back.

    There are at most so many evaluations, but for those that a line search takes to its end. Source: Byrd et al. (1995),
    doi:10.1137/0916069.
    """
    both = jax.jit(jax.value_and_grad(problem.loss))
    tried: list[tuple[np.ndarray, float]] = []

    def evaluate(guess: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = both(jnp.asarray(guess))
        tried.append((guess.copy(), float(value)))
        return float(value), np.asarray(slope, np.float64)

    minimize(evaluate, problem.start, jac=True, method="L-BFGS-B", options={"maxfun": evaluations, "ftol": 1e-10, "gtol": 1e-9})
    parameters, losses = np.array([guess for guess, _ in tried]), np.array([value for _, value in tried])
    return Found(parameters, losses, parameters[losses.argmin()], float(losses.min()))


def viscosity(*, ny: int = 18, time: float = 1e-3, guess: float = 50.0, backend: str = "auto") -> Problem:
    """Seek the viscosity [m²/s] of a fluid between plates from its profile: the exact one of 100, a time [s] after a force set in.

    There are `ny` particles from plate to plate.
    """
    scene = fluids.fluid("poiseuille", ny=ny)
    model, s = make_model(scene, backend=backend), make_state(scene)
    assert scene.wall is not None and scene.step is not None, "plates of dummies, and steps of one length"
    fluid, steps = ~scene.wall, _square(time / scene.step)
    seen = jnp.asarray(answers.poiseuille(scene.positions[fluid, 1], steps * scene.step))

    def loss(logarithm: Array) -> Array:
        here = replace(model, physics=replace(model.physics, viscosity=100.0 * jnp.exp(logarithm[0])))
        end, _ = solver.rollout(here, solver.begin(here, s), steps, segments=_root(steps))
        return jnp.mean((end.v[fluid, 0] - seen) ** 2) / jnp.mean(seen**2)

    return Problem("viscosity", "ln(viscosity/100 m²/s)", np.log([guess / 100]), loss, np.zeros(1), steps, scene.n)


def jet(*, known: tuple[float, float] = (1.5, 0.8), guess: tuple[float, float] = (1.0, 0.0), backend: str = "brute") -> Problem:
    """Seek the velocity [m/s] with which a jet leaves its nozzle from where and when it lands, 0.3 m below.

    The jet, 6 cm wide, enters row by row. A particle lands where its way crosses the ground, between two steps.
    """
    scene = _jet_scene()
    model, s = make_model(scene, backend=backend), make_state(scene)
    assert scene.step is not None, "steps are of one length"
    steps = _square(scene.duration / scene.step)

    @jax.jit
    def lands(velocity: Array) -> Array:
        """Return the mean place [m] and time [s] of landing, shape [2]."""
        begun = solver.begin(model, s._replace(v=jnp.broadcast_to(velocity, s.v.shape)))
        places = _crossings(model, begun, steps)
        return jnp.mean(places, axis=0)

    seen = lands(jnp.asarray(known))

    def loss(velocity: Array) -> Array:
        return jnp.sum(((lands(velocity) - seen) / seen) ** 2)

    return Problem("jet", "velocity at the nozzle [m/s]", np.array(guess), loss, np.array(known), steps, scene.n)


def _jet_scene(spacing: float = 0.02, rows: int = 6, height: float = 0.3, speed: float = 1.7) -> FluidScene:
    across = lattice((0.0, height - 1.5 * spacing), (1, 3), spacing)
    positions = np.tile(across, (rows, 1))
    physics = replace(free(1000.0, 10 * speed, spacing), artificial=0.1, gravity=(0.0, -9.81))
    return _at_rest(
        "thrown jet",
        positions,
        spacing,
        physics=physics,
        duration=0.5,
        step=0.25 * physics.smoothing / (12 * speed),
        enters=np.repeat(np.arange(rows) * spacing / speed, len(across)),
        guided=spacing / speed,
    )


def _crossings(model: Model, s: State, steps: int) -> Array:
    """Return where [m] and when [s] particles came below y = 0, shape [n, 2]; 0 for those that did not."""

    def one(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], None]:
        s, places = carry
        after = solver.step(model, s)[0]
        below = (s.x[:, 1] > 0) & (after.x[:, 1] <= 0)
        fall = jnp.where(below, s.x[:, 1] - after.x[:, 1], 1)
        share = (s.x[:, 1] / fall)[:, None]
        before, now = (jnp.stack([at.x[:, 0], jnp.broadcast_to(at.time, at.x.shape[:1])], axis=1) for at in (s, after))
        return (after, jnp.where(below[:, None], before + share * (now - before), places)), None

    def segment(carry: tuple[State, Array], _: None) -> tuple[tuple[State, Array], None]:
        return jax.lax.scan(jax.checkpoint(one), carry, None, length=_root(steps))[0], None

    start = (s, jnp.zeros_like(s.x))
    return jax.lax.scan(jax.checkpoint(segment), start, None, length=_root(steps))[0][1]


def droplet(*, goal: float = 0.4, intervals: int = 8, backend: str = "auto") -> Problem:
    """Seek the force along the ground, constant in each of some intervals, that brings a falling droplet to rest at a goal [m].

    The droplet, 8 cm across, falls onto the ground, spreads, and is to be, in the mean, `goal` further in the end and without speed
    along the ground; strong forces cost a little. Forces are accelerations, in units of 9.81 m/s².
    """
    scene = droplet_scene()
    model, s = make_model(scene, backend=backend), make_state(scene)
    assert scene.wall is not None and scene.step is not None, "a ground of dummies, and steps of one length"
    fluid = ~scene.wall
    each = _square(scene.duration / scene.step / intervals)

    def loss(forces: Array) -> Array:
        end = steer(model, s, forces, each)
        along, left = jnp.mean(end.x[fluid, 0]) - goal, jnp.mean(end.v[fluid, 0])
        return (along / 0.04) ** 2 + (left / 0.2) ** 2 + 1e-4 * jnp.mean(forces**2)

    return Problem("droplet", "force [9.81 m/s²]", np.zeros(intervals), loss, None, intervals * each, scene.n)


def steer(model: Model, s: State, forces: Array, each: int) -> State:
    """Return the state after runs of `each` steps, one per force along x [9.81 m/s²], shape [intervals], besides gravity."""

    def interval(s: State, force: Array) -> tuple[State, None]:
        here = replace(model, physics=replace(model.physics, gravity=jnp.stack([9.81 * force, jnp.full_like(force, -9.81)])))
        return solver.rollout(here, s, each, segments=_root(each))[0], None

    return jax.lax.scan(interval, solver.begin(model, s), forces)[0]


def droplet_scene(spacing: float = 0.04 / 3, radius: float = 0.04, length: float = 0.8) -> FluidScene:
    """Return a droplet above the ground, which it will reach in 0.06 s."""
    grid = lattice((-radius, -radius), (round(2 * radius / spacing),) * 2, spacing)
    disc = grid[(grid**2).sum(axis=1) <= radius**2] + (0.0, 0.06)  # 2 cm above the ground
    ground = lattice((-0.15, -LAYERS * spacing), (round(length / spacing), LAYERS), spacing)
    positions = np.concatenate([disc, ground])
    physics = replace(free(1000.0, 8.0, spacing), artificial=0.2, gravity=(0.0, -9.81))
    return _at_rest(
        "steered droplet",
        positions,
        spacing,
        physics=physics,
        duration=0.3,
        step=0.25 * physics.smoothing / (1.2 * physics.sound_speed),
        wall=np.arange(len(positions)) >= len(disc),
    )


def _at_rest(name: str, positions: np.ndarray, spacing: float, **more: Any) -> FluidScene:  # noqa: ANN401
    """Return a scene of particles that do not move, a square of the spacing [m] of water each; `more`: further fields."""
    masses = np.full(len(positions), 1000.0 * spacing**2)
    return fluids.FluidScene(
        name=name, positions=positions, velocities=np.zeros_like(positions), masses=masses, spacing=spacing, **more
    )


def _root(steps: int) -> int:
    return round(steps**0.5)


def _square(steps: float) -> int:
    """Return the square number next above: as many segments as steps in each are the least memory."""
    return int(np.ceil(np.sqrt(steps))) ** 2


PROBLEMS = {"viscosity": viscosity, "jet": jet, "droplet": droplet}
