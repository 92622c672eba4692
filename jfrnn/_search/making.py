"""Make the arrays of a list, and choose its capacity."""

import functools
import math
from typing import Any

from jax import lax

from jfrnn._engine import Inputs, Options, count_few, count_rows, find_rows, hide_inactive, list_flat, take_present
from jfrnn._geometry import Radii
from jfrnn._search.present import ImageCodes, find_reverse, make_topology
from jfrnn._search.verlet import first_verlet
from jfrnn._tracing import Real, at_once, compile_program, own_transfers

_CAPACITY_STEP = 8


def round_capacity(slots: int) -> int:
    """Round a capacity up, so that similar scenes share one compiled program."""
    return -(-slots // _CAPACITY_STEP) * _CAPACITY_STEP


def count_capacity(inputs: Inputs, options: Options, slack: Real) -> int:
    """Count the neighbors of concrete positions; return a capacity of `slack` times the longest row."""
    with at_once(), own_transfers():
        known = count_few(inputs, options)
        longest = int(count_rows(inputs, options=options)[1]) if known is None else int(known.max())
    wanted = math.ceil(max(longest, 1) * slack)
    return min(round_capacity(wanted), max(wanted, inputs.sources.shape[0]))


@functools.partial(compile_program, static_argnames=("options", "room", "moving", "reversing", "flat"))
def find_fields(inputs: Inputs, options: Options, room: int, moving: bool, reversing: bool, flat: bool) -> dict[str, Any]:
    """Search, and return the list's fields that come from data: the compiled program of `search` and, if `flat`, `search_edges`.

    `room` is the capacity or the total, `moving` says that the list has a skin, `reversing` that it keeps where pairs stand the
    other way round. All are given by name: what JAX keeps of a call depends on it.

    As results of one program, they share no memory with the caller's arrays or each other, so either may be donated.
    """
    offsets, found = list_flat(inputs, options, room) if flat else (None, find_rows(inputs, options, room))
    rows, n, verlet, reverse = found.rows, len(inputs.sources), None, None
    images = None if found.images is None or found.turns is None else ImageCodes(found.images, found.turns[0], found.turns[1])
    radii = lax.stop_gradient(inputs.cutoff) if isinstance(inputs.cutoff, Radii) else None
    if moving:
        sources = hide_inactive(inputs.sources, take_present(inputs).active)
        verlet = first_verlet(sources, inputs.queries, inputs.box, options.images, radii, inputs.batch)
    if reversing and rows.idx is not None and flat:
        reverse = find_reverse(rows.idx[:, None], None, 1, n, False, options.engine.native)
    elif reversing and rows.idx is not None:
        codes = None if images is None else images.codes
        topology = make_topology(options, n, inputs.queries is not None, radii, rows.idx, codes, None, rows.order)
        reverse = topology.with_reverse()
    fields = {"status": rows.status, "required": rows.required, "verlet": verlet, "box": lax.stop_gradient(inputs.box)}
    fields |= {"images": images, "radii": radii, "batch": inputs.batch, "exclude": inputs.exclude, "reverse": reverse}
    if flat:
        return fields | {"senders": rows.idx, "receivers": rows.receivers, "offsets": offsets}
    return fields | {"idx": rows.idx, "count": rows.counts, "order": rows.order}
