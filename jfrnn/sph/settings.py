"""What a run may be told: `--set key=value` for a scene, and files of initial particles."""

import inspect
import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_type_hints
from zipfile import BadZipFile

import numpy as np

from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene, GasScene, Scene
from jfrnn.sph import ranges
from jfrnn.sph.errors import SceneError

SCENES: dict[str, Callable[..., Scene]] = {**fluids.FLUIDS, **fluids.GASES}
_HINTS = {"Number": float, "Vector": tuple[float, ...]}
PHYSICS, PHYSICS_OF_GASES = (get_type_hints(kind, localns=_HINTS) for kind in (fluids.Physics, fluids.Gas))
LEAST_SMOOTHING, MOST_SMOOTHING = 0.1, 50.0  # in particle spacings
MOST_STEPS = 1e9
_LARGEST_SOLID = 100  # times what the scene shows: files in millimeters are 1000 times as large as they say


def make_scene(name: str, settings: list[str]) -> Scene:
    """Return a scene with settings "key=value": of the scene's function, or of its physics.

    Raises:
        SceneError: There is no such scene or key, the value is out of its range, or values do not go together.
    """
    of_scene, of_physics = parameters(name), physics_of(name)
    chosen: dict[str, dict[str, Any]] = {"scene": {}, "physics": {}}
    for setting in settings:
        key, sign, text = setting.partition("=")
        if not sign:
            raise SceneError(f"--set {setting}: expected key=value")
        if key not in of_scene and key not in of_physics:
            raise SceneError(f"--set {key}: unknown; of {name}: {', '.join(of_scene)}; physics: {', '.join(of_physics)}")
        kind = "scene" if key in of_scene else "physics"
        chosen[kind][key] = _value(name, key, text, of_scene.get(key, of_physics.get(key)))
    said = "".join(f" --set {setting}" for setting in settings)
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused below
            scene: Any = SCENES[name](**chosen["scene"])
    except (ValueError, ZeroDivisionError, OverflowError, MemoryError) as error:
        raise SceneError(f"scene {name!r}{said}: cannot be made ({error})") from error
    scene = replace(scene, physics=replace(scene.physics, **chosen["physics"]))
    if (wrong := _complaint(scene)) is not None:
        raise SceneError(f"scene {name!r}{said}: {wrong}")
    return scene


def parameters(name: str) -> dict[str, Any]:
    """Return the settings of a scene's function with their annotations.

    Raises:
        SceneError: There is no such scene.
    """
    if name not in SCENES:
        raise SceneError(f"unknown fluid scene {name!r}; allowed: {', '.join(SCENES)}")
    return {key: item.annotation for key, item in inspect.signature(SCENES[name]).parameters.items() if key != "name"}


def physics_of(name: str) -> dict[str, Any]:
    """Return the settings of the physics of a scene, by its name, with their annotations."""
    return PHYSICS_OF_GASES if name in fluids.GASES else PHYSICS


def _complaint(scene: Scene) -> str | None:
    """Say which settings do not go together, None where they do."""
    fluid = scene.n if scene.wall is None else int((~scene.wall).sum())
    if fluid == 0:
        return "has no particle of fluid: make it larger, or its particles smaller"
    for name in ("positions", "velocities", "masses", "energies"):
        if not np.isfinite(getattr(scene, name, 0)).all():
            return f"its {name} are not finite"
    if isinstance(scene, FluidScene) and (wrong := _complaint_of_physics(scene)) is not None:
        return wrong
    if scene.step is not None and not scene.duration / MOST_STEPS <= scene.step < math.inf:
        return f"takes steps of {scene.step:.3g} s for {scene.duration:.3g} s, expected up to {MOST_STEPS:.0e} steps"
    if scene.step == 0:
        return f"takes steps of 0 s for {scene.duration:.3g} s"
    return None


def _complaint_of_physics(scene: FluidScene) -> str | None:
    gravity, smoothing = scene.physics.gravity, scene.physics.smoothing / scene.spacing
    if gravity is not None and len(gravity) != scene.dim:
        return f"gravity has {len(gravity)} components, expected {scene.dim} in {scene.dim}D"
    if not LEAST_SMOOTHING <= smoothing <= MOST_SMOOTHING:
        spacing = f"{LEAST_SMOOTHING:g} to {MOST_SMOOTHING:g} particle spacings of {scene.spacing:.4g} m"
        return f"smoothing is {scene.physics.smoothing:.4g} m, expected {spacing}"
    return None


def _value(scene: str, key: str, text: str, kind: Any) -> Any:  # noqa: ANN401
    try:
        value = json.loads(text)
    except ValueError:
        value = None if text.lower() == "none" else text
    try:
        return ranges.read(kind, value, ranges.of(scene, key))
    except ValueError as error:
        raise SceneError(f"--set {key}: got {text!r}; {error}") from error


def with_particles(scene: Scene, path: Path) -> Scene:
    """Return the scene with the fluid of a file; its walls stay.

    Args:
        scene: A scene.
        path: .npz with positions [n, d] and, if wanted, velocities [n, d] and masses [n]; or .csv with a line of names: x, y, z,
            then vx, vy, vz and m, if wanted. Velocities are 0 without, masses those of the scene's first particle.

    Raises:
        SceneError: The file cannot be used, or the scene is a gas.
    """
    if isinstance(scene, GasScene):
        raise SceneError(f"--initial {path}: says nothing of thermal energies, which scene {scene.name!r} needs; leave it out")
    arrays = _read(path, scene.dim)
    try:
        given = {name: np.asarray(array, np.float64) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: holds what are no numbers: {error}") from error
    positions = given["positions"]
    if positions.ndim != 2 or positions.shape[1] != scene.dim:
        raise SceneError(f"{path}: positions must have shape [n, {scene.dim}], got {list(positions.shape)}")
    velocities = given.get("velocities", np.zeros_like(positions))
    masses = given.get("masses", np.full(len(positions), scene.masses[0]))
    if velocities.shape != positions.shape or masses.shape != positions.shape[:1]:
        raise SceneError(f"{path}: velocities {list(velocities.shape)} and masses {list(masses.shape)} must fit the positions")
    for name, array in (("positions", positions), ("velocities", velocities), ("masses", masses)):
        if not np.isfinite(array).all():
            raise SceneError(f"{path}: {name} must be finite; particle {int(np.argwhere(~np.isfinite(array))[0][0])} is not")
    if len(positions) == 0 or not (masses > 0).all():
        raise SceneError(f"{path}: expected at least one particle, and masses above 0")
    return _replace_particles(scene, positions, velocities, masses)


def with_solid(scene: Scene, path: Path, scale: float) -> Scene:
    """Return the scene with the triangles of a file as its solid, which stands.

    Args:
        scene: A scene in 3D.
        path: STL, OBJ, PLY; faces counterclockwise as seen from the fluid.
        scale: Length of a unit of the file [m].

    Raises:
        SceneError: The file cannot be used, or its triangles lie beside what the scene shows.
    """
    if scene.dim != len("xyz"):
        raise SceneError(f"--solid {path}: triangles are a wall in 3D; {scene.name} is in {scene.dim}D")
    vertices, faces = _read_mesh(path)
    vertices = vertices * scale
    if not (finite := np.isfinite(vertices).all(axis=1)).all():
        raise SceneError(f"--solid {path}: vertices must be finite; one is {vertices[~finite][0].tolist()}")
    corners = [scene.positions] if scene.bounds is None else [scene.positions, scene.bounds.lower, scene.bounds.upper]
    (low, high), (least, most) = ((x.min(axis=0), x.max(axis=0)) for x in (np.vstack(corners), vertices))
    size, span = np.max(most - least), np.max(high - low)
    where = f"from {_place(least)} to {_place(most)} m, the scene from {_place(low)} to {_place(high)} m"
    if np.any(least > high) or np.any(most < low):
        raise SceneError(f"--solid {path}: reaches {where}; move it there, or name its unit: --solid-unit 0.001 for mm")
    if size < scene.spacing or size > _LARGEST_SOLID * span:
        raise SceneError(f"--solid {path}: is {size:.3g} m long, {where}; name its unit: --solid-unit 0.001 for mm")
    return replace(scene, solid=fluids.Solid(vertices, faces))


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [v, 3] and faces [f, 3] of a file; vertices that coincide, as STL writes them, are one."""
    import trimesh

    if not path.is_file():
        raise SceneError(f"--solid {path} is no file: name an STL, OBJ or PLY.")
    try:
        mesh = trimesh.load(path, force="mesh")  # which merges vertices
    except Exception as error:  # readers of trimesh raise of any kind
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"--solid {path} is no mesh that trimesh reads ({reason}): name an STL, OBJ or PLY.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise SceneError(f"--solid {path} holds no triangles.")
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)


def _place(corner: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in corner) + ")"


def _replace_particles(scene: Scene, positions: np.ndarray, velocities: np.ndarray, masses: np.ndarray) -> Scene:
    """Return the scene with these particles, all of them there from the beginning, before its walls."""
    walls = np.zeros(scene.n, bool) if scene.wall is None else scene.wall
    return replace(
        scene,
        positions=np.concatenate([positions, scene.positions[walls]]),
        velocities=np.concatenate([velocities, scene.velocities[walls]]),
        masses=np.concatenate([masses, scene.masses[walls]]),
        wall=None if scene.wall is None else np.arange(len(positions) + walls.sum()) >= len(positions),
        **{"enters": None, "densities": None, "pressures": None},
    )


def _read(path: Path, dim: int) -> dict[str, np.ndarray]:
    if path.suffix not in (".npz", ".csv"):
        raise SceneError(f"{path}: unknown ending {path.suffix!r}; allowed: .csv, .npz")
    try:
        if path.suffix == ".npz":
            with path.open("rb") as stream, np.load(stream) as file:
                given = {key: file[key] for key in file}
        else:
            table = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=np.float64))
            given = _columns(table, "xyz"[:dim])
    except OSError as error:
        reason = error.strerror or str(error)
        raise SceneError(f"--initial {path}: cannot be read ({reason}); expected a file .npz or .csv") from error
    except (ValueError, TypeError, AttributeError, EOFError, BadZipFile) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    if "positions" not in given:
        raise SceneError(f"{path}: no positions; expected arrays positions, velocities, masses, or columns x, y, vx, vy, m")
    return given


def _columns(table: np.ndarray, axes: str) -> dict[str, np.ndarray]:
    names = table.dtype.names or ()
    wanted = {"positions": list(axes), "velocities": [f"v{axis}" for axis in axes]}
    given = {key: np.stack([table[c] for c in columns], axis=1) for key, columns in wanted.items() if set(columns) <= set(names)}
    return given | ({"masses": table["m"]} if "m" in names else {})


def describe(scene: Scene) -> dict[str, Any]:
    """Return what a scene says, but its particles: what a run must have in common with one that it goes on with."""
    assert isinstance(scene, FluidScene | GasScene), "a scene is of one of two kinds"
    physics = {item.name: getattr(scene.physics, item.name) for item in fields(scene.physics)}
    return {"name": scene.name, "particles": scene.n, "duration": scene.duration, "step": scene.step, "physics": physics}
