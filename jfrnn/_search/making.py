"""Make the arrays of a list, and choose its capacity."""

import functools
import math
from typing import Any

from jax import lax

from jfrnn._engine import Found, Inputs, Options, count_few, count_rows, hide_inactive, list_flat, list_rows, take_present
from jfrnn._geometry import Radii
from jfrnn._search.present import ImageCodes
from jfrnn._search.reverse import find_reverse
from jfrnn._search.topology import make_topology
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
        longest = int(count_rows(inputs, options)[1]) if known is None else int(known.max())
    wanted = math.ceil(max(longest, 1) * slack)
    return min(round_capacity(wanted), max(wanted, inputs.sources.shape[0]))


@functools.partial(compile_program, static_argnames=("options", "capacity", "moving", "reversing"))
def find_fields(inputs: Inputs, options: Options, capacity: int, moving: bool, reversing: bool) -> dict[str, Any]:
    """Search, and return the list's fields that come from data: the compiled program of `search`.

    `moving` says that the list has a skin, `reversing` that it keeps where pairs stand the other way round.

    As results of one program, they share no memory with the caller's arrays or each other, so either may be donated.
    """
    found = list_rows(inputs, options, capacity)
    rows, fields = found.rows, _common_fields(inputs, options, found, moving)
    fields |= {"idx": rows.idx, "count": rows.counts, "order": rows.order, "reverse": None}
    if reversing and rows.idx is not None:
        codes = None if fields["images"] is None else fields["images"].codes
        own = len(inputs.sources), inputs.queries is not None, fields["radii"]
        fields["reverse"] = make_topology(options, *own, rows.idx, codes, None, rows.order).with_reverse()
    return fields


@functools.partial(compile_program, static_argnames=("options", "total", "moving", "reversing"))
def find_flat_fields(inputs: Inputs, options: Options, total: int, moving: bool, reversing: bool) -> dict[str, Any]:
    """Do what `find_fields` does, for a flat list: the compiled program of `search_edges`."""
    offsets, found = list_flat(inputs, options, total)
    rows, fields = found.rows, _common_fields(inputs, options, found, moving)
    fields |= {"senders": rows.idx, "receivers": rows.receivers, "offsets": offsets, "reverse": None}
    if reversing and rows.idx is not None:
        fields["reverse"] = find_reverse(rows.idx[:, None], None, 1, len(inputs.sources), False, options.engine.native)
    return fields


def _common_fields(inputs: Inputs, options: Options, found: Found, moving: bool) -> dict[str, Any]:
    rows, sources = found.rows, hide_inactive(inputs.sources, take_present(inputs).active)
    codes = None if found.images is None or found.turns is None else ImageCodes(found.images, *found.turns)
    radii = lax.stop_gradient(inputs.cutoff) if isinstance(inputs.cutoff, Radii) else None
    verlet = first_verlet(sources, inputs.queries, inputs.box, options.images, radii, inputs.batch) if moving else None
    fields = {"status": rows.status, "required": rows.required, "verlet": verlet, "box": lax.stop_gradient(inputs.box)}
    return fields | {"images": codes, "radii": radii, "batch": inputs.batch, "exclude": inputs.exclude}
