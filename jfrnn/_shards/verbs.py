"""The public functions of `jfrnn.distributed`: `search`, `count` and `pair_sum`."""

import functools
import math
import os
from collections.abc import Callable
from typing import Any, Literal

import jax
from jax import Array
from jax.core import Tracer

from jfrnn._engine import parse_backend
from jfrnn._geometry import ROWS_ARE_WHOLE, Status, check_capacity, check_flag, check_slack, check_values, known_status, mark_rows
from jfrnn._search import NeighborList
from jfrnn._shards.calls import (
    BACKENDS,
    Asked,
    check_asked,
    check_halo,
    count_capacity,
    counts,
    gather_seen,
    over_shards,
    take_halo,
)
from jfrnn._shards.halo import Halo, exchange
from jfrnn._shards.particles import Particles, of_shards
from jfrnn._shards.sharded_list import Neighbors, list_on_shards
from jfrnn._sums import pair_sum as pair_sum_on_one
from jfrnn._tracing import Flag, Number, Real, Size, Tree


def search(  # noqa: D417 (five arguments share a line)
    particles: Particles,
    cutoff: Number,
    *,
    skin: Real = 0.0,
    include_self: Flag = False,
    closed: Flag = False,
    capacity: Size | None = None,
    slack: Real = 1.0,
    backend: Literal["auto", "warp", "jax", "brute"] = "auto",
) -> Neighbors:
    """Find every pair of particles closer than a cutoff, on any devices: exactly the pairs of `jfrnn.search` on one device.

    Args:
        particles: Distributed particles.
        cutoff: Interaction radius [length], a static number > 0; with the skin at most the reach of the particles.
        skin, include_self, closed, capacity, slack: As in `jfrnn.search`.
        backend: "warp", "jax", "brute" or "auto", as in `jfrnn.search`.

    Returns:
        `Neighbors`.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or `capacity` is missing under jit.

    Cost: on each device that of `jfrnn.search` for its own and halo particles. Communication: positions of halos. Differentiable:
    no. Jit: yes, with capacity. vmap: no.
    """
    asked, slack = check_asked(particles, cutoff, skin, include_self, closed, backend), check_slack(slack)
    if capacity is None:
        if isinstance(particles.ids, Tracer):
            raise ValueError(
                "capacity must be given where particles are traced, because it is a shape: pass that of an earlier search."
            )
        capacity = count_capacity(particles, asked, slack)
    return list_on_shards(particles, asked, check_capacity(capacity))


def count(  # noqa: D417 (four arguments share a line)
    particles: Particles,
    cutoff: Number,
    *,
    include_self: Flag = False,
    closed: Flag = False,
    backend: Literal["auto", "warp", "jax", "brute"] = "auto",
    halo: Halo | None = None,
) -> Array:
    """Count the neighbors that `search` would list.

    Args:
        particles: Distributed particles.
        cutoff, include_self, closed, backend: As in `search`.
        halo: A halo at these positions; by default one is made.

    Returns:
        Neighbors of each particle, shape [N], int32, 0 in unused rows. If a halo overflowed, all are the smallest int32; `migrate`
        and `halo` report the size needed.

    Raises:
        TypeError, ValueError: as `search`.

    Differentiable: no. Jit: yes. vmap: no.
    """
    if halo is not None:
        check_halo(halo, particles)
    return counts(particles, halo, check_asked(particles, cutoff, 0.0, include_self, closed, backend))


def pair_sum(  # noqa: D417 (three arguments share a line, and two another)
    fn: Callable[[Array, Any, Any], Any],
    particles: Particles,
    cutoff: Number | None,
    values: Tree = None,
    *,
    reduce: Literal["sum", "max", "min"] = "sum",
    include_self: Flag = False,
    closed: Flag = False,
    compensated: Flag = False,
    backend: Literal["auto", "warp", "jax", "brute"] = "auto",
    neighbors: Neighbors | None = None,
    halo: Halo | None = None,
) -> Tree:
    """Sum a function of pairs over the neighbors of each particle, like `jfrnn.pair_sum`, with neighbors on any device.

    Args:
        fn: As in `jfrnn.pair_sum`.
        particles: Distributed particles; derivatives in `particles.positions` are those in the positions.
        cutoff: As in `search`; with `neighbors` None.
        values: A pytree of arrays of shape [N, ...], rows and sharding as in `particles.positions`. Default: None.
        reduce, compensated: As in `jfrnn.pair_sum`.
        include_self, closed, backend: As in `search`.
        neighbors: A list of these particles, whose pairs and halos are used.
        halo: A halo at these positions; default: that of the list, or a new one.

    Returns:
        A pytree as fn returns it, leaves [N, ...], 0 in unused rows. If a halo overflowed, or list or halo belong to other rows,
        all floats are NaN and all integers the smallest of their dtype (unsigned: the largest); `migrate` reports the size needed.
        So are rows of particles that are not finite, and those of shards on which rows of the list overflowed.

    Raises:
        RuntimeError: outside jit, `neighbors` overflowed, as its `check` says.
        TypeError, ValueError, NotImplementedError: as `jfrnn.pair_sum` and `search`.

    Order of summation: as on each device; sums differ from those on one device by rounding. Communication: positions of halos and
    their values; in derivatives as much again, in the other direction. Differentiable: to every order in positions, values and
    whatever fn closes over. Jit: yes; outside of it, define fn once. vmap: no.
    """
    if not callable(fn):
        raise TypeError(f"fn must be a function of (r, i, j), got {type(fn).__name__}.")
    if neighbors is not None:
        if not isinstance(neighbors, Neighbors):
            raise TypeError(f"neighbors must be what jfrnn.distributed.search returns, got {type(neighbors).__name__}.")
        neighbors._check_fits(particles)
        if cutoff is not None or include_self or closed or parse_backend(backend, BACKENDS) is not None:
            raise ValueError("cutoff, include_self, closed and backend were said when the list was made: leave them out.")
        if (known_status(neighbors.status) or Status.OK) & ~ROWS_ARE_WHOLE:
            neighbors.check()
        asked, halo = neighbors.asked, neighbors.halo if halo is None else halo
    elif cutoff is None:
        raise ValueError("cutoff must be given: only a list (neighbors=) has its own.")
    else:
        asked = check_asked(particles, cutoff, 0.0, include_self, closed, backend)
    check_values("values", values, len(particles.ids), "row of particles")
    if halo is not None:
        check_halo(halo, particles)
    local = None if neighbors is None else neighbors.local
    return _sums(particles, halo, local, values, fn, asked, reduce, check_flag("compensated", compensated))


@functools.partial(jax.jit, static_argnames=("fn", "asked", "reduce", "compensated"))
def _sums(
    particles: Particles,
    halo: Halo | None,
    local: NeighborList | None,
    values: Tree,
    fn: Callable[[Array, Any, Any], Any],
    asked: Asked,
    reduce: str,
    compensated: bool,
) -> Tree:
    def sum_shard(particles: Particles, halo: Halo | None, local: NeighborList | None, values: Tree) -> Tree:
        halo, good = take_halo(particles, halo)
        x, active = gather_seen(particles, halo)
        theirs = jax.tree.map(lambda leaf: exchange(leaf, halo, particles), values)
        options: dict[str, Any] = {"reduce": reduce, "compensated": compensated}
        if local is None:
            sums = pair_sum_on_one(fn, x, asked.cutoff, theirs, **options, **asked.options(particles, active))
        else:
            sums = pair_sum_on_one(fn, x, None, theirs, neighbors=jax.tree.map(lambda leaf: leaf[0], local), **options)
        return jax.tree.map(lambda leaf: mark_rows(leaf[: particles.sizes.particles], good), sums)

    return over_shards(sum_shard, particles, of_shards(particles.mesh), particles, halo, local, values)


# --- how processes connect, and how soon they notice that one has died ------------------------------------------------


def connect(
    address: str | None = None, processes: int | None = None, process: int | None = None, *, patience: float = 20.0
) -> None:
    """Connect the processes of a run, before anything else asks JAX for a device; a single process need not call this.

    This calls `jax.distributed.initialize` with collectives for CPUs (gloo) and a shorter timeout: if a process dies, all others
    end with an error that says so, instead of waiting for it in a collective.

    Args:
        address: "host:port" of process 0. Default of this and the next two: from the cluster's environment (Slurm, Kubernetes ...).
        processes: Number of processes.
        process: Number of this process.
        patience: Seconds without a heartbeat after which a process counts as dead, at least 1. The others end within twice that
            time, on CPUs and if a connection breaks at once.

    Raises:
        ValueError: `patience` is not a number of seconds.
        RuntimeError: JAX has been asked for devices already, or the processes cannot connect.

    Source: JAX's coordination service, https://docs.jax.dev/en/latest/multi_process.html.
    """
    if not (isinstance(patience, int | float) and math.isfinite(patience) and patience >= 1):
        raise ValueError(f"patience must be a number of seconds, at least 1, got {patience!r}.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    os.environ.setdefault("NCCL_NVLS_ENABLE", "0")  # NVLink multicast, from which no collective here gains
    given: dict[str, Any] = {"coordinator_address": address, "num_processes": processes, "process_id": process}
    jax.distributed.initialize(**given, heartbeat_timeout_seconds=math.ceil(patience))
