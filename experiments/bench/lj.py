"""A Lennard-Jones liquid at constant energy, a benchmark that people know: steps per second, all of them in a compiled scan."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jax import Array

import jfrnn
from experiments import _measure, methods
from experiments._commands import MOST_POINTS
from experiments.bench import table
from experiments.bench.lj_peers import CUTOFF, PEERS, STEP, Asked, Liquid, Ran, energy_of, kinetic_of, make_crystal
from experiments.bench.lj_peers import rows as rows_of_peers

SKINS = (0.1, 0.2, 0.3, 0.4, 0.6)
STEPS = {4096: 1000, 32_768: 500, 262_144: 300, 1_000_000: 200}  # of a scan on a GPU; on the CPU a tenth
MOST_ON_CPU = 32_768  # particles, unless sizes are asked for
COLUMNS = (
    *("platform", "n", "who", "skin", "skins", "steps", "steps_per_s", "ratio", "neighbors", "rebuilds", "drift"),
    *("temperature", "differs", "backend", "repeats", "status", "reason", "others_cores", "device", "jax", "warp", "peer"),
    *("commit", "dirty"),
)
SHOWN = ("n", "who", "skin", "steps", "steps_per_s", "ratio", "neighbors", "rebuilds", "drift", "temperature", "differs", "reason")

Sizes = Annotated[list[int] | None, typer.Option(min=125, max=MOST_POINTS, help="Numbers of particles; may be said several times.")]
Potential = Callable[[Array, Any], Array]  # of positions and what a way keeps; per particle


class _Way(NamedTuple):
    """How forces are found.

    Attributes:
        keep: Returns what is kept from step to step, from a liquid and a skin.
        potential: The energy of each particle, from positions and what is kept.
        update: What is kept at new positions.
        reads_skin: Whether there is a list.
    """

    keep: Callable[[Liquid, float], Any]
    potential: Potential
    update: Callable[[Any, Array], Any]
    reads_skin: bool = True


class _Run(NamedTuple):
    """What a way came to, the liquid at the end of a scan, and what was kept."""

    ran: Ran
    end: Liquid
    kept: Any


# --- the command ------------------------------------------------------------------------------------------------------


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "lj",
    sizes: Sizes = None,
    steps: Annotated[int | None, typer.Option(min=1, max=1_000_000, help="Steps of a scan; default: by size.")] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Timed scans; skins are compared by one each.")] = 3,
) -> str:
    """Time a Lennard-Jones liquid (NVE) by `pair_sum`, over a kept list, by distances, and by jax-md, OpenMM and LAMMPS.

    The skin is the one with which `pair_sum` over a list makes most steps; all lists have it, but OpenMM's. `drift` is how much the
    energy per particle changes in a scan, in units of the potential; ratios are to the fastest of the others. `differs` says what
    about a way is not as in `pair_sum` over a list, in float32.
    """
    platform = jax.default_backend()
    asked = sizes or [n for n in STEPS if platform != "cpu" or n <= MOST_ON_CPU]
    there = [methods.lacks(peer.package) is None for peer in PEERS.values()]
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
    liquid = _run(WAYS["pair_sum, list"], start, SKINS[len(SKINS) // 2], steps, 1).end
    tried = {
        skin: _run(WAYS["pair_sum, list"], liquid, skin, steps, 1).ran.seconds for skin in SKINS if CUTOFF + skin < start.length / 2
    }
    skin = min(tried, key=lambda each: tried[each])
    told = {"n": len(start.x), "steps": steps, "repeats": repeats, "skins": _tell(tried, steps)}
    rows = [told | _row(name, liquid, skin, steps, repeats) for name in WAYS]
    rows += [told | row for row in rows_of_peers(Asked(liquid, skin, steps, repeats))]
    best = max((row["steps_per_s"] for row in rows if row["who"] in PEERS and "steps_per_s" in row), default=None)
    for row in rows:
        ratio = {} if best is None or "steps_per_s" not in row else {"ratio": round(row["steps_per_s"] / best, 2)}
        yield row | ratio | {"others_cores": around.cores()}


def _tell(tried: dict[float, float], steps: int) -> str:
    return ", ".join(f"{skin:g}: {steps / seconds:.4g}" for skin, seconds in tried.items())


def _row(name: str, liquid: Liquid, skin: float, steps: int, repeats: int) -> table.Line:
    wide = jax.config.read("jax_enable_x64")
    dtype = np.float64 if name == WIDE else np.float32
    jax.config.update("jax_enable_x64", wide or name == WIDE)
    try:
        ran = _run(WAYS[name], liquid._replace(x=liquid.x.astype(dtype), v=liquid.v.astype(dtype)), skin, steps, repeats).ran
    finally:
        jax.config.update("jax_enable_x64", wide)
    return {"who": name, "differs": "float64" if name == WIDE else ""} | ran.columns(len(liquid.x), steps)


# --- ways -------------------------------------------------------------------------------------------------------------


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


def _search(liquid: Liquid, skin: float, reverse: bool) -> jfrnn.NeighborList:
    return jfrnn.search(liquid.x, CUTOFF, skin=skin, box=liquid.box, slack=1.25, reverse=reverse)


WAYS = {
    "pair_sum": _Way(lambda liquid, _: liquid.box, _by_search, lambda box, _: box, reads_skin=False),
    "pair_sum, list": _Way(functools.partial(_search, reverse=False), _by_list, lambda nbrs, x: nbrs.update(x)),
    "distances, grad": _Way(functools.partial(_search, reverse=True), _by_distances, lambda nbrs, x: nbrs.update(x)),
}
WIDE = "pair_sum, list, float64"
WAYS[WIDE] = WAYS["pair_sum, list"]


def _run(way: _Way, liquid: Liquid, skin: float, steps: int, repeats: int) -> _Run:
    """Let velocities and positions take turns, and return the median time of a scan.

    The scan keeps velocities at half steps (leapfrog, Verlet 1967, doi:10.1103/PhysRev.159.98), and so no force.
    """

    def kick(x: Array, v: Array, kept: Any, time: float) -> Array:  # noqa: ANN401
        return v - time * jax.grad(lambda x: jnp.sum(way.potential(x, kept)))(x)

    def step(state: tuple[Array, Array, Any], _: None) -> tuple[tuple[Array, Array, Any], None]:
        x, v, kept = state
        x = x + STEP * v
        kept = way.update(kept, x)
        return (x, kick(x, v, kept, STEP), kept), None

    @jax.jit
    def scan(x: Array, v: Array, kept: Any) -> tuple[Array, Array, Any]:  # noqa: ANN401
        state = x, kick(x, v, kept, STEP / 2), kept
        x, v, kept = jax.lax.scan(step, state, None, length=steps)[0]
        return x, kick(x, v, kept, -STEP / 2), kept

    kept = way.keep(liquid, skin)
    energy = jax.jit(lambda x, kept: way.potential(x, kept))
    jax.block_until_ready(scan(liquid.x, liquid.v, kept))
    (x, v, end), seconds = _measure.repeat(lambda: jax.block_until_ready(scan(liquid.x, liquid.v, kept)), repeats, 0.0, repeats)
    told = {}
    if way.reads_skin:
        end.check()
        told = {"neighbors": float(np.mean(end.count)), "rebuilds": int(end.rebuild_count), "backend": end.backend, "skin": skin}
    potential = [float(np.sum(np.asarray(energy(at, held), np.float64))) for at, held in ((liquid.x, kept), (x, end))]
    ran = Ran(_measure.summarize(seconds)["median_s"], (potential[0], potential[1]), (kinetic_of(liquid.v), kinetic_of(v)), told)
    return _Run(ran, liquid._replace(x=x, v=v), end)
