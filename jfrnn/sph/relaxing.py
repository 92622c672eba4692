"""A relaxed start: particles as evenly spread as a flow leaves them, instead of on the sites of a lattice.

On a lattice, forms that keep momentum exactly have forces that cancel by symmetry alone. A flow breaks the lattice up, and what
particles then take to find their places is taken from the flow. Relaxed particles have found them before.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases.fluids import FluidScene, Scene
from jfrnn.sph import correction
from jfrnn.sph.check import check_scene
from jfrnn.sph.errors import SceneError
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.pairs import Pair, Values, total

_OPEN = 0.35  # of h |Σ V ∇W|, which is 0.7 at a flat surface, and up to 0.2 from disorder alone
_PUSH, _KEPT = 0.3, 0.9  # share of h² Σ V ∇W that a particle moves in a step, and of the step before
STEPS = 2000


class _Moved(NamedTuple):
    """Positions [m], the last step [m], shape [n, d] each, the largest h |Σ V ∇W|, shape [], and how many steps were made."""

    x: Array
    step: Array
    worst: Array
    steps: Array


def relax(scene: Scene, noise: float = 0.25, seed: int = 0, enough: float = 1e-3, steps: int = STEPS) -> FluidScene:
    """Return the scene with particles that a constant pressure has spread evenly, among walls that stay.

    Particles are displaced at random. Then each is pushed to where neighbors are few, along -Σ V ∇W, and keeps a part of the step
    before, until that is small. Velocities, densities and pressures are those of the scene at the new places, by their gradients.

    Args:
        scene: A fluid that fills its period, or its walls of dummies: a free surface would spread.
        noise: Standard deviation of what particles are displaced by at first, in spacings.
        seed: Of the displacements.
        enough: Largest h |Σ V ∇W| of a particle at which it ends.
        steps: It ends after so many, too.

    Raises:
        SceneError: The scene is a gas, has a solid or an inflow, or a particle has an open side.

    Source: Litvinov, Hu & Adams (2015), doi:10.1016/j.jcp.2015.08.041.
    """
    check_scene(scene)
    if not isinstance(scene, FluidScene) or scene.solid is not None or scene.enters is not None:
        raise SceneError("relax: expected a fluid without solid and inflow, whose particles are there from the beginning.")
    x, wall = jnp.asarray(scene.positions), np.zeros(scene.n, bool) if scene.wall is None else scene.wall
    free = jnp.asarray(~wall)
    open_to = np.where(wall, 0, np.linalg.norm(_crowding(scene, x), axis=1))
    if open_to.max() > _OPEN:
        raise SceneError(
            f"relax: particle {open_to.argmax()} of the fluid has an open side, where it would spread: a relaxed start is for "
            "fluids that fill their period, or walls as thick as the kernel reaches."
        )
    apart = noise * scene.spacing * np.random.default_rng(seed).normal(size=scene.positions.shape)
    end = _spread(scene, jnp.where(free[:, None], x + jnp.asarray(apart, x.dtype), x), free, enough, steps)
    carried = {"velocities": scene.velocities, "densities": scene.densities, "pressures": scene.pressures}
    there = {name: value for name, value in carried.items() if value is not None}
    moved = _carry(scene, x, end.x - x, free, {name: jnp.asarray(value, x.dtype) for name, value in there.items()})
    return replace(scene, positions=np.array(end.x, float), **{name: np.array(value, float) for name, value in moved.items()})


def _sum(scene: FluidScene, term: Any, x: Array, values: Values) -> Any:  # noqa: ANN401
    box = scene.periodic
    box = box and jfrnn.Box(jnp.asarray(box.lengths, x.dtype), box.axes, jnp.asarray(box.lower, x.dtype))
    return total(term, x, values, KERNELS[scene.physics.kernel], scene.physics.smoothing, box=box)


def _crowding(scene: FluidScene, x: Array) -> Array:
    """Return h Σ V ∇W, shape [n, d]: it points to where neighbors are many."""
    volume = scene.spacing**scene.dim

    def term(pair: Pair, i: Values, j: Values) -> Array:
        return -volume * pair.pull * pair.r

    return scene.physics.smoothing * _sum(scene, term, x, {})


def _spread(scene: FluidScene, x: Array, free: Array, enough: float, steps: int) -> _Moved:
    def move(now: _Moved) -> _Moved:
        crowding = jnp.where(free[:, None], _crowding(scene, now.x), 0)
        step = _KEPT * now.step - _PUSH * scene.physics.smoothing * crowding
        return _Moved(now.x + step, step, jnp.max(jnp.linalg.norm(crowding, axis=1)), now.steps + 1)

    first = _Moved(x, jnp.zeros_like(x), jnp.asarray(jnp.inf, x.dtype), jnp.zeros((), jnp.int32))

    def goes_on(now: _Moved) -> Array:
        return (now.worst > enough) & (now.steps < steps)

    return jax.jit(partial(jax.lax.while_loop, goes_on, move))(first)


def _carry(scene: FluidScene, x: Array, by: Array, free: Array, fields: dict[str, Array]) -> dict[str, Array]:
    """Return fields of the fluid [n, ...] at places moved by [n, d], to second order; those of walls stay."""
    volume = scene.spacing**scene.dim

    def gradient_of(value: Array) -> Array:
        def term(pair: Pair, i: Values, j: Values) -> dict[str, Array]:
            gradient = -volume * jnp.where(j["free"], pair.pull, 0) * pair.r
            return {"change": jnp.outer(j["value"] - i["value"], gradient), "moment": jnp.outer(pair.r, gradient)}

        sums = _sum(scene, term, x, {"value": value, "free": free})
        return jnp.einsum("nck,nkl->ncl", sums["change"], correction.inverse(sums["moment"]))

    moved = {}
    for name, field in fields.items():
        value = field.reshape(len(x), -1)
        first = gradient_of(value)
        second = gradient_of(first.reshape(len(x), -1)).reshape(*first.shape, -1)
        change = jnp.einsum("ncl,nl->nc", first, by) + jnp.einsum("nclk,nl,nk->nc", second, by, by) / 2
        moved[name] = jnp.where(free[:, None], value + change, value).reshape(field.shape)
    return moved
