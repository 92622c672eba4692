"""What batches of crystals cost, each in a cell of its own, beside nvalchemi's batches and vesin, which is called for each."""

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
from experiments import _measure
from experiments._library import round_capacity
from experiments.bench import table

SIZES = ("1x32", "16x64", "64x100", "256x100", "64x1000")
CUTOFF, DENSITY = 5.0, 0.1  # Å, atoms/Å³
COLUMNS = (
    *("platform", "systems", "atoms", "who", "what", "pairs", "images", "waited_ms", "repeats", "wrong", "status", "reason"),
    *("others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("systems", "atoms", "who", "what", "pairs", "images", "waited_ms", "wrong", "reason")


class _Scene(NamedTuple):
    """Systems of so many atoms at random in skewed cells of their own, and the neighbors that each atom has."""

    x: np.ndarray
    batch: np.ndarray
    cells: np.ndarray
    counts: np.ndarray
    images: int | tuple[int, ...] | None

    @property
    def capacity(self) -> int:
        """Slots of a row."""
        return round_capacity(int(self.counts.max()))


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "crystals",
    sizes: Annotated[list[str] | None, typer.Option(help="Systems x atoms of each, as 256x100; may be said several times.")] = None,
    repeats: Annotated[int, typer.Option(min=2, max=100_000, help="Waited calls of each.")] = 100,
) -> str:
    """Time batches of crystals in cells of their own: jfrnn, nvalchemi and (on the CPU) vesin, where they are installed.

    Atoms are random, float32, 0.1 of them per cubic unit, in cells skewed by up to a tenth, within a cutoff of 5. Calls are
    compiled, with positions and cells as arguments, and waited for; vesin is called once for each system. Answers are compared with
    those of k-d trees in float64; of ways whose answers are wrong, no time is taken.
    """
    asked = [_read_size(size) for size in sizes or SIZES]
    parts = [(f"{systems} x {atoms}", functools.partial(_rows, systems, atoms, repeats)) for systems, atoms in asked]
    return table.text(table.measure(out, jax.default_backend(), parts, [repeats, table.installed(_ways())], COLUMNS), SHOWN)


def _read_size(size: str) -> tuple[int, int]:
    systems, _, atoms = size.partition("x")
    if not (systems.isdecimal() and atoms.isdecimal() and 0 < int(systems) * int(atoms) < 10**8):
        raise typer.BadParameter(f"{size}: say systems x atoms of each, as 256x100", param_hint="--sizes")
    return int(systems), int(atoms)


def _rows(systems: int, atoms: int, repeats: int) -> Iterator[table.Line]:
    """Yield a row for each way; those whose answers are right are timed in turns."""
    scene, calls, rows = _make_scene(systems, atoms), dict[str, Callable[[], Any]](), dict[str, table.Line]()
    told = {"systems": systems, "atoms": atoms, "pairs": int(scene.counts.sum()), "images": str(scene.images or "nearest")}
    for way in _ways():
        name = f"{way.who} {way.what}"
        rows[name] = dict(told)
        ready = table.judge(rows[name], way, scene, lambda call: call)
        if ready is not None:
            calls[name] = ready.call
    seconds, others = _measure.time_in_turns(calls, repeats)
    for name, each in seconds.items():
        rows[name] |= {"waited_ms": 1e3 * float(np.median(each)), "repeats": repeats, "others_cores": others}
    yield from rows.values()


def _make_scene(systems: int, atoms: int) -> _Scene:
    random = np.random.default_rng(atoms)
    edge = (atoms / DENSITY) ** (1 / 3)
    cells = (edge * (np.eye(3) + 0.1 * random.uniform(-1, 1, (systems, 3, 3)))).astype(np.float32)
    x = np.einsum("snd,sdk->snk", random.random((systems, atoms, 3)), cells).astype(np.float32)
    counts = np.concatenate([_count(*each) for each in zip(x.astype(float), cells.astype(float), strict=True)])
    some, of_first = jnp.asarray(x[0]), jnp.zeros(atoms, jnp.int32)
    kind = jfrnn.search(some, CUTOFF, box=jfrnn.Box(cells), batch=of_first, capacity=1).box_kind
    images = None if kind is None or kind.nearest else kind.reach
    return _Scene(x.reshape(-1, 3), np.repeat(np.arange(systems, dtype=np.int32), atoms), cells, counts, images)


def _count(x: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Count the neighbors of the atoms of a system by k-d trees of all images within reach."""
    from scipy.spatial import KDTree

    reach = np.ceil(CUTOFF * np.linalg.norm(np.linalg.inv(cell), axis=0) + 1).astype(int)
    shifts = np.stack(np.meshgrid(*(np.arange(-k, k + 1) for k in reach), indexing="ij"), -1).reshape(-1, 3) @ cell
    everywhere = KDTree((x[None] + shifts[:, None]).reshape(-1, 3))
    return np.asarray(everywhere.query_ball_point(x, CUTOFF, return_length=True)) - 1


# --- who does what ------------------------------------------------------------------------------------------------------------


def _ways() -> Iterator[table.Way]:
    yield table.Way("jfrnn", "counts", functools.partial(_ours, lists=False), lambda scene, found: _wrong(scene, found[0]))
    yield table.Way("jfrnn", "list", functools.partial(_ours, lists=True), lambda scene, found: _wrong(scene, found[0]))
    of_rows = lambda scene, found: _wrong(scene, found[1])  # noqa: E731
    yield table.Way("nvalchemi", "list", _nvalchemi, of_rows, "nvalchemi", "nvalchemi-toolkit-ops")
    if jax.default_backend() == "cpu":
        yield table.Way("vesin", "list", _vesin, _wrong_of_pairs, "vesin", "vesin")


def _wrong(scene: _Scene, counts: Any) -> int:  # noqa: ANN401
    return int((np.asarray(counts) != scene.counts).sum())


def _ours(scene: _Scene, lists: bool) -> Callable[[], Any]:
    def find(x: Array, batch: Array, cells: Array) -> list[Array]:
        box = jfrnn.Box(cells, images=scene.images)
        if not lists:
            return [jfrnn.count(x, CUTOFF, box=box, batch=batch)]
        nbrs = jfrnn.search(x, CUTOFF, box=box, batch=batch, capacity=scene.capacity)
        return [nbrs.count, nbrs.idx, *([] if nbrs.images is None else [nbrs.images.codes])]

    compiled, given = jax.jit(find), [jnp.asarray(part) for part in (scene.x, scene.batch, scene.cells)]
    return lambda: compiled(*given)


def _nvalchemi(scene: _Scene) -> Callable[[], Any]:
    from nvalchemiops.jax.neighbors.batch_naive import batch_naive_neighbor_list  # pyright: ignore
    from nvalchemiops.jax.neighbors.neighbor_utils import compute_naive_num_shifts  # pyright: ignore

    systems, atoms = len(scene.cells), len(scene.x) // len(scene.cells)
    periodic, starts = jnp.ones((systems, 3), bool), jnp.arange(systems + 1, dtype=jnp.int32) * atoms
    ranges, shifts, most = compute_naive_num_shifts(jnp.asarray(scene.cells), CUTOFF, periodic)
    known = {"shift_range_per_dimension": ranges, "num_shifts_per_system": shifts, "max_shifts_per_system": int(most)}
    known |= {"max_atoms_per_system": atoms, "max_neighbors": scene.capacity, "batch_ptr": starts, "pbc": periodic}
    compiled = jax.jit(lambda x, batch, cells: batch_naive_neighbor_list(x, CUTOFF, batch_idx=batch, cell=cells, **known)[:3])
    given = [jnp.asarray(part) for part in (scene.x, scene.batch, scene.cells)]
    return lambda: compiled(*given)


def _vesin(scene: _Scene) -> Callable[[], Any]:
    from vesin import NeighborList  # pyright: ignore

    find, systems = NeighborList(cutoff=CUTOFF, full_list=True), len(scene.cells)
    each = list(zip(scene.x.astype(float).reshape(systems, -1, 3), scene.cells.astype(float), strict=True))
    return lambda: [find.compute(points=x, box=cell, periodic=True, quantities="ijS") for x, cell in each]


def _wrong_of_pairs(scene: _Scene, found: list[Any]) -> int:
    atoms = len(scene.x) // len(scene.cells)
    return _wrong(scene, np.concatenate([np.bincount(i, minlength=atoms) for i, *_ in found]))
