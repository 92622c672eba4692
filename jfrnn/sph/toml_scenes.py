"""A scene of one's own from a TOML file: blocks and meshes to fill, walls, what acts, inflow, outflow, a solid that may turn."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

import jfrnn
from jfrnn.cases.fluids import FluidScene, Periodic, Physics, Tank, Turning, inflow, lattice
from jfrnn.sph import ranges
from jfrnn.sph.check import check_physics, check_scene, check_smoothing
from jfrnn.sph.errors import SceneError
from jfrnn.sph.files import read_solid, with_solid
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.relaxing import relax

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Many = Annotated[int, Field(ge=ranges.MANY["ge"], le=ranges.MANY["le"])]
Place = list[Annotated[float, Field(allow_inf_nan=False)]]
_MOST = 1e8  # particles
_NEAR = 0.4  # spacings: boxes side by side are filled by as many particles as fit, rounded, so that half a spacing may be between


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Block(_Table):
    """A box full of particles, from a lower to an upper corner [m]; or the inside of a mesh of the file, whose unit is in m."""

    lower: Place | None = None
    upper: Place | None = None
    file: str | None = None
    unit: Positive | None = None
    velocity: Place | None = None


class Walls(_Table):
    """A tank of dummy particles around a lower and an upper corner [m]; `open` names sides without, such as "+z"."""

    lower: Place
    upper: Place
    open: list[Literal["-x", "+x", "-y", "+y", "-z", "+z"]] = []


class Inflow(_Table):
    """A block, one spacing thick along the axis that its velocity is most along, whose particles enter in layers for a time [s]."""

    lower: Place
    upper: Place
    velocity: Place
    duration: Positive


class SolidFile(_Table):
    """A closed wall of triangles: a file, its unit [m], and how it turns."""

    file: str
    unit: Positive = 1.0
    center: Place | None = None
    axis: Place | None = None
    rate: float | None = None


class Corners(_Table):
    """A lower and an upper corner [m], or infinite."""

    lower: list[float]
    upper: list[float]


class Box(_Table):
    """A box that repeats itself along axes such as "xy"."""

    lower: Place
    upper: Place
    axes: str


class Output(_Table):
    """What a run writes: a snapshot each so many seconds, or so many of them; the rest as in `How`."""

    interval: Positive | None = None
    frames: Many | None = None
    lines: Many = 1
    pictures: bool = True
    hdf: bool = False


class Own(_Table):
    """The whole file."""

    spacing: Positive
    duration: Positive
    step: Positive | None = None
    fill: list[Block] = []
    walls: list[Walls] = []
    inflow: list[Inflow] = []
    outflow: Corners | None = None
    periodic: Box | None = None
    bounds: Corners | None = None
    solid: SolidFile | None = None
    output: Output = Output()
    relax: bool = False
    physics: dict[str, Any]


def read_scene(path: Path | str) -> FluidScene:
    """Return the scene of a TOML file; `docs/own-scene.md` shows one.

    Raises:
        SceneError: The file cannot be read, has keys that mean nothing or values out of range, or the scene cannot be run.
    """
    return read_file(path)[0]


def read_file(path: Path | str) -> tuple[FluidScene, dict[str, Any]]:
    """Return the scene of a TOML file, and what its `[output]` says, by the names that `How` has for it.

    Raises:
        SceneError: As `read_scene`; or there is no whole number of intervals in the duration.
    """
    path = Path(path)
    given = _read(path)
    try:
        output, scene = _read_output(given), _make(given, path)
        check_scene(scene)
        _check_apart(scene)
        return (relax(scene) if given.relax else scene), output
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _read_output(given: Own) -> dict[str, Any]:
    said, interval = given.output.model_dump(exclude_unset=True), given.output.interval
    if interval is None:
        return said
    if given.output.frames is not None:
        raise SceneError("output: has an interval and frames, of which one says all; leave the other out")
    frames = round(given.duration / interval)
    if frames < 1 or abs(frames * interval - given.duration) > 1e-9 * given.duration:
        raise SceneError(f"output.interval: a duration of {given.duration:g} s is no whole number of {interval:g} s")
    return {name: value for name, value in said.items() if name != "interval"} | {"frames": frames}


def _read(path: Path) -> Own:
    try:
        return Own.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: is no TOML ({error})") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).removeprefix(".")
        raise SceneError(f"{path}: {where}: {first['msg'].lower()}, got {first['input']!r}"[:300]) from error


def _make(given: Own, path: Path) -> FluidScene:
    dx, physics = given.spacing, _physics(given)
    parts = []
    for block in given.fill:
        x = _fill(block, given, path)
        v = np.zeros(x.shape[1]) if block.velocity is None else np.array(block.velocity)
        if v.shape != x.shape[1:]:
            raise SceneError(f"fill.velocity must have {x.shape[1]} numbers, got {block.velocity}")
        parts.append((x, np.broadcast_to(v, x.shape), *np.zeros((2, len(x)))))
    layers = int(np.ceil(KERNELS[physics.kernel].support * physics.smoothing / dx * (1 - 1e-12)))
    for way in given.inflow:
        x, v, enters = _inflow(way, dx)
        parts.append((x, v, enters, np.full(len(x), layers * dx / float(np.abs(way.velocity).max()))))
    walls = [_tank(each, dx, layers) for each in given.walls]
    parts += [(x, np.zeros_like(x), *np.zeros((2, len(x)))) for x in walls]
    if not parts or len({x.shape[1] for x, *_ in parts}) != 1:
        raise SceneError("fill, inflow and walls must hold particles, all in 2D or all in 3D")
    x, v, enters, guided = (np.concatenate(column) for column in zip(*parts, strict=True))
    dim, dummies = x.shape[1], sum(map(len, walls))
    scene = FluidScene(
        name=path.stem,
        positions=x,
        velocities=np.array(v, float),
        masses=np.full(len(x), physics.density * dx**dim),
        spacing=dx,
        duration=given.duration,
        step=given.step,
        wall=np.arange(len(x)) >= len(x) - dummies if dummies else None,
        periodic=given.periodic and _periodic(given.periodic, dim),
        bounds=given.bounds and Tank(tuple(given.bounds.lower), tuple(given.bounds.upper)),
        enters=enters if given.inflow else None,
        guided=guided if given.inflow else 0.0,
        outflow=given.outflow and Tank(tuple(given.outflow.lower), tuple(given.outflow.upper)),
        physics=physics,
    )
    return scene if given.solid is None else _with_solid(scene, given.solid, path)


def _periodic(box: Box, dim: int) -> Periodic:
    if len(box.lower) != dim or len(box.upper) != dim:
        raise SceneError(f"periodic: corners must have {dim} numbers, got {box.lower} and {box.upper}")
    lengths = tuple((np.array(box.upper) - box.lower).tolist())
    if not box.axes or set(box.axes) - set("xyz"[:dim]):
        raise SceneError(f"periodic.axes must name axes of {'xyz'[:dim]!r}, got {box.axes!r}")
    return Periodic(tuple(box.lower), lengths, tuple(axis in box.axes for axis in "xyz"[:dim]))


def _physics(given: Own) -> Physics[float, tuple[float, ...]]:
    told = {"smoothing": 1.5 * given.spacing, "pressure": "mean", "density_diffusion": 0.1} | given.physics
    told |= {"gravity": tuple(told["gravity"])} if isinstance(told.get("gravity"), list) else {}
    try:
        physics: Any = Physics(**told)
    except TypeError as error:
        raise SceneError(f"physics: {str(error).partition(') ')[2] or error}") from error
    check_physics(physics)
    check_smoothing(physics, given.spacing)  # walls are as thick as it reaches
    return physics


def _cells(lower: Place, upper: Place, spacing: float, what: str) -> NDArray[np.float64]:
    """Return centers of the cells of a box, as many as fit."""
    cells = [(high - low) / spacing for low, high in zip(lower, upper, strict=False)]
    if len(lower) != len(upper) or len(lower) not in (2, 3) or min(cells) <= 1 / 2:
        raise SceneError(f"{what}: from {lower} to {upper} there is no room for particles {spacing:g} m apart, in 2D or 3D")
    _check_number_of(math.prod(cells), what)
    return lattice(lower, [round(each) for each in cells], spacing)


def _check_number_of(particles: float, what: str) -> None:
    if particles > _MOST:
        raise SceneError(f"{what}: asks for {particles:.3g} particles, expected up to {_MOST:.0e}: take a larger spacing")


def _inflow(way: Inflow, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return particles that enter, with velocities and times: layers follow each other a spacing apart along the nearest axis."""
    if len(way.velocity) != len(way.lower) or not any(way.velocity):
        raise SceneError(f"inflow.velocity must have {len(way.lower)} numbers that are not all 0, got {way.velocity}")
    layer, along = _cells(way.lower, way.upper, spacing, "inflow"), np.abs(way.velocity)
    if np.ptp(layer[:, along.argmax()]) > spacing / 2:
        raise SceneError(
            f"inflow must be one spacing of {spacing:g} m thick along {'xyz'[along.argmax()]}, as its velocity is, "
            f"got a block from {way.lower} to {way.upper}: its layers would enter into each other"
        )
    layers = way.duration * along.max() / spacing
    _check_number_of(layers * len(layer), "inflow")
    if layers * (1 + 1e-12) < 1:
        raise SceneError(f"inflow.duration: in {way.duration:g} s not one layer enters, which takes {spacing / along.max():g} s")
    return inflow(layer, way.velocity, spacing * float(np.linalg.norm(way.velocity) / along.max()), way.duration)


def _check_apart(scene: FluidScene) -> None:
    """Refuse parts that overlap: particles that are there at first and nearer to each other than parts side by side can be."""
    low, dx, box = scene.positions.min(axis=0), scene.spacing, None
    if scene.periodic is not None:
        lengths, corner = (np.array(part) for part in (scene.periodic.lengths, scene.periodic.lower))
        box = jfrnn.Box(lengths / dx, scene.periodic.axes, (corner - low) / dx)
    there = None if scene.enters is None else scene.enters <= 0
    met = np.asarray(jfrnn.count(((scene.positions - low) / dx).astype(np.float32), _NEAR, box=box, active=there))
    if met.any():
        at = ", ".join(f"{part:.4g}" for part in scene.positions[met.argmax()])
        raise SceneError(f"fill, inflow and walls overlap: the particle at ({at}) m is within {_NEAR:g} spacings of another")


def _fill(block: Block, given: Own, path: Path) -> NDArray[np.float64]:
    if block.file is None:
        if block.lower is None or block.upper is None or block.unit is not None:
            raise SceneError("fill: name a lower and an upper corner, or a file, which may have a unit")
        return _cells(block.lower, block.upper, given.spacing, "fill")
    if block.lower is not None or block.upper is not None:
        raise SceneError(f"fill: has corners and file {block.file!r}, of which one says all; leave the other out")
    import trimesh

    solid, dx = read_solid(path.parent / block.file, block.unit or 1.0), given.spacing
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    sites = _cells(low.tolist(), (low + np.maximum(np.ceil((high - low) / dx), 1) * dx).tolist(), dx, "fill")
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    if not mesh.is_watertight:
        raise SceneError(f"fill: {block.file} must be a closed mesh, to have an inside")
    inside = sites[mesh.contains(sites)]
    if not len(inside):
        raise SceneError(f"fill: in {block.file} there is no room for particles {dx:g} m apart; name its unit, 0.001 for mm")
    return inside


def _tank(walls: Walls, spacing: float, layers: int) -> NDArray[np.float64]:
    """Return dummies in layers around a box, without those of open sides."""
    inner = _cells(walls.lower, walls.upper, spacing, "walls")
    low, thick = np.array(walls.lower), layers * spacing
    counts = np.round((inner.max(axis=0) - inner.min(axis=0)) / spacing).astype(int) + 1
    high = low + counts * spacing
    around = lattice((low - thick).tolist(), (counts + 2 * layers).tolist(), spacing)
    outside = (around < low) | (around > high)
    axes = "xyz"[: len(low)]
    if sides := [side for side in walls.open if side[1] not in axes]:
        raise SceneError(f"walls.open: in {len(axes)}D there is no side {sides[0]!r}")
    for k, axis in enumerate(axes):
        if f"-{axis}" in walls.open:
            outside[around[:, k] < low[k]] = False
        if f"+{axis}" in walls.open:
            outside[around[:, k] > high[k]] = False
    return around[outside.any(axis=1)]


def _with_solid(scene: FluidScene, given: SolidFile, path: Path) -> FluidScene:
    solid = with_solid(scene, path.parent / given.file, given.unit).solid
    assert solid is not None, "it was read"
    if given.rate is None and (given.center is not None or given.axis is not None):
        raise SceneError("solid: has a center or an axis, and no rate at which it turns")
    if given.rate is not None:
        axis = None if given.axis is None else tuple(given.axis)
        solid = replace(solid, turning=Turning(tuple(given.center or (0.0, 0.0, 0.0)), axis, given.rate))
    return replace(scene, solid=solid)
