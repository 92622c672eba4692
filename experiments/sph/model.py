"""The first model and state of a scene: what acts in it, and its particles, put into JAX."""

from dataclasses import replace
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from experiments.sph import gas, solids
from experiments.sph.kernels import KERNELS
from experiments.sph.pairs import reach
from experiments.sph.particles import Flow, Model, State
from jfrnn.cases.fluids import FluidScene, GasScene, Physics, Scene

__all__ = ["Model", "State", "make_model", "make_state"]


@overload
def make_model(scene: FluidScene, dtype: type = ..., backend: str = ...) -> Model: ...


@overload
def make_model(scene: Scene, dtype: type = ..., backend: str = ...) -> Flow: ...


def make_model(scene: Scene, dtype: type = np.float64, backend: str = "auto") -> Flow:
    """Put what acts in a scene into JAX, numbers of one dtype.

    Raises:
        ValueError: A periodic box is too small for the kernel, or parts of the physics do not go together; or as `gas.make_model`.
    """
    if isinstance(scene, GasScene):
        return gas.make_model(scene, dtype, backend)
    assert isinstance(scene, FluidScene), "a scene is of one of two kinds"

    def array(value: Any) -> Array:  # noqa: ANN401
        return jnp.asarray(value, dtype)

    _check_box(scene)
    _check_parts(scene)
    physics = jax.tree.map(array, replace(scene.physics, gravity=_row(scene.physics.gravity)))
    box = scene.periodic and jfrnn.Box(array(scene.periodic.lengths), scene.periodic.axes, array(scene.periodic.lower))
    return Model(
        physics=physics,
        m=array(scene.masses),
        wall=None if scene.wall is None else jnp.asarray(scene.wall),
        box=box,
        tank=scene.tank and (array(scene.tank.lower), array(scene.tank.upper)),
        enters=None if scene.enters is None else array(scene.enters),
        step=None if scene.step is None else array(scene.step),
        guided=None if scene.enters is None else array(scene.guided),
        spacing=scene.spacing,
        fluid_count=None if scene.wall is None else _first_wall(scene.wall),
        backend=backend,
        turning=solids.turning_of(scene, dtype),
    )


def _check_box(scene: FluidScene) -> None:
    """Refuse a periodic box in which a particle might meet two images of another: the solver traces its box."""
    if scene.periodic is None:
        return
    least = 2.05 * reach(KERNELS[scene.physics.kernel], scene.physics.smoothing)
    for axis, length, periodic in zip("xyz", scene.periodic.lengths, scene.periodic.axes, strict=False):
        if periodic and length < least:
            raise ValueError(
                f"periodic box must be 2.05 cutoffs wide along {axis}: {least:.6g} m, got {length:.6g} m: take more particles."
            )


def _check_parts(scene: FluidScene) -> None:
    """Refuse what does not compile, or compiles and means nothing."""
    physics = scene.physics
    if physics.integrator == "leapfrog" and physics.evolve != "summation":
        raise ValueError(
            f"integrator 'leapfrog' carries no density or pressure, got evolve {physics.evolve!r}: "
            "take evolve 'summation', or integrator 'symplectic' or 'midpoint'."
        )
    if scene.tank is not None and physics.restitution is None:
        raise ValueError("restitution must be a number from 0 to 1 in a tank, got None: take 1 for walls that take no speed away.")
    if scene.solid is not None:
        _check_solid(physics)
    if physics.pressure == "difference" and scene.periodic is None and scene.wall is None:
        raise ValueError(
            "pressure 'difference' does not vanish at a free surface, got a scene without walls or period: "
            "take 'mean', 'symmetric' or 'volume'."
        )


def _check_solid(physics: Physics[float, tuple[float, ...]]) -> None:
    """Refuse what walls of triangles have no integrals for."""
    for name, allowed in (
        ("evolve", ("continuity",)),
        ("integrator", ("symplectic",)),
        ("pressure", ("mean", "symmetric", "volume")),
    ):
        if getattr(physics, name) not in allowed:
            raise ValueError(f"{name} must be {' or '.join(map(repr, allowed))} beside a solid, got {getattr(physics, name)!r}.")
    for name in ("transport", "shifting", "surface_tension"):
        if getattr(physics, name) is not None:
            raise ValueError(f"{name} must be None beside a solid, whose surface it does not know, got {getattr(physics, name)}.")
    if physics.corrected:
        raise ValueError("corrected must be False beside a solid: what it corrects is what the wall lacks in particles.")


def make_state(scene: Scene, dtype: type = np.float64) -> State:
    """Put the particles of a scene into JAX, where they are at first; `solver.begin` does the rest.

    Raises:
        ValueError: The solid is not closed, or holds a particle.
    """
    if isinstance(scene, GasScene):
        return gas.make_state(scene, dtype)
    assert isinstance(scene, FluidScene), "a scene is of one of two kinds"
    physics = scene.physics
    x, v = jnp.asarray(scene.positions, dtype), jnp.asarray(scene.velocities, dtype)
    zero = jnp.zeros((), dtype)
    state = State(x, v, zero, jnp.zeros_like(x), zero, solid=solids.begin(scene, x))
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


def _row(gravity: tuple[float, ...] | None) -> np.ndarray | None:
    return None if gravity is None else np.asarray(gravity)
