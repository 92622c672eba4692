"""Scaling over devices: lists, sums and steps of a fluid on 1 to k of them, and what travels between them."""

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import typer
from jax import Array
from jax.sharding import Mesh
from pydantic import Field, FiniteFloat

import jfrnn
from experiments import _machine, _measure
from experiments._commands import RetryFailed, RowsFolder, take_folder
from experiments._config import Dtype, Positive, Table, load
from experiments.bench import table
from jfrnn import distributed

_SENDS = re.compile(r"= (.*?) collective-permute(?:-start)?\((.*?)\),.*?source_target_pairs=\{(.*?)\}\}")
_NESTED = re.compile(r"\[.*?\]|\{.*?\}")  # shape and layout of an operand, which hold commas too
_ARRAY = re.compile(r"(\w+)\[([\d,]*)\]")
_BYTES = {"pred": 1, "s32": 4, "u32": 4, "f32": 4, "f64": 8, "s64": 8}


class Config(Table):
    """What is measured."""

    devices: tuple[Annotated[int, Field(ge=1)], ...] = (1, 2, 4, 8)  # numbers of devices; those that are not there are skipped
    scaling: tuple[Literal["strong", "weak"], ...] = ("strong", "weak")  # the same particles on all of them; as many on each
    # A list is made; a density; a step of the 3D dam break.
    work: tuple[Literal["list", "pair_sum", "sph"], ...] = ("list", "pair_sum", "sph")
    side: Annotated[int, Field(ge=2)] = 317  # particles along an edge of the cube, in all ("strong") or per device ("weak")
    nx: Annotated[int, Field(ge=2)] = 250  # likewise of the dam break: particles along the width of its column
    axes: tuple[Literal[1, 2, 3], ...] = (1,)  # along how many space is cut, at most; devices are split among them evenly
    cutoff_ratio: Positive = 3.0  # cutoff of lists and sums, in spacings of a jittered lattice
    dtype: Dtype = "float32"  # of all numbers
    repeats: Annotated[int, Field(ge=1)] = 20  # fewest timed runs
    min_seconds: Annotated[FiniteFloat, Field(ge=0)] = 0.5  # runs go on until they took this long together [s]
    together: Annotated[int, Field(ge=1)] = 1  # calls per timed run, of which the last is waited for: as steps follow each other
    steps: Annotated[int, Field(ge=1)] = 10  # of the fluid, per call
    check_most: Annotated[int, Field(ge=0)] = 40_000_000  # one device counts pairs, and runs the fluid, up to so many particles
    virtual_devices: Annotated[int, Field(ge=0)] = 0  # of the CPU; 0: the devices that there are
    backend: Literal["auto", "warp", "jax"] = "auto"

    def specs(self) -> Iterator["Spec"]:
        """Yield the rows, those of one kind of work side by side."""
        yield from (Spec(self, *each) for each in itertools.product(self.scaling, self.work, self.axes, self.devices))


class Spec(NamedTuple):
    """What one row measures, and the config that says how."""

    config: Config
    scaling: str
    work: str
    axes: int
    devices: int


COLUMNS = (  # of the printed table; what rows hold, `_row` says
    *("scaling", "work", "axes", "devices", "particles", "fluid", "fullest", "halo", "halo_bytes", "sent_bytes", "ms"),
    *("efficiency", "halo_ms", "migrate_ms", "status"),
)


def prepare(config: Config) -> None:
    """Ask for the devices of a config, before anything else asks for one."""
    os.environ.setdefault("NCCL_NVLS_ENABLE", "0")  # NVLink multicast: nothing here gains by it
    jax.config.update("jax_enable_x64", config.dtype == "float64")
    if config.virtual_devices:
        jax.config.update("jax_num_cpu_devices", config.virtual_devices)
        jax.config.update("jax_platforms", "cpu")


def command(
    config: Annotated[Path, typer.Argument(help="Config of scaling over devices, TOML.")],
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> str:
    """Time lists, sums and steps of a fluid on 1 to k devices, or go on with it; then print a table."""
    given, folder = load(config, Config), take_folder(out or Path("out") / config.stem)
    prepare(given)
    return report(run(given, folder, retry_failed), folder)


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[table.Line]:
    """Measure all rows that are not there yet; they are added to rows.jsonl one by one."""
    parts = [(" ".join(map(str, x[1:])), lambda x=x: [_row(x)]) for x in config.specs()]
    given = config.model_dump(exclude={"devices", "scaling", "work", "axes", "virtual_devices"})
    about = {"versions": _machine.versions()}
    return table.fill_parts(folder, parts, given, about, lambda row: row.get("reason"), retry_failed)


def _row(spec: Spec) -> table.Line:
    """Return a row.

    - particles, of all devices; fullest, of the fullest device; fluid: those that are no wall, of "sph".
    - halo: particles that are sent to others, of all devices and messages, each time positions are exchanged; halo_bytes: their
      coordinates; sent_bytes: what all devices send per run or step, padding, values and ids included, as compiled.
    - halo_s: to choose the halo, with which a list, and each update of the solver, begins; migrate_s: to balance the load and to
      move particles, few after the first time; with a halo. Other times are of a list, a sum, or a step.
    - pairs: neighbors of all particles together; pairs_of_one: as one device counts them, up to `check_most` particles.
    - differing: particles whose number of neighbors is another on one device; of a fluid those that are elsewhere after `steps`,
      by more than a hundredth of a spacing, or were at any other place when it began.

    Rows up to version 4df7264 have `busy`: of each GPU in one run, the time from its first kernel to its last [s], how long kernels
    were at work [s], and the longest of them.
    """
    row: table.Line = {name: getattr(spec, name) for name in ("scaling", "work", "axes", "devices")} | {"dtype": spec.config.dtype}
    if spec.devices > jax.device_count():
        return row | {"status": "skipped", "reason": f"there are {jax.device_count()} devices"}
    row["status"] = "ok"
    table.ask(row, None, lambda: (_sph if spec.work == "sph" else _search)(spec, row))
    return row


def mesh_of(devices: int, axes: int) -> Mesh:
    """Return a mesh of the first devices, split among up to so many axes as evenly as their number allows."""
    shape, left = [], devices
    for k in range(axes, 0, -1):
        divisors = [d for d in range(1, left + 1) if left % d == 0]
        part = divisors[int(np.argmin([abs(d**k - left) for d in divisors]))]
        shape, left = [*shape, part], left // part
    shape = sorted((s for s in shape if s > 1), reverse=True) or [1]
    return Mesh(np.array(jax.devices()[:devices]).reshape(shape), tuple("xyz"[: len(shape)]))


def lattice(spec: Spec) -> np.ndarray:
    """Return a jittered lattice with spacing 1, [n, 3]: a cube, or one for each device in a row."""
    side, dtype = spec.config.side, spec.config.dtype
    sides = (side * (spec.devices if spec.scaling == "weak" else 1), side, side)
    x = np.stack(np.meshgrid(*(np.arange(s, dtype=dtype) for s in sides), indexing="ij"), axis=-1).reshape(-1, 3)
    return x + np.random.default_rng(0).uniform(-0.3, 0.3, x.shape).astype(dtype)


def _weight(r: Array, i: Any, j: Any) -> Array:  # noqa: ANN401
    return j["m"] * jnp.maximum(1 - (r @ r) / 9, 0) ** 3


def _search(spec: Spec, row: table.Line) -> None:
    x, cutoff, backend = lattice(spec), spec.config.cutoff_ratio, spec.config.backend
    particles = distributed.scatter(x, cutoff, {"m": np.ones(len(x), x.dtype)}, mesh=mesh_of(spec.devices, spec.axes))
    _describe(particles, spec, row)
    counts = distributed.count(particles, cutoff, backend=backend)
    row["pairs"] = int(np.asarray(counts).sum(dtype=np.int64))
    if spec.work == "list":
        capacity = -(-int(jnp.max(counts)) // 8) * 8
        work = jax.jit(lambda p: distributed.search(p, cutoff, capacity=capacity, backend=backend))
    else:
        work = jax.jit(lambda p: distributed.pair_sum(_weight, p, cutoff, p.values, backend=backend))
    _time(work, particles, 1, spec, row)
    if len(x) <= spec.config.check_most:
        ids, ours = np.asarray(particles.ids), np.asarray(counts)
        one = np.asarray(jfrnn.count(jnp.asarray(x), cutoff, backend=backend))
        row["pairs_of_one"] = int(one.sum(dtype=np.int64))
        there = ids >= 0
        row["differing"] = int((one[ids[there]] != ours[there]).sum()) + abs(len(x) - int(there.sum()))
        if row["differing"]:
            row |= {"status": "failed", "reason": "neighbors differ from those of one device"}


def _sph(spec: Spec, row: table.Line) -> None:
    from jfrnn.cases import fluids
    from jfrnn.sph import spread
    from jfrnn.sph.model import make_model, make_state

    depth = 0.5 * (spec.devices if spec.scaling == "weak" else 1)
    scene = fluids.fluid("dam-break-3d", nx=spec.config.nx, depth=depth)
    kind = np.dtype(spec.config.dtype).type

    def begin(mesh: Mesh) -> spread.Flow:
        along = (1, 0, 2)[: mesh.devices.ndim]  # the tank's depth first: a slab has as much water and wall as any other
        return spread.begin(spread.spread(make_model(scene, kind, spec.config.backend), make_state(scene, kind), mesh, along=along))

    first, steps = begin(mesh_of(spec.devices, spec.axes)), spec.config.steps
    flow = spread.run(first, steps)  # room that is missing is made before anything is timed
    _describe(flow.particles, spec, row)
    row["fluid"] = int(jnp.sum(flow.particles.active & ~flow.particles.values["wall"]))
    if spec.devices > 1 and flow.particles.total <= spec.config.check_most:
        ways = [scene.positions, spread.run(begin(mesh_of(1, 1)), steps).particles]
        row["differing"] = sum(map(partial(_elsewhere, 0.01 * scene.spacing), ways, (first.particles, flow.particles)))
        if row["differing"]:
            row |= {"status": "failed", "reason": "particles are elsewhere than on one device"}
            return
    del first
    _time(lambda flow: spread.advance(flow, steps), flow, steps, spec, row, spread.advance)


def _elsewhere(far: float, one: np.ndarray | distributed.Particles, other: distributed.Particles) -> int:
    """Count particles that are farther apart than `far` along any axis, or not finite."""
    x, y = (np.asarray(p) if isinstance(p, np.ndarray) else distributed.collect(p)[0] for p in (one, other))
    return int((~(np.abs(x - y) <= far)).any(axis=1).sum())


def _describe(particles: distributed.Particles, spec: Spec, row: table.Line) -> None:
    """Say how many particles there are, on the fullest device, and in halos, and what halos and migration take."""
    halo = distributed.halo(particles)
    row |= {"particles": particles.total, "halo": int(halo.sent)}
    row["fullest"] = int(np.asarray(particles.active).reshape(row["devices"], -1).sum(axis=1).max())
    row["halo_bytes"] = row["halo"] * particles.dim * particles.positions.dtype.itemsize
    row["halo_s"] = _time_repeats(lambda: distributed.halo(particles), spec)["median_s"]
    settled = distributed.migrate(particles)
    row["migrate_s"] = _time_repeats(lambda: distributed.migrate(settled), spec)["median_s"]


def _time_repeats(call: Callable[[], Any], spec: Spec) -> dict[str, Any]:
    fewest, least, together = spec.config.repeats, spec.config.min_seconds, spec.config.together

    def calls() -> None:
        for _ in range(together - 1):
            call()
        jax.block_until_ready(call())

    return _measure.summarize([seconds / together for seconds in _measure.repeat(calls, fewest, least, 10 * fewest)[1]])


def _time(work: Callable[[Any], Any], given: Any, per: int, spec: Spec, row: table.Line, compiled: Any = None) -> None:  # noqa: ANN401
    """Time calls of compiled work, and add up what it sends."""
    arguments = (given,) if compiled is None else (given, spec.config.steps)
    program: Any = compiled or work
    text = program.lower(*arguments).compile().as_text()
    row["sent_bytes"] = sent_bytes(text)
    # what the first call makes is gone, it is large
    (row["first_s"],) = _measure.repeat(lambda: jax.block_until_ready(work(given)), 1, 0.0, 1)[1]
    timed = _time_repeats(lambda: work(given), spec)
    row |= {name: timed[name] / per for name in ("median_s", "p10_s", "p90_s")} | {"repeats": timed["repeats"]}


def sent_bytes(program: str) -> int:
    """Return what all devices send to others in one pass over a compiled program: by its collective permutes [bytes].

    Arrays may travel together; of what has only begun the result names what it takes before what it gives: as many of its arrays
    count as there are operands.
    """
    total = 0
    for result, operands, moves in _SENDS.findall(program):
        arrays = _ARRAY.findall(result)[: 1 + _NESTED.sub("", operands).count(",")]
        sizes = [_BYTES[kind] * math.prod(int(size) for size in shape.split(",") if size) for kind, shape in arrays]
        total += sum(sizes) * moves.count("{")
    return total


def report(rows: list[table.Line], folder: Path) -> str:
    """Return the table of a run, and write it beside the rows: efficiency is a device's particles per second over one alone."""
    frame = pd.DataFrame(rows).reindex(columns=[*dict.fromkeys((*COLUMNS, "median_s", "halo_s", "migrate_s"))])
    rate = frame["particles"] / frame["median_s"].astype(float) / frame["devices"]
    kinds = [frame[name] for name in ("scaling", "work", "axes")]
    frame["efficiency"] = rate / rate.where(frame["devices"] == 1).groupby(kinds).transform("max")
    for name, seconds in (("ms", "median_s"), ("halo_ms", "halo_s"), ("migrate_ms", "migrate_s")):
        frame[name] = 1e3 * frame[seconds].astype(float)
    frame[[*COLUMNS]].to_csv(folder / "table.csv", index=False)
    return table.text(frame, COLUMNS)
