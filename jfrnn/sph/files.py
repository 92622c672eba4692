"""What a scene may take from files: initial particles, and a solid."""

from dataclasses import replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from jfrnn.cases import fluids
from jfrnn.cases.fluids import GasScene, Scene
from jfrnn.sph.errors import SceneError

_LARGEST_SOLID = 100  # times what the scene shows: files in millimeters are 1000 times as large as they say
_FARTHEST_SOLID = 10  # likewise, away from it: a fluid may fall on a solid


def with_particles(scene: Scene, path: Path | str) -> Scene:
    """Return the scene with the fluid of a file; its walls stay.

    Args:
        scene: A scene.
        path: .npz with positions [n, d] and, if wanted, velocities [n, d] and masses [n]; or .csv with a line of names: x, y, z,
            then vx, vy, vz and m, if wanted. Velocities are 0 without, masses those of the scene's first particle.

    Raises:
        SceneError: The file cannot be used, or the scene is a gas.
    """
    if isinstance(scene, GasScene):
        raise SceneError(f"initial {path}: says nothing of thermal energies, which scene {scene.name!r} needs; leave it out")
    arrays = _read(Path(path), scene.dim)
    try:
        given = {name: np.asarray(array).astype(np.float64, casting="same_kind") for name, array in arrays.items()}
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


def with_solid(scene: Scene, path: Path | str, unit: float = 1.0) -> Scene:
    """Return the scene with the triangles of a file as its solid, which stands.

    Args:
        scene: A scene in 3D.
        path: STL, OBJ, PLY; faces counterclockwise as seen from the fluid.
        unit: Length of a unit of the file [m].

    Raises:
        SceneError: The file cannot be used, or its triangles lie far from what the scene shows, or are of quite another size.
    """
    if scene.dim != len("xyz"):
        raise SceneError(f"solid {path}: triangles are a wall in 3D; {scene.name} is in {scene.dim}D")
    solid = read_solid(path, unit)
    corners = [scene.positions] if scene.bounds is None else [scene.positions, scene.bounds.lower, scene.bounds.upper]
    (low, high), (least, most) = ((x.min(axis=0), x.max(axis=0)) for x in (np.vstack(corners), solid.vertices))
    size, span = np.max(most - least), max(np.max(high - low), scene.spacing)
    away = np.max(np.maximum(least - high, low - most))
    where = f"from {_place(least)} to {_place(most)} m, the scene from {_place(low)} to {_place(high)} m"
    if away > _FARTHEST_SOLID * span:
        raise SceneError(f"solid {path}: reaches {where}; move it there, or name the unit of the file, 0.001 for mm")
    if size < scene.spacing or size > _LARGEST_SOLID * span:
        raise SceneError(f"solid {path}: is {size:.3g} m long, {where}; name the unit of the file, 0.001 for mm")
    return replace(scene, solid=solid)


def read_solid(path: Path | str, unit: float = 1.0) -> fluids.Solid:
    """Return the triangles of a file, STL, OBJ or PLY; corners that coincide, as STL writes them, are one.

    Args:
        path: The file; faces counterclockwise as seen from the fluid.
        unit: Length of a unit of the file [m].

    Raises:
        SceneError: The file holds no triangles, or a corner is not finite.
    """
    import trimesh

    if not Path(path).is_file():
        raise SceneError(f"solid {path} is no file: name an STL, OBJ or PLY.")
    try:
        mesh = trimesh.load(path, force="mesh")  # which merges vertices
    except Exception as error:  # readers of trimesh raise of any kind
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"solid {path} is no mesh that trimesh reads ({reason}): name an STL, OBJ or PLY.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise SceneError(f"solid {path} holds no triangles.")
    vertices = np.asarray(mesh.vertices, np.float64) * unit
    if not (finite := np.isfinite(vertices).all(axis=1)).all():
        raise SceneError(f"solid {path}: vertices must be finite; one is {vertices[~finite][0].tolist()}")
    return fluids.Solid(vertices, np.asarray(mesh.faces, np.int32))


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
        **{"enters": None, "guided": 0.0, "densities": None, "pressures": None},
    )


def _read(path: Path, dim: int) -> dict[str, np.ndarray]:
    if path.suffix not in (".npz", ".csv"):
        raise SceneError(f"{path}: unknown ending {path.suffix!r}; allowed: .csv, .npz")
    try:
        if path.suffix == ".npz":
            with path.open("rb") as stream, np.load(stream) as file:
                given = {key: file[key] for key in file}
        else:
            if not path.read_bytes().strip():
                raise ValueError("it is empty")
            table = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, dtype=np.float64))
            given = _columns(table, "xyz"[:dim])
    except OSError as error:
        reason = error.strerror or str(error)
        raise SceneError(f"initial {path}: cannot be read ({reason}); expected a file .npz or .csv") from error
    except (ValueError, TypeError, AttributeError, EOFError, BadZipFile) as error:
        raise SceneError(f"{path}: cannot be read: {error}") from error
    unknown = sorted(given.keys() - {"positions", "velocities", "masses"})
    if unknown:
        raise SceneError(f"{path}: {', '.join(unknown)} means nothing; expected arrays positions, velocities, masses")
    if "positions" not in given:
        raise SceneError(f"{path}: no positions; expected arrays positions, velocities, masses, or columns x, y, vx, vy, m")
    return given


def _columns(table: np.ndarray, axes: str) -> dict[str, np.ndarray]:
    names = table.dtype.names or ()
    wanted = {"positions": list(axes), "velocities": [f"v{axis}" for axis in axes]}
    known = [*axes, *wanted["velocities"], "m"]
    unknown = [name for name in names if name not in known]
    some = [name for name in wanted["velocities"] if name in names]
    if unknown or len(some) not in (0, len(axes)):
        which = (
            f"{', '.join(unknown)} means nothing"
            if unknown
            else f"of {', '.join(wanted['velocities'])}, there is {', '.join(some)} alone"
        )
        raise ValueError(f"{which}; columns are {', '.join(known)}")
    given = {key: np.stack([table[c] for c in columns], axis=1) for key, columns in wanted.items() if set(columns) <= set(names)}
    return given | ({"masses": table["m"]} if "m" in names else {})
