"""Scaling over devices: lists, sums and steps of a fluid on 1 to k of them, and what travels between them."""

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

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
from experiments._config import Dtype, Keyed, Positive, Table, load
from experiments._library import Name
from experiments._loop import Task, fill
from experiments._rows import RowFile, TimedRow
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
    steps: Annotated[int, Field(ge=1)] = 10  # of the fluid, per timed run
    check_most: Annotated[int, Field(ge=0)] = 40_000_000  # one device counts pairs, and runs the fluid, up to so many particles
    virtual_devices: Annotated[int, Field(ge=0)] = 0  # of the CPU; 0: the devices that there are
    backend: Literal["auto", "warp", "jax"] = "auto"

    def specs(self) -> Iterator["Spec"]:
        """Yield the rows, those of one kind of work side by side."""
        shared = self.model_dump(exclude={"devices", "scaling", "work", "axes", "virtual_devices"})
        for scaling, work, axes in itertools.product(self.scaling, self.work, self.axes):
            yield from (Spec(scaling=scaling, work=work, axes=axes, devices=devices, **shared) for devices in self.devices)


@dataclass(frozen=True)
class Spec(Keyed):
    """What one row measures, and how: fields as in `Config`."""

    scaling: str
    work: str
    devices: int
    side: int
    nx: int
    axes: int
    cutoff_ratio: float
    dtype: str
    repeats: int
    min_seconds: float
    steps: int
    check_most: int
    backend: Name


@dataclass(kw_only=True)
class DeviceRow(TimedRow):
    """One kind of work on a number of devices; times are of a list, a sum, or a step."""

    scaling: str
    work: str
    axes: int
    devices: int
    dtype: str
    particles: int | None = None  # of all devices
    fluid: int | None = None  # of these, those that are no wall; None but for "sph"
    fullest: int | None = None  # of the fullest device
    halo: int | None = None  # particles that are sent to others, of all devices and messages, each time positions are exchanged
    halo_bytes: int | None = None  # their coordinates [bytes]
    # What all devices send to others per run or step, padding, values and ids included, as compiled [bytes].
    sent_bytes: int | None = None
    halo_s: float | None = None  # to choose the halo, with which a list, and each update of the solver, begins [s]
    migrate_s: float | None = None  # to balance the load and to move particles, few after the first time; with a halo [s]
    pairs: int | None = None  # neighbors of all particles together; None for "sph"
    pairs_of_one: int | None = None  # as one device counts them, up to `check_most` particles
    # Particles whose number of neighbors is another on one device; of a fluid those that are elsewhere after `steps`, by more than
    # a hundredth of a spacing, or were at any other place when it began.
    differing: int | None = None
    # Rows up to version 4df7264 have it: of each GPU in one run, the time from its first kernel to its last [s], how long
    # kernels were at work [s], and the longest of them.
    busy: list[dict[str, Any]] | None = None


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


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[DeviceRow]:
    """Measure all rows that are not there yet; they are added to rows.jsonl one by one."""
    tasks = [Task((x.key,), f"{x.scaling} {x.work} on {x.devices}", lambda _, x=x: [_row(x)]) for x in config.specs()]
    about = {"device": jax.devices()[0].device_kind, "versions": _machine.versions()}
    return fill(RowFile(folder, DeviceRow), tasks, lambda row: row.reason, retry_failed=retry_failed, about=about)


def _row(spec: Spec) -> DeviceRow:
    row = DeviceRow(key=spec.key, scaling=spec.scaling, work=spec.work, axes=spec.axes, devices=spec.devices, dtype=spec.dtype)
    if spec.devices > jax.device_count():
        return replace(row, status="skipped", reason=f"there are {jax.device_count()} devices")
    try:
        (_sph if spec.work == "sph" else _search)(spec, row)
    except Exception as error:
        row.status, row.reason = "failed", f"{type(error).__name__}: {error}"[:500]
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
    sides = (spec.side * (spec.devices if spec.scaling == "weak" else 1), spec.side, spec.side)
    x = np.stack(np.meshgrid(*(np.arange(s, dtype=spec.dtype) for s in sides), indexing="ij"), axis=-1).reshape(-1, 3)
    return x + np.random.default_rng(0).uniform(-0.3, 0.3, x.shape).astype(spec.dtype)


def _weight(r: Array, i: Any, j: Any) -> Array:  # noqa: ANN401
    return j["m"] * jnp.maximum(1 - (r @ r) / 9, 0) ** 3


def _search(spec: Spec, row: DeviceRow) -> None:
    x, cutoff, backend = lattice(spec), spec.cutoff_ratio, spec.backend
    particles = distributed.scatter(x, cutoff, {"m": np.ones(len(x), x.dtype)}, mesh=mesh_of(spec.devices, spec.axes))
    _describe(particles, spec, row)
    counts = distributed.count(particles, cutoff, backend=backend)
    row.pairs = int(np.asarray(counts).sum(dtype=np.int64))
    if spec.work == "list":
        capacity = -(-int(jnp.max(counts)) // 8) * 8
        work = jax.jit(lambda p: distributed.search(p, cutoff, capacity=capacity, backend=backend))
    else:
        work = jax.jit(lambda p: distributed.pair_sum(_weight, p, cutoff, p.values, backend=backend))
    _time(work, particles, 1, spec, row)
    row.status = "ok"
    if len(x) <= spec.check_most:
        ids, ours = np.asarray(particles.ids), np.asarray(counts)
        one = np.asarray(jfrnn.count(jnp.asarray(x), cutoff, backend=backend))
        row.pairs_of_one = int(one.sum(dtype=np.int64))
        there = ids >= 0
        row.differing = int((one[ids[there]] != ours[there]).sum()) + abs(len(x) - int(there.sum()))
        if row.differing:
            row.status, row.reason = "failed", "neighbors differ from those of one device"


def _sph(spec: Spec, row: DeviceRow) -> None:
    from jfrnn.cases import fluids
    from jfrnn.sph import spread
    from jfrnn.sph.model import make_model, make_state

    depth = 0.5 * (spec.devices if spec.scaling == "weak" else 1)
    scene = fluids.fluid("dam-break-3d", nx=spec.nx, depth=depth)
    kind = np.dtype(spec.dtype).type

    def begin(mesh: Mesh) -> spread.Flow:
        along = (1, 0, 2)[: mesh.devices.ndim]  # the tank's depth first: a slab has as much water and wall as any other
        return spread.begin(spread.spread(make_model(scene, kind, spec.backend), make_state(scene, kind), mesh, along=along))

    first = begin(mesh_of(spec.devices, spec.axes))
    flow = spread.run(first, spec.steps)  # room that is missing is made before anything is timed
    _describe(flow.particles, spec, row)
    row.fluid = int(jnp.sum(flow.particles.active & ~flow.particles.values["wall"]))
    if spec.devices > 1 and flow.particles.total <= spec.check_most:
        ways = [scene.positions, spread.run(begin(mesh_of(1, 1)), spec.steps).particles]
        row.differing = sum(map(partial(_elsewhere, 0.01 * scene.spacing), ways, (first.particles, flow.particles)))
        if row.differing:
            row.status, row.reason = "failed", "particles are elsewhere than on one device"
            return
    del first
    _time(lambda flow: spread.advance(flow, spec.steps), flow, spec.steps, spec, row, spread.advance)
    row.status = "ok"


def _elsewhere(far: float, one: np.ndarray | distributed.Particles, other: distributed.Particles) -> int:
    """Count particles that are farther apart than `far` along any axis, or not finite."""
    x, y = (np.asarray(p) if isinstance(p, np.ndarray) else distributed.collect(p)[0] for p in (one, other))
    return int((~(np.abs(x - y) <= far)).any(axis=1).sum())


def _describe(particles: distributed.Particles, spec: Spec, row: DeviceRow) -> None:
    """Say how many particles there are, on the fullest device, and in halos, and what halos and migration take."""
    halo = distributed.halo(particles)
    row.particles, row.halo = particles.total, int(halo.sent)
    row.fullest = int(np.asarray(particles.active).reshape(row.devices, -1).sum(axis=1).max())
    row.halo_bytes = row.halo * particles.dim * particles.positions.dtype.itemsize
    row.halo_s = _time_repeats(lambda: distributed.halo(particles), spec)["median_s"]
    settled = distributed.migrate(particles)
    row.migrate_s = _time_repeats(lambda: distributed.migrate(settled), spec)["median_s"]


def _time_repeats(call: Callable[[], Any], spec: Spec) -> dict[str, Any]:
    _, seconds = _measure.repeat(lambda: jax.block_until_ready(call()), spec.repeats, spec.min_seconds, 10 * spec.repeats)
    return _measure.summarize(seconds)


def _time(work: Callable[[Any], Any], given: Any, per: int, spec: Spec, row: DeviceRow, compiled: Any = None) -> None:  # noqa: ANN401
    """Time calls of compiled work, and add up what it sends."""
    arguments = (given,) if compiled is None else (given, spec.steps)
    program: Any = compiled or work
    text = program.lower(*arguments).compile().as_text()
    row.sent_bytes = sent_bytes(text)
    (row.first_s,) = _measure.repeat(lambda: jax.block_until_ready(work(given)), 1, 0.0, 1)[1]  # what it made is gone, it is large
    timed = _time_repeats(lambda: work(given), spec)
    row.median_s, row.p10_s, row.p90_s = (timed[name] / per for name in ("median_s", "p10_s", "p90_s"))
    row.repeats = timed["repeats"]


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


def report(rows: list[DeviceRow], folder: Path) -> str:
    """Return the table of a run, and write it beside the rows: efficiency is a device's particles per second over one alone."""
    table = pd.DataFrame([asdict(row) for row in rows])
    rates = [None if not row.median_s or not row.particles else row.particles / row.median_s / row.devices for row in rows]
    alone = {(row.scaling, row.work, row.axes): rate for row, rate in zip(rows, rates, strict=True) if row.devices == 1}
    ones = [alone.get((row.scaling, row.work, row.axes)) for row in rows]
    table["efficiency"] = [None if not rate or not one else rate / one for rate, one in zip(rates, ones, strict=True)]
    for name, seconds in (("ms", "median_s"), ("halo_ms", "halo_s"), ("migrate_ms", "migrate_s")):
        table[name] = 1e3 * table[seconds].astype(float)
    names = "scaling work axes devices particles fluid fullest halo halo_bytes sent_bytes ms efficiency halo_ms migrate_ms status"
    columns = names.split()
    table[columns].to_csv(folder / "table.csv", index=False)
    return table[columns].to_string(index=False, float_format="%.3g")
