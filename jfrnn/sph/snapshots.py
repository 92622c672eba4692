"""What a run keeps of itself: snapshots as .npz, to go on from, and as .vtp, for ParaView; and a line of energies each."""

import errno
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax.numpy as jnp
import numpy as np

from jfrnn.cases.fluids import Scene
from jfrnn.sph import budget, origin, solids, solver, view
from jfrnn.sph.errors import SceneError
from jfrnn.sph.model import kind_of
from jfrnn.sph.particles import Flow, State, Thermal

UNITS = "SI: m, kg, s; in 2D of a slice 1 m thick"
_OF_LINES = {
    **dict.fromkeys(("kinetic", "potential", "thermal", "total"), ("J", "J/m")),
    **{"time": ("s", "s"), "momentum": ("kg m/s", "kg/s"), "top_speed": ("m/s", "m/s"), "clearance": ("m", "m")},
    "mass": ("kg", "kg/m"),
}


def time_of(s: State) -> float:
    """Return the time [s] as its dtype writes it: of float32 0.02, not 0.019999999553."""
    return float(str(np.asarray(s.time)))


def are_there(scene: Scene, s: State) -> np.ndarray:
    """Return which particles have entered and not left, shape [n], bool."""
    entered = np.ones(scene.n, bool) if scene.enters is None else scene.enters <= time_of(s)
    return entered if s.gone is None else entered & ~np.asarray(s.gone)


def save(state: State, scene: Scene, rho: np.ndarray, p: np.ndarray, folder: Path, step: int) -> None:
    """Write a state as STEP.npz, complete or not at all, and its particles that have entered as STEP.vtp, in the periodic box."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = state._asdict() | ({} if state.gas is None else state.gas._asdict())
    arrays = {name: np.asarray(value) for name, value in parts.items() if value is not None and name not in ("solid", "gas")}
    if state.solid is not None and state.solid.angle is not None:
        arrays["angle"] = np.asarray(state.solid.angle)
    whole, part = folder / f"{step:09d}.npz", folder / "part.npz"
    _write_vtk(arrays, scene, are_there(scene, state), {"density": rho, "pressure": p}, whole.with_suffix(".vtp"))
    np.savez(part, **arrays)  # pyright: ignore[reportArgumentType]
    part.replace(whole)


def latest(folder: Path, scene: Scene) -> tuple[State, int] | None:
    """Return the last state that was saved of a scene, and its step; None where there is none."""
    paths = sorted(path for path in folder.glob("*.npz") if path.stem.isdigit())
    if not paths:
        return None
    try:
        with paths[-1].open("rb") as stream, np.load(stream) as file:
            arrays = {name: jnp.asarray(file[name]) for name in file}
        angle, gas = arrays.pop("angle", None), [arrays.pop(name) for name in Thermal._fields if name in arrays]
        s = State(**arrays, gas=Thermal(*gas) if gas else None)  # pyright: ignore[reportArgumentType]
    except (ValueError, TypeError, EOFError, BadZipFile) as error:
        raise SceneError(f"{paths[-1]}: is no snapshot ({error}); remove it, and the run goes on from the one before") from error
    return s._replace(solid=kind_of(scene).beside(scene, s.x, angle)), int(paths[-1].stem)


@contextmanager
def hold(folder: Path) -> Iterator[None]:
    """Make the folder of a run, and let no other run write there; the system lets go of it with the process, however that ends.

    Raises:
        SceneError: Another run holds it, or it cannot be written.
    """
    with (_take(folder) / "lock").open("a") as file:
        with suppress(ImportError):  # not there on Windows
            import fcntl

            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise SceneError(f"{folder}: another run writes there now; wait until it ends, or take another folder") from error
            except OSError:  # of a file system without locks
                pass
        yield


def check_same(about: dict[str, Any], folder: Path) -> None:
    """Remember what the run is, or refuse a folder that holds another one."""
    path = folder / "run.json"
    if not path.exists() and any(folder.glob("snapshots/*.npz")):
        raise SceneError(f"{folder}: holds snapshots, but no run.json that says of what; take another folder, or remove it")
    text = json.dumps(about | {"units": UNITS, "made_by": origin.tell()}, indent=1, sort_keys=True)
    if not path.exists():
        _write_whole(text, path)
        return
    try:
        there = dict(json.loads(path.read_text()))
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: says no run ({error}); take another folder, or remove {folder}") from error
    asked = json.loads(json.dumps(about))
    there = {key: value for key, value in there.items() if key not in ("units", "made_by")}
    if _goes_on(there, asked):
        _write_whole(text, path)
        return
    if there != asked:
        different = [key for key in asked if asked[key] != there.get(key)]
        raise SceneError(f"{folder}: holds a run with another {', '.join(different)}; take another folder, or remove it")


def _write_whole(text: str, path: Path) -> None:
    """Write a file, complete or not at all: a kill, or a full disk, leaves the one that was there."""
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)


def _goes_on(there: dict[str, Any], asked: dict[str, Any]) -> bool:
    """Say whether a run is another one for longer: with as many snapshots more, between which there is as much time."""
    if there != asked | {key: there.get(key) for key in ("frames", "duration")}:
        return False
    (frames, duration), (more, longer) = ((about["frames"], about["duration"]) for about in (there, asked))
    return more > frames and abs(longer * frames - duration * more) <= 1e-9 * duration * more


def _take(folder: Path) -> Path:
    """Make the folder of a run, and return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        reason = "there is a file of that name" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror
        raise SceneError(f"{folder}: cannot be written ({reason}); name a folder that can be") from error
    return folder


def energies(model: Flow, state: State, scene: Scene) -> dict[str, float]:
    """Return a line of the energies: time [s], `solver.energies` [J] and their total, momentum [kg m/s], largest speed [m/s].

    Of a gas, also the largest smoothing length over the smallest. Where particles enter or leave, also the masses that came, that
    left and that are there [kg; in 2D kg/m]. Where there is a solid, also the least signed distance to it [m], infinite where
    nothing is within its reach.
    """
    moved = budget.momentum(model, state)
    fluid = np.ones(scene.n, bool) if scene.wall is None else ~scene.wall
    line = {
        "time": time_of(state),
        **(held := {name: float(value) for name, value in solver.energies(model, state).items()}),
        **{f"momentum_{axis}": float(moved[k]) for k, axis in enumerate("xyz"[: scene.dim])},
        "top_speed": float(np.linalg.norm(np.asarray(state.v)[fluid & are_there(scene, state)], axis=1).max(initial=0)),
    }
    line |= {"total": sum(held.values())}
    if state.gas is not None:
        line |= {"resolution": float(state.gas.h.max() / state.gas.h.min())}
    if scene.enters is not None or state.gone is not None:
        m, there = np.where(fluid, scene.masses, 0.0), are_there(scene, state)
        left = np.zeros(scene.n, bool) if state.gone is None else np.asarray(state.gone)
        line |= {"mass_in": m[there | left].sum(), "mass_out": m[left].sum(), "mass": m[there].sum()}
    distances = solids.clearance(scene, state)
    return line if distances is None else line | {"clearance": float(distances.min(initial=np.inf))}


def add_line(line: dict[str, float], path: Path, step: int) -> None:
    """Add a line to a CSV file, by heads of columns; lines of this step and later, of a run that was stopped, are removed before.

    Raises:
        SceneError: The file has other columns.
    """
    text = check_columns(line, path)
    text = text[:1] + [old for old in text[1:] if int(old.split(",")[0]) < step]
    _write_whole("\n".join([*text, ",".join([str(step), *(f"{value:.12g}" for value in line.values())])]) + "\n", path)


def check_columns(line: dict[str, float], path: Path) -> list[str]:
    """Return the lines of a CSV file to which one with such columns may be added: of a new one its head."""
    heads = ",".join(["step", *line])
    there = (path.read_text().splitlines() if path.exists() else []) or [heads]
    if there[0] != heads:
        raise SceneError(f"{path}: has the columns {there[0]}, and this run {heads}: give it the same probes, or another folder.")
    return there


def head(name: str, dim: int) -> str:
    """Return the head of a column of energies: with the unit, in 2D that of a slice 1 m thick, such as "kinetic [J/m]"."""
    kind = name.partition("_")[0] if name.startswith(("momentum", "mass")) else name
    if kind not in _OF_LINES:
        return name
    unit, per_meter = _OF_LINES[kind]
    return f"{name} [{unit if dim == len('xyz') else per_meter}]"


def add_to_series(path: Path, time: float, step: int) -> None:
    """Add STEP.vtp to a series that ParaView opens; those of this step and later are removed before."""
    kept = []
    if path.exists():
        lines = re.findall(r'^(<DataSet .*file="snapshots/(\d+)\.vtp"/>)$', path.read_text(), re.MULTILINE)
        kept = [line for line, number in lines if int(number) < step]
    kept.append(f'<DataSet timestep="{time:.12g}" file="snapshots/{step:09d}.vtp"/>')
    text = "\n".join(['<VTKFile type="Collection" version="0.1">', "<Collection>", *kept, "</Collection>", "</VTKFile>", ""])
    _write_whole(text, path)


def _write_vtk(arrays: dict[str, np.ndarray], scene: Scene, there: np.ndarray, values: dict[str, np.ndarray], path: Path) -> None:
    import pyvista

    flat = ((0, 0), (0, 3 - scene.dim))
    cloud = pyvista.PolyData(np.pad(view.wrap_positions(scene, arrays["x"])[there], flat))
    arrays_there = {"velocity": np.pad(arrays["v"][there], flat)} | {name: value[there] for name, value in values.items()}
    if scene.wall is not None:
        arrays_there["wall"] = scene.wall[there].astype(np.uint8)
    for name, value in arrays_there.items():
        if len(value):
            cloud.point_data[name] = value
        else:  # pyvista takes no empty array
            empty = pyvista.convert_array(np.zeros((1, *value.shape[1:]), value.dtype), name)
            empty.SetNumberOfTuples(0)
            cloud.GetPointData().AddArray(empty)
    cloud.field_data["time"] = [float(str(arrays["time"]))]
    cloud.save(path)
