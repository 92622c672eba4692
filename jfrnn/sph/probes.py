"""What may be measured as a run goes on: functions of a model and a state, for `run(probes=...)` and for `jax.jit`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn.sph import solids, solver
from jfrnn.sph.errors import SceneError
from jfrnn.sph.forces import fluid
from jfrnn.sph.pairs import Pair, Values, total
from jfrnn.sph.particles import Flow, GasModel, Model, State, active, mass_there, own_acceleration, wrapped

Probe = Callable[[Any, State], Any]
"""(model, state) -> numbers, arrays, or a dict of them; inside jit."""


def pressure_at(points: Any) -> Probe:  # noqa: ANN401
    """Return a probe of the pressures of a fluid [Pa], shape [k], at points [m], shape [k, d]; 0 where no fluid is near.

    Beside a thin solid, fluid behind it does not count. NaN: more particles were near the points than there was room for.

    Source: Shepard (1968), doi:10.1145/800186.810616: the mean over the fluid, weighed by volumes times the kernel.
    """

    def probe(model: Flow, s: State) -> Array:
        at = jnp.asarray(points, s.x.dtype)
        if at.ndim != 2 or at.shape[1] != s.x.shape[1]:
            raise SceneError(f"points must have shape [k, {s.x.shape[1]}], got {list(at.shape)}.")
        if isinstance(model, GasModel):
            raise SceneError("pressure_at is a probe of fluids, got a gas: take density_and_pressure(model, s)[1] of particles.")
        rho, p = solver.density_and_pressure(model, s)
        values = {"volume": model.m / rho, "p": p} | ({} if model.wall is None else {"wall": model.wall})

        def term(pair: Pair, i: Values, j: Values) -> dict[str, Array]:
            weight = fluid(j, j["volume"] * pair.weight)
            return {"weight": weight, "p": weight * j["p"]}

        options = {"box": model.box, "active": active(model, s), "queries": at, "query_values": {"p": jnp.zeros_like(at[:, 0])}}
        known: Any = True
        if s.solid is not None and s.solid.sight is not None:
            options["exclude"], known = solids.hidden(model, s, s.solid, at)
        sums = total(term, s.x, values, model.kernel, model.physics.smoothing, backend=model.backend, **options)
        met = sums["weight"] > jnp.finfo(s.x.dtype).smallest_normal ** 0.5  # whose square is a divisor of derivatives
        return jnp.where(known, jnp.where(met, sums["p"] / jnp.where(met, sums["weight"], 1), 0), jnp.nan)

    return probe


def flow_through(point: Sequence[float], normal: Sequence[float], width: float) -> Probe:
    """Return a probe of the mass that goes through a plane [kg/s; in 2D kg/m/s], shape []: Σ m v·n/width of a slice around it.

    Args:
        point: In the plane [m], d numbers.
        normal: Across it, of any length.
        width: Of the slice [m]: some particle spacings.
    """

    def probe(model: Flow, s: State) -> Array:
        at, across = (_check_vector(*part, s.x.shape[1]) for part in (("point", point), ("normal", normal)))
        if not width > 0 or not across.any():
            raise SceneError(f"normal and width must not be 0, got {normal!r} and {width!r}.")
        n = jnp.asarray(across / np.linalg.norm(across), s.x.dtype)
        point_there = jnp.asarray(at, s.x.dtype)
        near = jnp.abs((wrapped(model, s.x, point_there) - point_there) @ n) < width / 2
        return jnp.sum(jnp.where(near, mass_there(model, s) * (s.v @ n), 0)) / width

    return probe


def surface_height(place: Sequence[float], radius: float) -> Probe:
    """Return a probe of the height of the fluid's uppermost particle [m], shape [], over a place; -inf where there is none.

    Args:
        place: All coordinates but the last one [m].
        radius: How far from the place particles count [m]: some particle spacings.
    """

    def probe(model: Flow, s: State) -> Array:
        at = _check_vector("place", place, s.x.shape[1] - 1)
        x = wrapped(model, s.x)
        of_place = jnp.asarray([*at, 0], s.x.dtype)
        aside = jnp.linalg.norm((wrapped(model, x, of_place) - of_place)[:, :-1], axis=1)
        there = (aside < radius) & (mass_there(model, s) > 0)
        return jnp.max(jnp.where(there, x[:, -1], -jnp.inf))

    return probe


def force_on_walls(about: Sequence[float] | None = None) -> Probe:
    """Return a probe of the force [N] on all walls, of dummies and of triangles, and of its torque [N m].

    What the walls do to the fluid is what is left of Σ m a without gravity and an own force, a being what acts also on particles
    that keep their velocity because they have just entered. So it is right for forms of pressure
    and viscosity that keep momentum, without damping, and torque as far as forces of pairs are along their distances, which viscous
    ones are not: beside triangles, take `force_on_solid`.

    Args:
        about: What torque is taken about [m], d numbers; None: the origin.

    Returns:
        A probe of {"force": shape [d], "torque": shape [3], in 2D []}.
    """

    def probe(model: Flow, s: State) -> dict[str, Array]:
        if isinstance(model, GasModel):
            raise SceneError("force_on_walls is a probe of fluids, got a gas, which has no walls: leave it out.")
        a = s.a
        # particles that keep their velocity have no acceleration, and yet push others: let go of them; other integrators keep
        # accelerations of other positions, and at first none
        if model.guided is not None or model.physics.integrator != "symplectic":
            free = replace(model, guided=None, physics=replace(model.physics, integrator="symplectic"))
            a = solver.begin(free, s).a
        a = a if model.physics.gravity is None else a - model.physics.gravity
        own = own_acceleration(model, s)
        onto = -mass_there(model, s)[:, None] * (a if own is None else a - own)
        return _force_and_torque(onto, wrapped(model, s.x), about)

    return probe


def force_on_solid(about: Sequence[float] | None = None) -> Probe:
    """Return a probe of the force [N] on the wall of triangles, and of its torque [N m], from pressures and viscosity at the wall.

    Args:
        about: As in `force_on_walls`.

    Returns:
        A probe of {"force": shape [d], "torque": shape [3], in 2D []}.
    """

    def probe(model: Model, s: State) -> dict[str, Array]:
        if s.solid is None:
            raise SceneError("solid must be there for a probe of the force on it, got None.")
        onto, points = solids.load(model, s, s.solid, *solver.density_and_pressure(model, s))
        return _force_and_torque(mass_there(model, s)[:, None] * onto, points, about)

    return probe


def _force_and_torque(forces: Array, x: Array, about: Sequence[float] | None) -> dict[str, Array]:
    r = x if about is None else x - jnp.asarray(_check_vector("about", about, x.shape[1]), x.dtype)
    if x.shape[1] == 2:
        return {"force": jnp.sum(forces, axis=0), "torque": jnp.sum(r[:, 0] * forces[:, 1] - r[:, 1] * forces[:, 0])}
    return {"force": jnp.sum(forces, axis=0), "torque": jnp.sum(jnp.cross(r, forces), axis=0)}


def _check_vector(name: str, value: Sequence[float], count: int) -> np.ndarray:
    array = np.asarray(value)
    if array.shape != (count,) or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise SceneError(f"{name} must be {count} finite numbers, got {value!r}.")
    return array


_TAKEN = ("step", "time", "time [s]")
_NO_HEAD = frozenset(',"\n')
_REAL = (jnp.floating, jnp.integer, jnp.bool_)


def check_names(probes: dict[str, Probe]) -> None:
    """Refuse what are no functions by names that can stand in the head of a table."""
    if not isinstance(probes, dict):
        raise SceneError(f"probes must be a dict of functions by name, got {type(probes).__name__}.")
    for name, probe in probes.items():
        if name in _TAKEN:
            raise SceneError(f"probes must not be called {name!r}, as a column of each table is: take another name.")
        if not isinstance(name, str) or not name or set(name) & _NO_HEAD or not callable(probe):
            raise SceneError(f"probes must be functions by names without a comma, got {name!r}: {probe!r}.")


def columns(probes: dict[str, Probe], model: Flow, s: State) -> list[str]:
    """Return the heads of the columns of probes, in the order of their leaves: "name", "name_key" of a dict, "name_0" of an array.

    Raises:
        SceneError: A probe returns what is no real number, or two columns have one head, or one that cannot stand in a table.
    """
    heads: list[str] = []

    def look(model: Flow, s: State) -> None:
        seen = {name: probe(model, s) for name, probe in probes.items()}
        for path, leaf in jax.tree_util.tree_flatten_with_path(seen, is_leaf=lambda leaf: leaf is None)[0]:
            head, kind = jax.tree_util.keystr(path, simple=True, separator="_"), getattr(leaf, "dtype", type(leaf))
            if not any(jnp.issubdtype(kind, real) for real in _REAL):
                got = f"{getattr(kind, '__name__', kind)} for the column {head!r}"
                raise SceneError(f"probes must return real numbers, arrays or dicts of them, got {got}.")
            heads.extend([f"{head}_{k}" for k in range(leaf.size)] if getattr(leaf, "shape", ()) else [head])

    jax.eval_shape(look, model, s)
    if ill := [head for head in heads if set(head) & _NO_HEAD]:
        raise SceneError(f"probes must return dicts whose keys have no comma, got the column {ill[0]!r}.")
    if len(set(heads)) < len(heads):
        raise SceneError(f"probes give two columns {max(heads, key=heads.count)!r}: take another name for a probe or a key.")
    return heads
