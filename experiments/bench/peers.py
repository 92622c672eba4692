"""What other libraries answer on the hard cases: each in a process of its own, against exact arithmetic, within a time limit."""

import importlib
import multiprocessing
import resource
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from scipy.spatial import KDTree

from experiments import _machine
from experiments._commands import check_names, finite
from experiments.bench import table
from experiments.pages import cpu
from jfrnn.cases.catalog import CATALOG, Problem, problem

Pairs = tuple[np.ndarray, np.ndarray]
COLUMNS = ("row", "case", "peer", "version", "answer", "missing", "extra", "pairs", "reason", "commit", "dirty")
_DTYPE, _DIM = np.float32, 3
_MOST_MEMORY = 16 << 30  # of a process [B]


class Cannot(Exception):
    """A peer has no way to be asked this; the message says what it lacks."""


class _Peer(NamedTuple):
    """A library: the distribution that pip knows, and how it is asked for all ordered pairs, once for each image."""

    package: str
    ask: Callable[[Problem], Pairs]


# --- how each is asked ----------------------------------------------------------------------------------------------------


def _jfrnn(given: Problem) -> Pairs:
    import jax.numpy as jnp

    import jfrnn

    queries, batch = (None if part is None else jnp.asarray(part) for part in (given.queries, given.batch))
    box = None if given.matrix is None else jfrnn.Box(given.matrix, given.periodic)
    nbrs = jfrnn.search(jnp.asarray(given.positions), given.cutoff, queries=queries, box=box, batch=batch)
    if jfrnn.Status(int(nbrs.status)) not in (jfrnn.Status.OK, jfrnn.Status.NONFINITE):
        nbrs.check()
    i, k = np.nonzero(np.arange(nbrs.capacity) < np.asarray(nbrs.count)[:, None])
    return i, np.asarray(nbrs.idx)[i, k]


def _scipy(given: Problem) -> Pairs:
    points, size = given.positions.astype(np.float64), None
    if given.matrix is not None:
        if (given.matrix != np.diag(np.diag(given.matrix))).any():
            raise Cannot("skewed boxes")
        size = np.where(given.periodic, np.diag(given.matrix), 0).astype(np.float64)
        points = np.where(size > 0, np.mod(points, np.where(size > 0, size, 1)), points)  # it asks for points in the box
    found = KDTree(points, boxsize=size).query_pairs(_cutoff(given), output_type="ndarray")
    return np.concatenate([found[:, 0], found[:, 1]]), np.concatenate([found[:, 1], found[:, 0]])


def _vesin(given: Problem) -> Pairs:
    from vesin import NeighborList  # pyright: ignore[reportMissingImports]

    cell = np.zeros((3, 3)) if given.matrix is None else given.matrix.astype(np.float64)
    search = NeighborList(cutoff=_cutoff(given), full_list=True)
    found = search.compute(points=given.positions.astype(np.float64), box=cell, periodic=np.array(given.periodic), quantities="ij")
    return np.asarray(found[0]), np.asarray(found[1])


def _matscipy(given: Problem) -> Pairs:
    from matscipy.neighbours import neighbour_list  # pyright: ignore[reportMissingImports]

    points = given.positions.astype(np.float64)
    if given.matrix is None:
        i, j = neighbour_list("ij", positions=points, cutoff=_cutoff(given))
    else:
        cell, periodic = given.matrix.astype(np.float64), np.array(given.periodic)
        for k in np.flatnonzero(~periodic):  # it asks for a cell along open axes, too
            cell[k] = np.eye(3)[k] * (np.ptp(points[:, k]) + 3 * given.cutoff)
        i, j = neighbour_list("ij", positions=points, cell=cell, pbc=periodic, cutoff=_cutoff(given))
    return i, j


def _jax_md(given: Problem) -> Pairs:
    import jax.numpy as jnp

    partition, space = (importlib.import_module(f"jax_md.{name}") for name in ("partition", "space"))
    points = jnp.asarray(given.positions)
    if given.matrix is None:
        displacement, _ = space.free()
        low, extent = _bounds(given.positions)
        points, size = points - low, extent + given.cutoff  # its cells begin at 0
        make = partition.neighbor_list(displacement, size, given.cutoff, format=partition.NeighborListFormat.Sparse)
    elif not all(given.periodic):
        raise Cannot("boxes with open axes")
    else:
        displacement, _ = space.periodic_general(given.matrix.T, fractional_coordinates=True)
        points = points @ np.linalg.inv(given.matrix)
        kind = {"fractional_coordinates": True, "format": partition.NeighborListFormat.Sparse}
        make = partition.neighbor_list(displacement, given.matrix.T, given.cutoff, **kind)
    nbrs = make.allocate(points)
    i, j = np.asarray(nbrs.idx)
    there = i < len(points)
    i, j = i[there], j[there]
    if len(i) == 0:
        return i, j
    distance = np.linalg.norm(np.asarray(space.map_bond(displacement)(points[i], points[j])), axis=1)
    inside = distance < np.float32(given.cutoff)  # its list holds candidates: an energy looks at the distance
    return i[inside], j[inside]


def _nvalchemi(given: Problem) -> Pairs:
    import jax.numpy as jnp
    from nvalchemiops.jax.neighbors.cell_list import cell_list, estimate_cell_list_sizes  # pyright: ignore

    points = jnp.asarray(given.positions)
    cell, periodic = given.matrix, jnp.asarray(given.periodic)[None]
    if cell is None:
        low, extent = _bounds(given.positions)
        points, cell = points - low, np.diag(extent + np.float32(given.cutoff))  # its cells begin at 0
    cell = jnp.asarray(cell, jnp.float32)[None]
    cells, _, radius = estimate_cell_list_sizes(points, cell, given.cutoff, periodic)
    most = 64 * len(points) if given.matrix is not None else len(points)
    idx, count, *_ = cell_list(
        points, given.cutoff, cell, periodic, max_neighbors=most, max_total_cells=int(cells), neighbor_search_radius=radius
    )
    i, k = np.nonzero(np.arange(idx.shape[1]) < np.asarray(count)[:, None])
    return i, np.asarray(idx)[i, k]


PEERS = {
    "jfrnn": _Peer("jfrnn", _jfrnn),
    "scipy": _Peer("scipy", _scipy),
    "vesin": _Peer("vesin", _vesin),
    "matscipy": _Peer("matscipy", _matscipy),
    "jax-md": _Peer("jax-md", _jax_md),
    "nvalchemi": _Peer("nvalchemi-toolkit-ops", _nvalchemi),
}


def _bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest coordinates and the extents of the finite points, [dim] each; 0 where there is none."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        return np.zeros(points.shape[1], points.dtype), np.zeros(points.shape[1], points.dtype)
    return finite.min(axis=0), np.ptp(finite, axis=0)


def _cutoff(given: Problem) -> float:
    """Return the cutoff as float64, rounded as the positions are."""
    return float(_DTYPE(given.cutoff))


# --- right or wrong -------------------------------------------------------------------------------------------------------


def expected_pairs(case: str, closed: bool = False) -> Counter:
    """Return how often each ordered pair is one, once for each image, as the oracle of the tests decides it."""
    reference = importlib.import_module("tests.reference")
    given = problem(case, _DTYPE, _DIM)
    if given.matrix is None:
        found = reference.reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)
    else:
        options = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries, "closed": closed}
        found = ((i, j) for i, j, _ in reference.reference_images(given.positions, given.cutoff, **options))
    batch = given.batch
    return Counter((i, j) for i, j in found if batch is None or batch[i] == batch[j])


def _judge(found: Counter, case: str) -> dict[str, Any]:
    expected = expected_pairs(case)
    missing, extra = (expected - found).total(), (found - expected).total()
    right = (missing, extra) == (0, 0)
    answer = "right" if right else "right, closed" if found == expected_pairs(case, closed=True) else "wrong"
    return {"answer": answer, "missing": missing, "extra": extra, "pairs": expected.total()}


# --- one process per peer -------------------------------------------------------------------------------------------------


def command(
    names: Annotated[list[str] | None, typer.Argument(help="Of libraries; all that are known without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "peers",
    limit: Annotated[float, typer.Option(min=1, max=1e6, callback=finite, help="Time for one answer [s].")] = 60.0,
) -> str:
    """Ask other libraries for the hard cases, and print a table of their answers (pip install --group peers).

    The time for an answer includes compilation; beyond, the process is ended and the next case asked.
    """
    check_names("peer", names, PEERS)
    parts = [(name, partial(_rows, name, limit)) for name in names or PEERS]
    return cpu.answers(
        table.measure(out, "answers", parts, limit, COLUMNS).astype(object).fillna("").astype(str).to_dict("records")
    )


def _rows(name: str, limit_s: float) -> Iterator[dict[str, Any]]:
    """Yield a row for each case of the catalog."""
    package = PEERS[name].package
    version = _machine.versions([package])[package] or "not installed"
    cases = [(row.title, case) for row in CATALOG for case in row.cases]
    for (title, case), answer in zip(cases, _answers(name, [case for _, case in cases], limit_s), strict=True):
        yield {"row": title, "case": case, "peer": name, "version": version} | answer


def _answers(name: str, cases: list[str], limit_s: float) -> Iterator[dict[str, Any]]:
    """Yield what a peer answers on each case; a process that crashes or takes too long is replaced."""
    context = multiprocessing.get_context("spawn")

    def start() -> tuple[Connection, Any]:
        here, there = context.Pipe()
        worker = context.Process(target=_serve, args=(name, there), daemon=True)
        worker.start()
        there.close()
        here.recv()  # it has been imported
        return here, worker

    held = None
    for case in cases:
        pipe, worker = held = held or start()
        pipe.send(case)
        answered = pipe.poll(limit_s)
        try:
            answer = pipe.recv() if answered else {"answer": f"none in {limit_s:g} s"}
        except EOFError:
            worker.join()
            answer, answered = {"answer": f"crash ({worker.exitcode})"}, False
        if not answered:
            worker.kill()
            worker.join()
            held = None
        yield answer
    if held is not None:
        held[1].kill()


def _serve(name: str, pipe: Connection) -> None:
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
    pipe.send("ready")
    while True:
        case = pipe.recv()
        try:
            given = problem(case, _DTYPE, _DIM)
            if given.batch is not None and name != "jfrnn":
                answer = {"answer": "not asked", "status": "skipped"}
            else:
                i, j = PEERS[name].ask(given)
                answer = _judge(Counter(zip(i.tolist(), j.tolist(), strict=True)), case)
        except Cannot as error:
            answer = {"answer": f"no {error}"}
        except ImportError:
            answer = {"answer": "not installed", "status": "missing", "reason": f"{name} is not installed"}
        except Exception as error:  # what a peer raises is its answer
            reason = " ".join(str(error).split())[:200]
            answer = {"answer": "out of memory" if "out of memory" in reason.lower() else "error", "reason": reason}
        pipe.send(answer)
