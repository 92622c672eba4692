"""Make the arrays of a list, and choose its capacity."""

import functools
import math
from typing import Any

from jax import lax

from jfrnn._engine import Inputs, Options, count_rows, hide_inactive, list_rows, take_present
from jfrnn._geometry import Radii
from jfrnn._search.geometry import ImageCodes
from jfrnn._search.topology import make_topology
from jfrnn._search.verlet import first_verlet
from jfrnn._tracing import at_once, compile_program, own_transfers

_CAPACITY_STEP = 8


def round_capacity(slots: int) -> int:
    """Round a capacity up, so that similar scenes share one compiled program."""
    return -(-slots // _CAPACITY_STEP) * _CAPACITY_STEP


def count_capacity(inputs: Inputs, options: Options, slack: float) -> int:
    """Count the neighbors of concrete positions; return a capacity of `slack` times the longest row."""
    with at_once(), own_transfers():
        longest = int(count_rows(inputs, options)[1])
    wanted = math.ceil(max(longest, 1) * slack)
    return min(round_capacity(wanted), max(wanted, inputs.sources.shape[0]))


@functools.partial(compile_program, static_argnames=("options", "capacity", "moving", "reversing"))
def find_fields(inputs: Inputs, options: Options, capacity: int, moving: bool, reversing: bool) -> dict[str, Any]:
    """Search, and return the list's fields that come from data: the compiled program of `search`.

    `moving` says that the list has a skin, `reversing` that it keeps where pairs stand the other way round.

    As results of one program, they share no memory with the caller's arrays or each other, so either may be donated.
    """
    found = list_rows(inputs, options, capacity)
    rows, sources = found.rows, hide_inactive(inputs.sources, take_present(inputs).active)
    codes = None if found.images is None or found.turns is None else ImageCodes(found.images, *found.turns)
    radii = lax.stop_gradient(inputs.cutoff) if isinstance(inputs.cutoff, Radii) else None
    verlet = first_verlet(sources, inputs.queries, inputs.box, radii) if moving else None
    fields: dict[str, Any] = {"idx": rows.idx, "count": rows.counts, "status": rows.status, "required": rows.required}
    fields["order"] = rows.order
    images = None if codes is None else codes.codes
    fields["reverse"] = None
    if reversing and rows.idx is not None:
        topology = make_topology(options, sources.shape[0], inputs.queries is not None, radii, rows.idx, images, None, rows.order)
        fields["reverse"] = topology.with_reverse()
    return fields | {
        "verlet": verlet,
        "box": lax.stop_gradient(inputs.box),
        "images": codes,
        "radii": radii,
        "batch": inputs.batch,
        "exclude": inputs.exclude,
    }
