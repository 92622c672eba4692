"""What a scene must be like to be run, whoever made it: each mistake is one sentence that names the field."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, get_type_hints

import jax
import numpy as np
from jax.core import Tracer

from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene, GasScene, Scene
from jfrnn.sph import ranges, viscosity
from jfrnn.sph.errors import SceneError
from jfrnn.sph.kernels import KERNELS

_HINTS = {"Number": float, "Vector": tuple[float, ...]}
PHYSICS, PHYSICS_OF_GASES = (get_type_hints(kind, localns=_HINTS) for kind in (fluids.Physics, fluids.Gas))
LEAST_SMOOTHING, MOST_SMOOTHING = 0.1, 50.0  # in particle spacings
MOST_STEPS = 1e9
_PER_PARTICLE = {"velocities": "nd", "masses": "n", "energies": "n", "enters": "n", "densities": "n", "pressures": "n"}
_OPTIONAL = ("enters", "densities", "pressures")


def check_scene(scene: Scene) -> None:
    """Refuse a scene that cannot be run.

    Raises:
        SceneError: Names the field, says what it is, and what to do.
    """
    if not isinstance(scene, FluidScene | GasScene):
        raise SceneError(f"scene must be a FluidScene or a GasScene, got {_kind(scene)}.")
    _check_kinds(scene)
    _check_particles(scene)
    for name in ("spacing", "duration"):
        _check_number(name, getattr(scene, name))
    for name, place in (("tank", scene.tank), ("bounds", scene.bounds), ("sealed", scene.sealed), ("outflow", scene.outflow)):
        if place is not None:
            _check_corners(name, place.lower, place.upper, scene.dim)
    if scene.tank is not None:
        _check_inside(scene.positions, scene.tank, 0.01 * scene.spacing)
    if scene.bounds is not None and not np.isfinite([scene.bounds.lower, scene.bounds.upper]).all():
        raise SceneError(f"bounds must be finite, for they are what pictures show, got {scene.bounds}.")
    if scene.periodic is not None:
        _check_periodic(scene.periodic, scene.dim)
        if scene.tank is not None and np.isfinite([scene.tank.lower, scene.tank.upper])[:, list(scene.periodic.axes)].any():
            raise SceneError(f"tank must be infinite along axes that are periodic, {scene.periodic.axes}, got {scene.tank}.")
    if scene.solid is not None:
        _check_solid(scene.solid, scene.dim)
    check_physics(scene.physics)
    _check_steps(scene)
    if isinstance(scene, FluidScene):
        _check_fluid(scene)


def _check_kinds(scene: FluidScene | GasScene) -> None:
    """Refuse fields that are of another kind than they should be, such as a pair of corners instead of a `Tank`."""
    if not isinstance(scene.name, str) or scene.name in ("", ".", "..") or "/" in scene.name:
        raise SceneError(f"name must be a text without '/', which files are called by, got {_kind(scene.name)}.")
    kinds: dict[str, type] = {"tank": fluids.Tank, "bounds": fluids.Tank, "sealed": fluids.Tank, "outflow": fluids.Tank}
    for name, kind in (kinds | {"periodic": fluids.Periodic, "solid": fluids.Solid}).items():
        value = getattr(scene, name)
        if value is not None and not isinstance(value, kind):
            raise SceneError(f"{name} must be a {kind.__name__} or None, got {_kind(value)}.")
    kind = fluids.Physics if isinstance(scene, FluidScene) else fluids.Gas
    if not isinstance(scene.physics, kind):
        raise SceneError(f"physics must be a {kind.__name__}, got {_kind(scene.physics)}.")


def _kind(value: object) -> str:
    if isinstance(value, np.ndarray | jax.Array):
        return f"an array of shape {list(value.shape)}, {value.dtype}"
    return f"{type(value).__name__} {value!r}"[:80]


def _check_array(name: str, value: object, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """Return a real array of a shape, of which None is any number."""
    if not isinstance(value, np.ndarray | jax.Array):
        raise SceneError(f"{name} must be an array of shape {what}, got {_kind(value)}: take numpy.asarray({name}, float).")
    array = np.asarray(value)
    fits = len(shape) == array.ndim and all(want in (None, got) for want, got in zip(shape, array.shape, strict=False))
    if not fits or array.dtype.kind not in "fiu":
        raise SceneError(f"{name} must be an array of shape {what}, real numbers, got {_kind(value)}.")
    return array


def _check_particles(scene: FluidScene | GasScene) -> None:
    positions = _check_array("positions", scene.positions, (None, None), "[n, d]")
    n, dim = positions.shape
    if dim not in (2, 3):
        raise SceneError(f"positions must be an array of shape [n, 2] or [n, 3], got {_kind(scene.positions)}.")
    if n == 0:
        raise SceneError("positions has no particle of fluid: make it larger, or its particles smaller.")
    if not np.isfinite(positions).all():
        raise SceneError(f"positions are not finite: particle {int(np.argwhere(~np.isfinite(positions))[0][0])} is not.")
    for name, what in _PER_PARTICLE.items():
        value = getattr(scene, name, None)
        if value is None and (name in _OPTIONAL or not hasattr(scene, name)):
            continue
        shape = (n, dim) if what == "nd" else (n,)
        array = _check_array(name, value, shape, f"{list(shape)}, as positions say")
        if np.isnan(array).any() or (name != "enters" and not np.isfinite(array).all()):
            raise SceneError(f"{name} are not finite: that of particle {int(np.argwhere(~np.isfinite(array))[0][0])} is not.")
        if name in ("masses", "densities") and not (array > 0).all():
            raise SceneError(f"{name} must be above 0: particle {int(np.argmin(array))} has {array.min()}.")
        if name == "energies" and not (array >= 0).all():
            raise SceneError(f"energies must not be below 0: particle {int(np.argmin(array))} has {array.min()}.")
    if scene.wall is not None:
        if not isinstance(scene.wall, np.ndarray | jax.Array) or scene.wall.shape != (n,) or scene.wall.dtype != bool:
            raise SceneError(f"wall must be an array of shape [{n}], bool, or None, got {_kind(scene.wall)}.")
        if scene.wall.all():
            raise SceneError("wall: there is no particle of fluid beside those of the wall: make the scene larger.")


def _check_number(name: str, value: Any, least: float = 0.0) -> float:  # noqa: ANN401
    """Return a finite number above a bound; of any sign, if that is -inf."""
    number = value if isinstance(value, int | float) else value.item() if isinstance(value, np.generic) else None
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise SceneError(f"{name} must be a number, got {_kind(value)}.")
    if not least < number < math.inf:
        raise SceneError(f"{name} must be a finite number{f' above {least:g}' if least > -math.inf else ''}, got {number!r}.")
    return float(number)


def _check_steps(scene: Scene) -> None:
    """Refuse steps that come to no end."""
    if scene.step is not None:
        _check_number("step", scene.step)
    if (most := longest_step(scene)) < scene.duration / MOST_STEPS:
        whose = "" if scene.step is not None else ", as smoothing, sound_speed, viscosity and cfl allow"
        raise SceneError(
            f"step: takes steps of {most:.3g} s for {scene.duration:.3g} s, expected up to {MOST_STEPS:.0e} steps{whose}"
        )


def longest_step(scene: Scene) -> float:
    """Return a time [s] that no step is longer than: the scene's own, or what sound and viscosity allow; infinite if not known.

    It is not known of a gas, nor of numbers that are traced.
    """
    if scene.step is not None or not isinstance(scene, FluidScene):
        return np.inf if scene.step is None else float(scene.step)
    physics = scene.physics
    nu = 0.0 if physics.viscosity is None else physics.viscosity
    numbers = (physics.smoothing, physics.sound_speed, physics.cfl, physics.density, nu)
    if any(isinstance(number, Tracer) for number in numbers):
        return np.inf
    h, c, cfl, density, nu = (np.float64(number) for number in numbers)
    with np.errstate(all="ignore"):
        return float(cfl / 0.25 * min(0.25 * h / c, viscosity.longest_step(physics.viscosity_form, nu, density, h)))


def _check_vector(name: str, value: object, dim: int) -> np.ndarray:
    """Return a number for each axis, of which some may be infinite."""
    numbers = np.asarray(value) if isinstance(value, list | tuple | np.ndarray | jax.Array) else np.zeros(())
    if numbers.shape != (dim,) or numbers.dtype.kind not in "fiu" or np.isnan(numbers).any():
        raise SceneError(f"{name} must have a number for each of {dim} axes, got {_kind(value)}.")
    return numbers


def _check_periodic(box: fluids.Periodic, dim: int) -> None:
    lower, lengths = (_check_vector(f"periodic.{part}", getattr(box, part), dim) for part in ("lower", "lengths"))
    if not (np.isfinite(lower) & (lengths > 0) & np.isfinite(lengths)).all():
        raise SceneError(f"periodic must have a finite lower corner and finite lengths above 0, got {box}.")
    axes = np.asarray(box.axes)
    if axes.shape != (dim,) or axes.dtype != bool:
        raise SceneError(f"periodic.axes must say of each of {dim} axes True or False, got {box.axes!r}.")


def _check_corners(name: str, lower: Sequence[float], upper: Sequence[float], dim: int) -> None:
    for part, corner in (("lower", lower), ("upper", upper)):
        _check_vector(f"{name}.{part}", corner, dim)
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise SceneError(f"{name} must reach from a lower to an upper corner, got {tuple(lower)!r} and {tuple(upper)!r}.")


def _check_inside(positions: np.ndarray, tank: fluids.Tank, most: float) -> None:
    """Refuse particles more than `most` [m] beyond a wall, onto which the first step puts them; rounding leaves some nearer."""
    outside = ((positions < np.asarray(tank.lower) - most) | (positions > np.asarray(tank.upper) + most)).any(axis=1)
    if outside.any():
        k = int(outside.argmax())
        raise SceneError(f"tank must hold all particles, but particle {k} is at {positions[k].tolist()} m, outside of {tank}.")


def _check_solid(solid: fluids.Solid, dim: int) -> None:
    vertices = _check_array("solid.vertices", solid.vertices, (None, dim), f"[v, {dim}]")
    faces = _check_array("solid.faces", solid.faces, (None, dim), f"[f, {dim}]")
    if not np.isfinite(vertices).all():
        raise SceneError("solid.vertices are not finite.")
    if faces.dtype.kind == "f" or (faces.size and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise SceneError(f"solid.faces must be whole numbers from 0 to {len(vertices) - 1}, numbers of vertices.")
    if not isinstance(solid.thin, bool | None):
        raise SceneError(f"solid.thin must be True, False or None, got {_kind(solid.thin)}.")
    if not len(faces):
        raise SceneError("solid.faces has no face: leave the solid out.")
    if solid.turning is not None:
        _check_turning(solid.turning, dim)


def _check_turning(turning: object, dim: int) -> None:
    if not isinstance(turning, fluids.Turning):
        raise SceneError(f"solid.turning must be a Turning or None, got {_kind(turning)}.")
    _check_number("solid.turning.rate", turning.rate, least=-math.inf)
    vectors = {"center": turning.center} | ({"axis": turning.axis} if dim == len("xyz") else {})
    for name, vector in vectors.items():
        if not np.isfinite(_check_vector(f"solid.turning.{name}", vector, dim)).all():
            raise SceneError(f"solid.turning.{name} must be finite, got {vector!r}.")
    if dim == len("xyz") and not np.any(turning.axis):
        raise SceneError("solid.turning.axis must have a length above 0, got 0 along each axis.")


def check_physics(physics: Any) -> None:  # noqa: ANN401
    """Refuse what the command line would, with the name of the field; numbers that are traced have no value to look at."""
    kinds = PHYSICS if isinstance(physics, fluids.Physics) else PHYSICS_OF_GASES
    for field in fields(physics):
        value = getattr(physics, field.name)
        if isinstance(value, Tracer):
            continue
        value = np.asarray(value).tolist() if isinstance(value, np.ndarray | np.generic | jax.Array) else value
        value = tuple(value) if isinstance(value, list) else value
        try:
            ranges.read(kinds[field.name], value, ranges.RANGES.get(field.name), strict=True)
        except ValueError as error:
            raise SceneError(f"physics.{field.name}: got {value!r}; {error}") from error


def _check_fluid(scene: FluidScene) -> None:
    """Refuse physics that does not go with where the particles are."""
    physics = scene.physics
    if np.ndim(scene.guided):
        each = _check_array("guided", scene.guided, (scene.n,), f"[] or [{scene.n}], as positions say")
        if not (np.isfinite(each) & (each >= 0)).all():
            raise SceneError(f"guided must be finite numbers from 0, got from {each.min()} to {each.max()}.")
    elif scene.guided != 0:
        _check_number("guided", scene.guided)
    if physics.gravity is not None and len(physics.gravity) != scene.dim:
        raise SceneError(f"gravity has {len(physics.gravity)} components, expected {scene.dim} in {scene.dim}D")
    check_smoothing(physics, scene.spacing)
    _check_thickness(scene)


def check_smoothing(physics: Any, spacing: float) -> None:  # noqa: ANN401
    """Refuse a smoothing length that meets no particles, or so many that they do not fit into memory."""
    if not LEAST_SMOOTHING <= float(physics.smoothing) / spacing <= MOST_SMOOTHING:
        expected = f"{LEAST_SMOOTHING:g} to {MOST_SMOOTHING:g} particle spacings of {spacing:.4g} m"
        raise SceneError(f"smoothing is {physics.smoothing:.4g} m, expected {expected}")


def _check_thickness(scene: FluidScene) -> None:
    """Refuse walls of dummies through which particles would see the empty space behind."""
    if scene.wall is None or scene.sealed is None:
        return
    support = KERNELS[scene.physics.kernel].support
    reach, dummies, half = support * scene.physics.smoothing, scene.positions[scene.wall], scene.spacing / 2
    depths = [np.array(scene.sealed.lower) - dummies.min(axis=0), dummies.max(axis=0) - np.array(scene.sealed.upper)]
    thick = [depth + half for side in depths for depth in side if np.isfinite(depth) and depth > 0]
    if thick and min(thick) < reach - 1.001 * half:
        raise SceneError(
            f"physics.kernel {scene.physics.kernel!r} reaches {support:g} smoothing lengths, {reach:.4g} m, but a wall of dummies "
            f"is {min(thick):.4g} m thick: take a smoothing up to {(min(thick) + half) / support:.4g} m, or thicker walls."
        )
