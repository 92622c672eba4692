"""Where a step's time goes: its stages as programs of their own, and what the whole takes besides."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments import _measure
from jfrnn.sph import forces, solver
from jfrnn.sph.model import Model, State
from jfrnn.sph.pairs import Neighbors

STAGES = ("search", "density", "walls", "forces", "integration")
_SUMS = ("density", "walls", "forces")
_SECONDS = 5.0  # that runs of all stages take at least, up to 50 of each
_BURST = 5  # calls that are not waited for one by one, on a device


def part_times(model: Model, s: State, way: str, skin: float, steps: int, rounds: int) -> tuple[dict[str, float], float | None]:
    """Time the stages of a step of the integrator "symplectic" that carries density.

    Args:
        model: What acts.
        s: A state.
        way: "pair_sum" or "list".
        skin: Of the list [m].
        steps: Of a run, over which the list's being made anew is shared out.
        rounds: Fewest timed runs of each stage, in turns; medians count.

    Returns:
        Seconds by stage, see `STAGES`, and how many cores others kept busy. "search": to find pairs, or to update the list; of
        sums that search, what counting their pairs takes, which is not counted again in the other stages. "density": the rates of
        densities. "walls": the equation of state, and what walls show to the fluid. "forces": accelerations. "integration": what
        the whole step takes longer than all of these; less than 0 where it shares between them.
    """
    nbrs = None if way == "pair_sum" else solver.list_neighbors(model, s, skin)
    calls = _count_calls(model, s) if nbrs is None else _updates(s, nbrs, skin)
    finding = tuple(calls)
    calls |= _sums(model, s, nbrs)
    _, after = jax.block_until_ready(solver.advance(model, s, nbrs, steps))
    calls["whole"] = lambda: solver.advance(model, s, nbrs, 1)[0].x
    for call in calls.values():
        jax.block_until_ready(call())
    _, once = _measure.repeat(lambda: jax.block_until_ready([call() for call in calls.values()]), 1, 0.0, 1)
    rounds = max(rounds, min(round(_SECONDS / once[0]), 50))
    seconds, others = _measure.time_in_turns(calls, rounds, burst=1 if jax.default_backend() == "cpu" else _BURST)
    median = {name: float(np.median(values)) for name, values in seconds.items()}
    parts = {name: median[name] for name in _SUMS}
    if nbrs is None or after is None:
        found = {"density": median[finding[0]], "walls": median[finding[-1]], "forces": median[finding[0]]}
        parts |= {name: max(parts[name] - found[name], 0.0) for name in _SUMS}
        parts["search"] = sum(found.values())
        parts["integration"] = median["whole"] - sum(parts.values())
    else:
        parts["integration"] = median["whole"] - median["keep"] - sum(parts.values())
        share = int(after.rebuild_count) / steps
        parts["search"] = median["keep"] + share * max(median["anew"] - median["keep"], 0.0)
    return {name: parts[name] for name in STAGES}, others


def _sums(model: Model, s: State, nbrs: Neighbors) -> dict[str, Callable[[], Any]]:
    """Return a call for each stage that sums over pairs."""
    rates = jax.jit(lambda model, s, nbrs: forces.carried_rate(model, s, s.rho, None, nbrs))
    fields = jax.jit(lambda model, s, nbrs: forces.fields(model, s, s.rho, None, nbrs))
    accelerations = jax.jit(forces.accelerations)
    seen = fields(model, s, nbrs)
    return {
        "density": lambda: rates(model, s, nbrs),
        "walls": lambda: fields(model, s, nbrs),
        "forces": lambda: accelerations(model, s, seen, nbrs),
    }


def _count_calls(model: Model, s: State) -> dict[str, Callable[[], Any]]:
    """Return calls that count the pairs of a sum for the fluid, and for walls over the fluid."""
    k, cutoff = model.fluid_count, model.cutoff
    if k is None:
        count = jax.jit(lambda x: jfrnn.count(x, cutoff, box=model.box))
        return {"all": lambda: count(s.x)}
    fluid = jax.jit(lambda x: jfrnn.count(x, cutoff, queries=x[:k], box=model.box))
    wall = jax.jit(lambda x: jfrnn.count(x[:k], cutoff, queries=x[k:], box=model.box))
    return {"fluid": lambda: fluid(s.x), "wall": lambda: wall(s.x)}


def _updates(s: State, nbrs: jfrnn.NeighborList, skin: float) -> dict[str, Callable[[], Any]]:
    """Return calls of an update that keeps the list, and of one that makes it anew."""
    update = jax.jit(lambda x, nbrs: nbrs.update(x))
    there, moved = s.x, s.x + jnp.asarray(skin, s.x.dtype)
    return {"keep": lambda: update(there, nbrs), "anew": lambda: update(moved, nbrs)}
