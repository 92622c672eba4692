"""What each option of a search costs: in turns with what it is compared with, and with what SciPy and `wp.HashGrid` take."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jfrnn
from experiments import _machine, _measure, methods
from experiments._commands import Engine, Points, Rounds
from experiments._library import Name, round_capacity
from experiments.bench import table
from experiments.bench.options_scenes import FIRST, Asked, Option, beside, density, options
from experiments.methods import scipy_kdtree_nolist

Calls = dict[str, Callable[[], Any]]
WHATS = ("list", "count", "sum")
OF_LISTS = ("skin", "reverse", "flat")  # options of lists alone
PEERS = {"scipy": "scipy-kdtree-nolist", "hashgrid": "hashgrid-plain"}
COLUMNS = (
    *("platform", "backend", "n", "option", "beside", "spread", "entries", "beside_entries", "capacity", "rounds"),
    *(f"{what}_s" for what in WHATS),
    *(f"beside_{what}_s" for what in WHATS),
    *(f"{what}_ratio" for what in WHATS),
    *(f"{peer}_{what}" for peer in PEERS for what in ("s", "behind", "differs", "rounds")),
    *("status", "reason", "others_cores", "cores", "device", "jax", "warp", "scipy", "commit", "dirty"),
)
SHOWN = (
    *("option", "beside", "entries", "beside_entries", "capacity"),
    *(f"{what}_{kind}" for what in WHATS for kind in ("s", "ratio")),
    *(f"{peer}_{what}" for peer in PEERS for what in ("s", "behind", "differs")),
    "reason",
)
PEER_SECONDS = 3.0  # that a peer may take in one row, about; two rounds it gets at least
MOST_CANDIDATES = {"cpu": 5e8, "gpu": 1e11}  # that `wp.HashGrid` is let look at in one call: about a second


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "options",
    points: Points = 100_000,
    rounds: Rounds = 15,
    backend: Engine = "warp",
) -> str:
    """Time each option of a search in turns with what it is compared with, which its row names.

    Counts of SciPy (on a CPU, with all cores) and of Warp's HashGrid stand beside ours where they answer the same question; their
    trees and grids are built in each call. Rows say for how many pairs their counts differ from ours. Memory that one call frees
    serves the next one.
    """
    jax.config.update("jax_enable_x64", True)
    _measure.keep_freed_memory()
    parts = [(option.name, functools.partial(_rows, option, points, rounds, backend)) for option in options()]
    given = [points, rounds, [name for name in PEERS.values() if methods.lacks(name) is None]]
    return table.text(table.measure(out, f"{jax.default_backend()}_{backend}", parts, given, COLUMNS), SHOWN)


def _rows(option: Option, n: int, rounds: int, backend: Name) -> Iterator[table.Line]:
    """Yield the row of an option; medians of rounds count."""
    row: table.Line = {"backend": backend, "n": n, "option": option.name, "beside": option.beside, "status": "ok"}
    row |= {"cores": _machine.machine()["cores"], "scipy": _machine.versions()["scipy"]}
    table.ask(row, None, lambda: _measure_option(row, option, n, rounds, backend))
    yield row


def _measure_option(row: table.Line, option: Option, n: int, rounds: int, backend: Name) -> None:
    asked = option.make(n)
    calls, about = _compile(asked, backend)
    row |= about | {"n": len(asked.x), "spread": asked.spread, "rounds": rounds}
    others, its = _plain_calls(n, backend) if option.beside == FIRST else _compile(beside(option, asked, row["entries"]), backend)
    row["beside_entries"] = its["entries"]
    both = {f"{what}_s": calls[what] for what in calls} | {f"beside_{what}_s": others[what] for what in calls}
    jax.block_until_ready([call() for call in both.values()])
    seconds, row["others_cores"] = _measure.time_in_turns(both, rounds, _measure.burst())
    row |= {name: float(np.median(found)) for name, found in seconds.items()}
    row |= {f"{what}_ratio": round(row[f"{what}_s"] / row[f"beside_{what}_s"], 2) for what in calls}
    if asked.peers:
        _ask_peers(row, asked, calls["count"], rounds)


@functools.cache
def _plain_calls(n: int, backend: Name) -> tuple[Calls, table.Line]:
    return _compile(options()[0].make(n), backend)


def _compile(asked: Asked, backend: Name) -> tuple[Calls, table.Line]:
    """Return what lists, counts and sums a density, and entries and capacity.

    Of half lists, and of options of lists alone, there is no sum, and of lists with reverse slots and flat ones no count.
    """
    given = {name: value for name, value in asked.more.items() if name not in OF_LISTS} | {"cutoff": asked.cutoff}
    skin, reverse, flat = (asked.more.get(name, 0) for name in OF_LISTS)
    # Arrays are operands, no constants, but for exclusions: those that are known are sorted once, and not in each call.
    data: dict[str, Any] = {name: value for name, value in given.items() if hasattr(value, "shape") and name != "exclude"}
    more = {name: value for name, value in given.items() if name not in data}
    x, masses = asked.x, jnp.linspace(1, 2, len(asked.x), dtype=asked.x.dtype)

    def sum_pairs(x: jax.Array, masses: jax.Array, data: dict[str, Any]) -> jax.Array:
        if asked.alone is not None:
            return asked.alone(x, masses, backend)
        of_queries = {"query_values": masses} if "queries" in data else {}
        return jfrnn.pair_sum(density, x, values=masses, backend=backend, **of_queries, **more, **data)

    summed = jax.jit(sum_pairs)
    count = jax.jit(lambda x, data: jfrnn.count(x, backend=backend, **more, **data))
    found = np.asarray(count(x, data))
    about: table.Line = {"entries": int(found.sum(dtype=np.int64))}
    if asked.alone is not None:
        return {"sum": lambda: summed(x, masses, data)}, about
    longest = jfrnn.count(x, backend=backend, **given | {"cutoff": asked.cutoff + skin}) if skin else found
    about["capacity"] = capacity = round_capacity(int(longest.max()))

    def list_pairs(x: jax.Array, data: dict[str, Any]) -> tuple[Any, ...]:
        if flat:
            edges = jfrnn.search_edges(x, total=about["entries"], backend=backend, **more, **data)
            return edges.senders, edges.receivers
        nbrs = jfrnn.search(x, skin=skin, reverse=bool(reverse), capacity=capacity, backend=backend, **more, **data)
        return nbrs.idx, nbrs.count, nbrs.reverse

    search = jax.jit(list_pairs)
    calls: Calls = {"list": lambda: search(x, data)}
    if not (reverse or flat):
        calls["count"] = lambda: count(x, data)
    if not {"half", *OF_LISTS} & set(asked.more):
        calls["sum"] = lambda: summed(x, masses, data)
    return calls, about


# --- SciPy and wp.HashGrid ----------------------------------------------------------------------------------------------------


def _ask_peers(row: table.Line, asked: Asked, ours: Callable[[], Any], rounds: int) -> None:
    """Let a row say what each peer takes for counts, how many times ours that is, and for how many pairs it differs."""
    x = np.asarray(asked.x)
    cutoffs = np.broadcast_to(np.float32(asked.cutoff), len(x))
    makers: dict[str, Callable[[np.ndarray, np.ndarray], tuple[Callable[[], Any], Callable[[Any], np.ndarray]]]]
    makers = {"scipy": _scipy, "hashgrid": _hashgrid} if jax.default_backend() == "cpu" else {"hashgrid": _hashgrid}
    for peer, make in makers.items():
        told: table.Line = {}
        made = table.ask(told, PEERS[peer], functools.partial(make, x, cutoffs))
        if made is None:
            row["reason"] = "; ".join(filter(None, [row.get("reason"), f"{peer}: {told['reason']}"]))
            continue
        theirs, read = made
        found = read(theirs())  # compiles, too
        row[f"{peer}_differs"] = int(np.abs(found.astype(np.int64) - np.asarray(ours())).sum())
        begin = perf_counter()
        jax.block_until_ready(theirs())
        once = perf_counter() - begin
        burst = _measure.burst() if once < 0.02 else 1
        turns = int(np.clip(PEER_SECONDS / (once * (burst + 1)), 2, rounds))
        seconds = _measure.time_in_turns({"ours": ours, "theirs": theirs}, turns, burst)[0]
        mine, its = (float(np.median(seconds[who])) for who in ("ours", "theirs"))
        row |= {f"{peer}_s": its, f"{peer}_behind": round(its / mine, 2), f"{peer}_rounds": turns}


def _scipy(x: np.ndarray, cutoffs: np.ndarray) -> tuple[Callable[[], Any], Callable[[Any], np.ndarray]]:
    strict = np.nextafter(cutoffs.astype(np.float64), 0)  # as it takes <=
    return scipy_kdtree_nolist.prepare(x, strict, workers=_machine.machine()["cores"]), lambda found: found - 1


def _hashgrid(x: np.ndarray, cutoffs: np.ndarray) -> tuple[Callable[[], Any], Callable[[Any], np.ndarray]]:
    from experiments.methods import hashgrid_plain

    looked_at = hashgrid_plain.candidates(x, float(cutoffs.max()))
    if looked_at > MOST_CANDIDATES[jax.default_backend()]:
        raise OverflowError(f"its queries look at up to {looked_at:.1e} particles, which takes too long to time")
    return hashgrid_plain.prepare_counts(x, cutoffs), lambda found: found.array.numpy()
