"""The first model and state of a scene, and the one place that tells the two kinds of flows apart: a fluid, and a gas."""

from typing import Any, Protocol, overload

import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases.fluids import FluidScene, GasScene, Scene
from jfrnn.sph import fluid, gas
from jfrnn.sph.check import check_scene
from jfrnn.sph.pairs import Neighbors
from jfrnn.sph.particles import Beside, Flow, GasModel, Model, State

__all__ = ["Kind", "Model", "State", "kind_of", "make_model", "make_state"]


class Kind(Protocol):
    """What a kind of flow does with its scenes, models and states; the modules `fluid` and `gas` are the two that there are."""

    def make_model(self, scene: Any, dtype: type, backend: str) -> Any:  # noqa: ANN401
        """Put what acts in a scene into JAX."""
        ...

    def make_state(self, scene: Any, dtype: type) -> State:  # noqa: ANN401
        """Put the particles of a scene into JAX."""
        ...

    def beside(self, scene: Any, x: Array, angle: Array | None) -> Beside | None:  # noqa: ANN401
        """Look at the wall of triangles, turned by an angle [rad], from positions [m], shape [n, d]; None where there is none."""
        ...

    def begin(self, model: Any, s: State, nbrs: Neighbors) -> State:  # noqa: ANN401
        """Return the state with what steps carry on."""
        ...

    def courant(self, model: Any, s: State) -> Array:  # noqa: ANN401
        """Return the step [s], shape [], that is stable."""
        ...

    def step(self, model: Any, s: State, dt: Array, nbrs: Neighbors) -> tuple[State, Neighbors]:  # noqa: ANN401
        """Advance by a step [s]."""
        ...

    def density_and_pressure(self, model: Any, s: State, nbrs: Neighbors) -> tuple[Array, Array]:  # noqa: ANN401
        """Return densities [kg/m³] and pressures [Pa], shape [n] each."""
        ...

    def list_neighbors(self, model: Any, s: State, skin: float, slack: float) -> jfrnn.NeighborList | None:  # noqa: ANN401
        """Return a neighbor list with a skin [m]; None where no list serves two steps."""
        ...

    def energies(self, model: Any, s: State) -> dict[str, Array]:  # noqa: ANN401
        """Return energies [J; in 2D J/m], shape [] each, by name."""
        ...


def kind_of(flow: Scene | Flow) -> Kind:
    """Return the kind of a scene or of a model."""
    return gas if isinstance(flow, GasScene | GasModel) else fluid


@overload
def make_model(scene: FluidScene, dtype: type = ..., backend: str = ...) -> Model: ...


@overload
def make_model(scene: Scene, dtype: type = ..., backend: str = ...) -> Flow: ...


def make_model(scene: Scene, dtype: type = np.float64, backend: str = "auto") -> Flow:
    """Put what acts in a scene into JAX, numbers of one dtype.

    Raises:
        SceneError: As `check_scene`; or a periodic box is too small for the kernel, or parts of the physics do not go together.
    """
    check_scene(scene)
    return kind_of(scene).make_model(scene, dtype, backend)


def make_state(scene: Scene, dtype: type = np.float64) -> State:
    """Put the particles of a scene into JAX, where they are at first; `solver.begin` does the rest.

    Raises:
        SceneError: As `check_scene`; or the solid is not closed, or holds a particle.
    """
    check_scene(scene)
    return kind_of(scene).make_state(scene, dtype)
