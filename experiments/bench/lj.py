"""A Lennard-Jones liquid at constant energy, a benchmark that people know: steps per second, all of them in a compiled scan."""

import functools
import importlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jax import Array

import jfrnn
from experiments import _machine, _measure, methods
from experiments._commands import MOST_POINTS
from experiments.bench import table

DENSITY, TEMPERATURE, STEP = 0.8442, 1.44, 0.005  # in units of the potential, as in the benchmark of LAMMPS
ONSET, CUTOFF = 2.0, 2.5  # between which the potential goes to 0 smoothly, as that of jax-md does
SKINS = (0.1, 0.2, 0.3, 0.4, 0.6)
STEPS = {4096: 1000, 32_768: 500, 1_000_000: 200}  # of a scan on a GPU; on the CPU a tenth
MOST_ON_CPU = 32_768  # particles, unless sizes are asked for
JAX_MD = {"jax-md dense": "Dense", "jax-md ordered sparse": "OrderedSparse"}  # formats of its lists
COLUMNS = (
    *("platform", "n", "who", "skin", "skins", "steps", "steps_per_s", "ratio", "neighbors", "rebuilds", "drift"),
    *("temperature", "backend", "repeats", "status", "reason", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("n", "who", "skin", "steps", "steps_per_s", "ratio", "neighbors", "rebuilds", "drift", "temperature", "reason")

Sizes = Annotated[list[int] | None, typer.Option(min=64, max=MOST_POINTS, help="Numbers of particles; may be said several times.")]
Potential = Callable[[Array, Any], Array]  # of positions and what a way keeps; per particle


class _Liquid(NamedTuple):
    """Positions and velocities, and the periodic cube in which they move."""

    x: Array
    v: Array
    length: float

    @property
    def box(self) -> jfrnn.Box:
        """The cube."""
        return jfrnn.Box(np.full(3, self.length, np.float32))


class _Way(NamedTuple):
    """How forces are found.

    Attributes:
        keep: Returns what is kept from step to step, from a liquid and a skin.
        potential: The energy of each particle, from positions and what is kept.
        update: What is kept at new positions.
        reads_skin: Whether there is a list.
    """

    keep: Callable[[_Liquid, float], Any]
    potential: Potential
    update: Callable[[Any, Array], Any]
    reads_skin: bool = True


class _Run(NamedTuple):
    """What a scan ends with."""

    seconds: float
    x: Array
    v: Array
    kept: Any
    drift: float


# --- the command ------------------------------------------------------------------------------------------------------


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "lj",
    sizes: Sizes = None,
    steps: Annotated[int | None, typer.Option(min=1, max=1_000_000, help="Steps of a scan; default: by size.")] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Timed scans; skins are compared by one each.")] = 3,
) -> str:
    """Time a Lennard-Jones liquid (NVE, float32) by `pair_sum`, over a kept list, by distances, and by jax-md's `simulate.nve`.

    The skin is the one with which `pair_sum` over a list makes most steps; all lists have it. `drift` is how much the energy per
    particle changes in a scan, in units of the potential; ratios are to the fastest of jax-md, where it is installed.
    """
    platform = jax.default_backend()
    asked = sizes or [n for n in STEPS if platform != "cpu" or n <= MOST_ON_CPU]
    there = [methods.lacks("jax-md") is None]
    parts = [(f"{n} particles", functools.partial(_rows, n, _steps_of(n, steps), repeats)) for n in asked]
    return table.text(table.measure(out, platform, parts, [steps, repeats, there], COLUMNS), SHOWN)


def _steps_of(n: int, asked: int | None) -> int:
    if asked is not None:
        return asked
    on_gpu = next((count for most, count in STEPS.items() if n <= most), min(STEPS.values()))
    return on_gpu if jax.default_backend() != "cpu" else max(on_gpu // 10, 10)


def _rows(n: int, steps: int, repeats: int) -> Iterator[table.Line]:
    """Yield a row for each way; all begin with the liquid that the crystal has become."""
    start, around = make_crystal(n), _measure.Bystanders()
    melted = _run(WAYS["pair_sum, list"], start, SKINS[len(SKINS) // 2], steps, 1)
    liquid = start._replace(x=melted.x, v=melted.v)
    tried = {
        skin: _run(WAYS["pair_sum, list"], liquid, skin, steps, 1).seconds for skin in SKINS if CUTOFF + skin < start.length / 2
    }
    skin = min(tried, key=lambda each: tried[each])
    told = {"n": len(start.x), "steps": steps, "repeats": repeats, "skins": _tell(tried, steps)}
    rows = [told | _row(name, liquid, skin, steps, repeats) for name in WAYS]
    rows += [told | _row_of_jax_md(name, liquid, skin, steps, repeats) for name in JAX_MD]
    best = max((row["steps_per_s"] for row in rows if row["who"] in JAX_MD and "steps_per_s" in row), default=None)
    for row in rows:
        ratio = {} if best is None or "steps_per_s" not in row else {"ratio": round(row["steps_per_s"] / best, 2)}
        yield row | ratio | {"others_cores": around.cores()}


def _tell(tried: dict[float, float], steps: int) -> str:
    return ", ".join(f"{skin:g}: {steps / seconds:.4g}" for skin, seconds in tried.items())


def _row(name: str, liquid: _Liquid, skin: float, steps: int, repeats: int) -> table.Line:
    way = WAYS[name]
    done = _run(way, liquid, skin, steps, repeats)
    row = {
        "who": name,
        "status": "ok",
        "steps_per_s": steps / done.seconds,
        "drift": done.drift,
        "temperature": _temperature(done.v),
    }
    if not way.reads_skin:
        return row
    kept: jfrnn.NeighborList = done.kept
    counts = {"neighbors": float(np.mean(kept.count)), "rebuilds": int(kept.rebuild_count), "backend": kept.backend}
    return row | counts | {"skin": skin}


def make_crystal(n: int) -> _Liquid:
    """Return about n particles on a cubic lattice, a little off their sites, with velocities of the temperature."""
    rng, side = np.random.default_rng(n), max(round(n ** (1 / 3)), 4)
    length = side / DENSITY ** (1 / 3)
    sites = np.stack(np.meshgrid(*[np.arange(side) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = (sites + rng.uniform(-0.05, 0.05, sites.shape)) * (length / side)
    v = rng.normal(scale=math.sqrt(TEMPERATURE), size=x.shape)
    return _Liquid(jnp.asarray(x, jnp.float32), jnp.asarray(v - v.mean(axis=0), jnp.float32), length)


# --- ways -------------------------------------------------------------------------------------------------------------


def energy_of(square: Array) -> Array:
    """Return the potential of a pair from the square of its distance, half of which belongs to each particle."""
    sixth = 1 / (square * square * square)
    onset, cutoff = ONSET**2, CUTOFF**2
    fade = (cutoff - square) ** 2 * (cutoff + 2 * square - 3 * onset) / (cutoff - onset) ** 3
    return 4 * (sixth * sixth - sixth) * jnp.where(square < onset, 1, fade)


def _of_pair(r: Array, _i: None, _j: None) -> Array:
    return energy_of(r @ r) / 2


def _by_search(x: Array, box: jfrnn.Box) -> Array:
    return jfrnn.pair_sum(_of_pair, x, CUTOFF, box=box)


def _by_list(x: Array, nbrs: jfrnn.NeighborList) -> Array:
    return jfrnn.pair_sum(_of_pair, x, None, neighbors=nbrs)


def _by_distances(x: Array, nbrs: jfrnn.NeighborList) -> Array:
    distances, mask = nbrs.distances(x)
    square = jnp.where(mask, distances, 1) ** 2
    return jnp.sum(jnp.where(mask, energy_of(square) / 2, 0), axis=1)


def _search(liquid: _Liquid, skin: float, reverse: bool) -> jfrnn.NeighborList:
    return jfrnn.search(liquid.x, CUTOFF, skin=skin, box=liquid.box, slack=1.25, reverse=reverse)


WAYS = {
    "pair_sum": _Way(lambda liquid, _: liquid.box, _by_search, lambda box, _: box, reads_skin=False),
    "pair_sum, list": _Way(functools.partial(_search, reverse=False), _by_list, lambda nbrs, x: nbrs.update(x)),
    "distances, grad": _Way(functools.partial(_search, reverse=True), _by_distances, lambda nbrs, x: nbrs.update(x)),
}


def _run(way: _Way, liquid: _Liquid, skin: float, steps: int, repeats: int) -> _Run:
    """Let velocities and positions take turns (velocity Verlet), and return the median time of a scan."""

    def force(x: Array, kept: Any) -> Array:  # noqa: ANN401
        return -jax.grad(lambda x: jnp.sum(way.potential(x, kept)))(x)

    def step(state: tuple[Array, Array, Array, Any], _: None) -> tuple[tuple[Array, Array, Array, Any], None]:
        x, v, f, kept = state
        v = v + STEP / 2 * f
        x = x + STEP * v
        kept = way.update(kept, x)
        f = force(x, kept)
        return (x, v + STEP / 2 * f, f, kept), None

    @jax.jit
    def scan(x: Array, v: Array, kept: Any) -> tuple[Array, Array, Any]:  # noqa: ANN401
        x, v, _, kept = jax.lax.scan(step, (x, v, force(x, kept), kept), None, length=steps)[0]
        return x, v, kept

    kept = way.keep(liquid, skin)
    energy = jax.jit(lambda x, kept: way.potential(x, kept))
    jax.block_until_ready(scan(liquid.x, liquid.v, kept))
    (x, v, end), seconds = _measure.repeat(lambda: jax.block_until_ready(scan(liquid.x, liquid.v, kept)), repeats, 0.0, repeats)
    if way.reads_skin:
        end.check()
    before, after = (_total(energy(at, held), speed) for at, held, speed in ((liquid.x, kept, liquid.v), (x, end, v)))
    drift = (after - before) / len(x)
    return _Run(_measure.summarize(seconds)["median_s"], x, v, end, drift)


def _total(potential: Array, v: Array) -> float:
    return float(np.sum(np.asarray(potential, np.float64)) + np.sum(np.square(np.asarray(v, np.float64))) / 2)


def _temperature(v: Array) -> float:
    return float(np.mean(np.square(np.asarray(v, np.float64))))


# --- jax-md -----------------------------------------------------------------------------------------------------------


def _row_of_jax_md(name: str, liquid: _Liquid, skin: float, steps: int, repeats: int) -> table.Line:
    row: table.Line = {"who": name, "skin": skin}
    found = table.ask(row, "jax-md", lambda: _run_jax_md(JAX_MD[name], liquid, skin, steps, repeats))
    return row if found is None else row | {"status": "ok", "peer": _machine.versions(["jax-md"])["jax-md"]} | found


def _run_jax_md(form: str, liquid: _Liquid, skin: float, steps: int, repeats: int) -> table.Line:
    """Return the columns of jax-md's own simulation, with its potential, its list and its integrator."""
    energy, partition, simulate, space = (
        importlib.import_module(f"jax_md.{name}") for name in ("energy", "partition", "simulate", "space")
    )
    displacement, shift = space.periodic(liquid.length)
    options = {"r_onset": ONSET, "r_cutoff": CUTOFF, "dr_threshold": skin, "capacity_multiplier": 1.25}
    neighbors, potential = energy.lennard_jones_neighbor_list(
        displacement, liquid.length, format=partition.NeighborListFormat[form], **options
    )
    wrapped = jnp.mod(liquid.x, liquid.length)
    nbrs = neighbors.allocate(wrapped)
    begin, apply = simulate.nve(potential, shift, STEP)
    state = begin(jax.random.PRNGKey(0), wrapped, kT=TEMPERATURE, mass=1.0, neighbor=nbrs).set(momentum=liquid.v)

    def step(state: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        moving, nbrs = state
        moving = apply(moving, neighbor=nbrs)
        return (moving, nbrs.update(moving.position)), None

    @jax.jit
    def scan(state: Any, nbrs: Any) -> tuple[Any, Any]:  # noqa: ANN401
        return jax.lax.scan(step, (state, nbrs), None, length=steps)[0]

    jax.block_until_ready(scan(state, nbrs))
    (end, last), seconds = _measure.repeat(lambda: jax.block_until_ready(scan(state, nbrs)), repeats, 0.0, repeats)
    if bool(last.did_buffer_overflow):
        raise RuntimeError("its list overflowed")
    of_all = [float(potential(at.position, neighbor=held)) for at, held in ((state, nbrs), (end, last))]
    kinetic = [np.sum(np.square(np.asarray(at.momentum, np.float64))) / 2 for at in (state, end)]
    drift = (of_all[1] + kinetic[1] - of_all[0] - kinetic[0]) / len(wrapped)
    seconds = _measure.summarize(seconds)["median_s"]
    return {"steps_per_s": steps / seconds, "drift": float(drift), "temperature": _temperature(end.momentum)}
