"""Run a chunk of simulation steps; if its neighbor list overflowed, grow the list and run the chunk again."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry import Box, check_slack
from jfrnn._search.kept_search import Kept, KeptSearch
from jfrnn._tracing import Flags, Numbers, Points, Real, own_transfers

State = TypeVar("State")


def run_chunk(
    chunk: Callable[[State, Kept], tuple[State, Kept]],
    state: State,
    nbrs: Kept,
    positions: Callable[[State], Points],
    *,
    queries: Callable[[State], Points] | None = None,
    active: Callable[[State], Flags] | None = None,
    box: Callable[[State], Box] | None = None,
    cutoff: Callable[[State], Numbers | Points | tuple[Numbers, Numbers]] | None = None,
    slack: Real = 1.25,
) -> tuple[State, Kept]:
    """Run a jitted chunk of steps; if its list overflowed, grow the list and replay the chunk from the same state.

    A chunk whose list overflowed has missed pairs, so its results are discarded; it only reports how many slots, or edges of a flat
    list, were needed, and whether a box needed more images. Each replay has at least that much room, and more images, so the loop
    ends, or raises if no room helps. Each run synchronizes with the host once.

    Args:
        chunk: (state, nbrs) -> (state, nbrs), usually under `jax.jit`; it calls `nbrs.update` in every step, and must not donate
            its arguments, which are needed for a replay.
        state: A pytree.
        nbrs: The initial list.
        positions: state -> positions [length], shape [n, d], at which a larger list is made.
        queries: state -> queries, exactly if the list was made with queries.
        active: state -> mask, exactly if the list was made with `active`.
        box: state -> periodic box, if it changes; default: that of the initial list.
        cutoff: state -> cutoffs of the particles, if they change; default: those of the initial list.
        slack: Factor >= 1 on the slots that were needed, as in `NeighborList.grow`.

    Returns:
        The state and the list after a run without overflow, and with nothing for `check` to raise.

    Raises:
        TypeError: called inside jit, where a shape cannot change.
        TypeError, ValueError: as `NeighborList.update`.
        ValueError: the list reports what no capacity can fix, as `NeighborList.check`: non-finite positions, a degenerate box.

    >>> import jax, jax.numpy as jnp, jfrnn
    >>> @jax.jit
    ... def chunk(x, nbrs):
    ...     def step(_, carry):
    ...         x, nbrs = carry
    ...         x = 0.9 * x
    ...         return x, nbrs.update(x)
    ...     return jax.lax.fori_loop(0, 5, step, (x, nbrs))
    >>> x = jax.random.uniform(jax.random.key(0), (200, 3))
    >>> nbrs = jfrnn.search(x, 0.2, skin=0.05)
    >>> x, nbrs = jfrnn.run_chunk(chunk, x, nbrs, lambda x: x)
    >>> bool(nbrs.overflow)
    False
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((state, nbrs))):
        raise TypeError("run_chunk() changes the shape of the list and cannot run inside jax.jit: jit the chunk, not the loop.")
    given: dict[str, Any] = {"queries": queries, "active": active, "box": box, "cutoff": cutoff}
    _check(chunk, nbrs, {"positions": positions} | {name: of for name, of in given.items() if of is not None})
    slack = check_slack(slack)
    given = {name: of(state) for name, of in given.items() if of is not None}
    given = {"box": nbrs.box, "cutoff": _cutoffs_of(nbrs)} | given
    while True:
        made: Any = chunk(state, nbrs)
        if not (isinstance(made, tuple | list) and len(made) == 2 and isinstance(made[1], KeptSearch)):
            raise TypeError(f"chunk must return the state and the list, got {jax.tree.structure(made)}.")
        after, seen = made
        with own_transfers():
            overflow = bool(np.any(np.asarray(seen.overflow)))
        if not overflow:
            seen.check()
            return after, seen
        nbrs = seen.grow(positions(state), slack=slack, **given)


def _check(chunk: object, nbrs: object, functions: dict[str, Any]) -> None:
    if not isinstance(nbrs, KeptSearch):
        raise TypeError(f"nbrs must be a list of jfrnn.search or jfrnn.search_edges, got {type(nbrs).__name__}.")
    for name, given in {"chunk": chunk, **functions}.items():
        if not callable(given):
            raise TypeError(f"{name} must be a function, got {type(given).__name__}.")


def _cutoffs_of(nbrs: KeptSearch) -> Array | tuple[Array, Array] | None:
    """Return the cutoffs per particle of a list, in the form that `NeighborList.grow` takes."""
    if nbrs.radii is None:
        return None
    if nbrs.radii.table is not None:
        return nbrs.radii.table
    known = [x / 2 if nbrs.radii.summed else x for x in (nbrs.radii.sources, nbrs.radii.queries) if x is not None]
    return (known[0], known[1]) if nbrs.own_queries and len(known) == 2 else known[0]
