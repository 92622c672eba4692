"""The first model and state of a scene, and the one place that tells the two kinds of flows apart: a fluid, and a gas."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, overload

import jax
import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases.fluids import FluidScene, GasScene, Scene
from jfrnn.sph import fluid, gas
from jfrnn.sph.check import check_scene, longest_step
from jfrnn.sph.errors import SceneError
from jfrnn.sph.pairs import Neighbors
from jfrnn.sph.particles import Beside, Flow, Force, GasModel, Model, State

_FINEST = 0.01  # spacings, to which positions must be known: those that are not fall onto each other
__all__ = ["Kind", "Model", "State", "kind_of", "make_model", "make_state"]


class Kind(Protocol):
    """What a kind of flow does with its scenes, models and states; the modules `fluid` and `gas` are the two that there are."""

    make_model: Callable[[Any, type, str, Force | None], Any]
    """Put what acts in a scene into JAX."""
    make_state: Callable[[Any, type], State]
    """Put the particles of a scene into JAX."""
    beside: Callable[[Any, Array, Array | None], Beside | None]
    """Look at the wall of triangles, turned by an angle [rad], from positions [m], shape [n, d]; None where there is none."""
    begin: Callable[[Any, State, Neighbors], State]
    """Return the state with what steps carry on."""
    courant: Callable[[Any, State], Array]
    """Return the step [s], shape [], that is stable."""
    step: Callable[[Any, State, Array, Neighbors], tuple[State, Neighbors]]
    """Advance by a step [s]."""
    density_and_pressure: Callable[[Any, State, Neighbors], tuple[Array, Array]]
    """Return densities [kg/m³] and pressures [Pa], shape [n] each."""
    list_neighbors: Callable[[Any, State, float, float], jfrnn.NeighborList | None]
    """Return a neighbor list with a skin [m] and so much slack; None where no list serves two steps."""
    energies: Callable[[Any, State], dict[str, Array]]
    """Return energies [J; in 2D J/m], shape [] each, by name."""


def choose_dtype(dtype: Any) -> type:  # noqa: ANN401
    """Return a dtype of floats that JAX has now, where none is given the widest.

    Raises:
        SceneError: It is none, or float64 where JAX has it not.
    """
    widest = np.float64 if jax.config.read("jax_enable_x64") else np.float32
    asked = None
    with suppress(TypeError, ValueError):  # where NumPy knows no such dtype
        asked = np.dtype(widest if dtype is None else dtype)
    if asked is None or asked not in (np.float32, np.float64):
        raise SceneError(f"dtype must be float32 or float64, got {dtype if asked is None else asked}.")
    if asked == np.float64 and widest == np.float32:
        raise SceneError('dtype float64 needs jax.config.update("jax_enable_x64", True) before; or take float32.')
    return asked.type


def kind_of(flow: Scene | Flow) -> Kind:
    """Return the kind of a scene or of a model."""
    return gas if isinstance(flow, GasScene | GasModel) else fluid


@overload
def make_model(scene: FluidScene, dtype: type | None = ..., backend: str = ..., *, force: Force | None = ...) -> Model: ...


@overload
def make_model(scene: Scene, dtype: type | None = ..., backend: str = ..., *, force: Force | None = ...) -> Flow: ...


def make_model(scene: Scene, dtype: type | None = None, backend: str = "auto", *, force: Force | None = None) -> Flow:
    """Put what acts in a scene into JAX, numbers of one dtype.

    Args:
        scene: The scene.
        dtype: float32 or float64; None: float64 where JAX has it, as `jax_enable_x64` says.
        backend: Of `jfrnn.pair_sum`.
        force: A function of a `State` that returns accelerations [m/s²], shape [n, d], which act besides those of the physics;
            inside jit. Numbers in it that are to be traced are arguments of a `jax.tree_util.Partial`.

    Raises:
        SceneError: As `check_scene`; or a periodic box is too small for the kernel, or parts of the physics do not go together, or
            numbers are too large or too small for the dtype.
    """
    check_scene(scene)
    dtype = choose_dtype(dtype)
    _check_range(scene, dtype)
    if force is not None and not isinstance(force, jax.tree_util.Partial):
        force = jax.tree_util.Partial(force)
    return kind_of(scene).make_model(scene, dtype, backend, force)


def _check_range(scene: Scene, dtype: type) -> None:
    """Refuse what the dtype cannot tell: powers and products in sums over pairs, places of neighbors, times of two steps."""
    spacing, least, largest = np.array([scene.spacing, np.min(scene.masses), np.max(scene.masses)], float)
    tiny, most = float(np.finfo(dtype).smallest_normal), float(np.finfo(dtype).max)
    with np.errstate(all="ignore"):
        power, light, heavy = spacing**2 * np.array([spacing**scene.dim, least, largest])
    if not (tiny < power < most / 2**20 and tiny < light and heavy < most):  # far from its center, a kernel is small besides
        raise SceneError(
            f"spacing {spacing:g} m and masses from {least:g} to {largest:g} kg are beyond {np.dtype(dtype)} in sums over pairs: "
            f"take {'' if dtype == np.float64 else 'float64, or '}units in which they are nearer to 1."
        )
    wider, far = "" if dtype == np.float64 else ", or take float64", dtype(np.abs(scene.positions).max())
    if not (apart := float(np.spacing(far))) <= _FINEST * scene.spacing:
        raise SceneError(
            f"positions reach {far:g} m, where {np.dtype(dtype)} knows them to {apart:.3g} m, expected to {_FINEST:g} of a spacing "
            f"of {scene.spacing:g} m: move the scene to the origin{wider}."
        )
    with np.errstate(all="ignore"):
        end = dtype(scene.duration)
        ticks = float(np.spacing(end))
    if not (end > 0 and longest_step(scene) >= ticks):
        raise SceneError(
            f"duration is {scene.duration:g} s, whose end {np.dtype(dtype)} knows to {ticks:.3g} s, while no step is longer than "
            f"{longest_step(scene):.3g} s: take a shorter duration, or longer steps{wider}."
        )


def make_state(scene: Scene, dtype: type | None = None) -> State:
    """Put the particles of a scene into JAX, where they are at first; `solver.begin` does the rest.

    Raises:
        SceneError: As `check_scene`; or the solid is not closed, or holds a particle.
    """
    check_scene(scene)
    return kind_of(scene).make_state(scene, choose_dtype(dtype))
