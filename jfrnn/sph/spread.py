"""A scene over many devices: the solver as it is, on rows that are spread, with sums that see the rows of other devices.

Everything but sums over neighbors works row by row, or takes the largest of all rows, which the compiler spreads itself. Rows that
hold no particle are particles that never enter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from jfrnn import distributed
from jfrnn.distributed import Halo, Particles
from jfrnn.sph import solver
from jfrnn.sph.particles import Model, State, active

OF_STATE = ("v", "a", "rho", "p", "w", "gone")  # what of a state is known of each particle, besides positions
_OF_MODEL = ("m", "wall", "enters", "guided")
_NEVER = np.inf


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spread:
    """What the solver takes for neighbors (see `edges.Edges`): each sum finds pairs anew, of halos that are made once for a stage.

    Attributes:
        particles: Whose rows these are.
        halo: Of the positions of the last update; None before the first.
        active: Which rows take part, shape [N], bool.
        backend: Of `pair_sum`. Static.
    """

    particles: Particles
    halo: Halo | None
    active: Array | None
    backend: Any = field(metadata={"static": True})

    @property
    def overflow(self) -> Array:
        """Whether pairs may be missing because room was, shape [], bool."""
        return self.particles.overflow

    @property
    def rebuild_count(self) -> Array:
        """0: no list is kept, shape [], int32."""
        return jnp.zeros((), jnp.int32)

    def update(self, positions: Array, *, active: Array | None = None) -> "Spread":
        """Make the halo of these positions [m], shape [N, d]; bits, and what was required, are kept over all updates."""
        particles = self._at(positions, active)
        halo = distributed.halo(particles)
        required = self.particles.required.join(halo.required)
        particles = replace(self.particles, status=self.particles.status | halo.status, required=required)
        return replace(self, particles=particles, halo=halo, active=active)

    def sum(self, fn: Callable[[Array, Any, Any], Any], positions: Array, values: Any) -> Any:  # noqa: ANN401
        """Sum fn(r, values of i, values of j) over the neighbors of each row, leaves [N, ...]."""
        particles = self._at(positions, self.active)
        return distributed.pair_sum(fn, particles, particles.reach, values, halo=self.halo, backend=self.backend)

    def _at(self, positions: Array, active: Array | None) -> Particles:
        ids = self.particles.ids  # sums are 0 of rows that hold no particle, and so of one that takes no part
        return replace(self.particles, positions=positions, ids=ids if active is None else jnp.where(active, ids, -1))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Flow:
    """A model and its state over many devices; a pytree.

    Attributes:
        particles: Positions, and as values what of model and state is known of each particle.
        model: The rest of the model; its rows are None.
        time: [s], shape [].
        last: Step before this one [s], shape [].
        settle: After how many steps particles go to the shards in whose regions they are. Static.
    """

    particles: Particles
    model: Model
    time: Array
    last: Array
    settle: int = field(metadata={"static": True})


def spread(model: Model, s: State, mesh: Mesh, settle: int = 10, slack: float = 1.25, along: Sequence[int] | None = None) -> Flow:
    """Spread a model and its state, as `solver.begin` returns it or not.

    Args:
        model: What acts.
        s: The state, rows as in the model.
        mesh: As in `jfrnn.distributed.scatter`.
        settle: As in `Flow`: fewer steps send less in halos, more steps migrate less often. No pair depends on it.
        slack: Room for more particles, as in `scatter`.
        along: Which axis of space each axis of the mesh cuts, as in `scatter`; default: the longest ones. Devices get as many rows,
            though those of walls cost less than those of water: best is an axis all along which both are mixed alike.

    Raises:
        ValueError: The scene has a wall of triangles.
    """
    if s.solid is not None:
        raise ValueError("s must be a state without a wall of triangles, which sums over devices do not see: run it on one device.")
    if model.enters is None:
        never: Any = np.full(len(s.x), -_NEVER, s.x.dtype)
        model = replace(model, enters=never, guided=jnp.zeros((), s.x.dtype))
    of_model: Any = {name: getattr(model, name) for name in _OF_MODEL if np.ndim(getattr(model, name))}
    rows = {name: getattr(s, name) for name in OF_STATE} | of_model
    particles = distributed.scatter(s.x, model.cutoff, rows, mesh=mesh, box=model.box, along=along, slack=slack)
    return Flow(particles, replace(model, fluid_count=None, **dict.fromkeys(of_model)), s.time, s.last, settle)


def begin(flow: Flow) -> Flow:
    """Return what its integrator carries from step to step, as `solver.begin`."""

    def first(model: Model, s: State, nbrs: Any) -> tuple[State, Any]:  # noqa: ANN401
        nbrs = nbrs.update(s.x, active=active(model, s))
        return solver.begin(model, s, nbrs), nbrs

    return _run(flow, jax.jit(partial(_with_solver, first)))


def run(flow: Flow, steps: int) -> Flow:
    """Run steps; where room was missing, with more of it again, from where the run began."""
    return _run(flow, lambda flow: advance(flow, steps))


def _run(flow: Flow, chunk: Callable[[Flow], Flow]) -> Flow:
    while True:
        after = chunk(flow)
        if not bool(after.particles.overflow):
            return after
        flow = replace(flow, particles=flow.particles.grow(after.particles))


def state_of(flow: Flow) -> State:
    """Return the state as on one device, in every process all of it."""
    x, values = distributed.collect(flow.particles)
    rows: dict[str, Any] = {name: None if values[name] is None else jnp.asarray(values[name]) for name in OF_STATE}
    return State(jnp.asarray(x), time=jnp.asarray(np.asarray(flow.time)), last=jnp.asarray(np.asarray(flow.last)), **rows)


@jax.jit
def advance(flow: Flow, steps: Array | int) -> Flow:
    """Run steps, data; where `particles.overflow` is set afterwards, pairs may have been missing: `run` sees to that."""

    def step(k: Array, flow: Flow) -> Flow:
        particles = jax.lax.cond(k % flow.settle == 0, distributed.migrate, lambda same: same, flow.particles)
        return _with_solver(solver.step, replace(flow, particles=particles))

    return jax.lax.fori_loop(0, steps, step, flow)


def _with_solver(advance: Callable[[Model, State, Any], tuple[State, Any]], flow: Flow) -> Flow:
    """Advance by what updates the neighbors that it gets, at the positions whose pairs it wants, before it sums."""
    particles, values = flow.particles, flow.particles.values
    of_model = {name: values[name] for name in _OF_MODEL if name in values}
    of_model["enters"] = jnp.where(particles.active, values["enters"], _NEVER)
    model = replace(flow.model, **of_model)
    s = State(particles.positions, time=flow.time, last=flow.last, **{name: values[name] for name in OF_STATE})
    s, nbrs = advance(model, s, Spread(particles, None, None, flow.model.backend))
    rows = {name: getattr(s, name) for name in OF_STATE}
    return replace(flow, particles=nbrs.particles.replace(s.x, values | rows), time=s.time, last=s.last)


def save(flow: Flow, folder: Path, step: int) -> None:
    """Write the shards of this process as STEP-SHARD.npz, each complete or not at all; all processes call it."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = {"x": flow.particles.positions, "ids": flow.particles.ids}
    rows |= {name: flow.particles.values[name] for name in OF_STATE if flow.particles.values[name] is not None}
    shards, size = flow.particles.mesh.devices.size, flow.particles.sizes.particles
    same = {"shards": shards, "total": flow.particles.total, "time": np.asarray(flow.time), "last": np.asarray(flow.last)}
    parts: dict[int, dict[str, np.ndarray]] = {}
    for name, array in rows.items():
        for shard in array.addressable_shards:
            parts.setdefault((shard.index[0].start or 0) // size, {})[name] = np.asarray(shard.data)
    for number, part in parts.items():
        there = part["ids"] >= 0
        whole, unfinished = folder / f"{step:09d}-{number:05d}.npz", folder / f"part-{number:05d}.npz"
        np.savez(unfinished, **same, **{name: value[there] for name, value in part.items()})  # pyright: ignore[reportArgumentType]
        unfinished.replace(whole)


def load(folder: Path) -> tuple[State, int] | None:
    """Return the last state of which all shards were saved, as on one device, and its step; None where there is none."""
    for step in sorted({path.stem.split("-")[0] for path in folder.glob("*-*.npz") if path.stem[0].isdigit()}, reverse=True):
        parts = [dict(np.load(path)) for path in sorted(folder.glob(f"{step}-*.npz"))]
        if len(parts) != int(parts[0]["shards"]):
            continue
        rows = {name: np.concatenate([part[name] for part in parts]) for name in ("x", "ids", *OF_STATE) if name in parts[0]}
        ids = rows.pop("ids")
        if len(ids) != int(parts[0]["total"]):
            continue
        order = np.argsort(ids)
        arrays = {name: value[order] for name, value in rows.items()} | {name: parts[0][name] for name in ("time", "last")}
        return State(**{name: jnp.asarray(value) for name, value in arrays.items()}), int(step)  # pyright: ignore[reportArgumentType]
    return None
