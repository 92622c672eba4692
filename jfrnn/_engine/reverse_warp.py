"""Where the pairs of a list stand the other way round, by Warp's kernels."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn.kernels import reverse


def reverse_slots(idx: Array, codes: Array | None, images: int, cuda: bool) -> Array:
    """Return the slot of (j, i) for each slot of (i, j), of the opposite image: [n, capacity] int32, n * capacity for none."""
    width = 0 if codes is None else codes.dtype.itemsize
    given = jnp.zeros(1, jnp.int32) if codes is None else codes
    slots, _ = _reverse_callable(width, images, cuda)(idx, given, output_dims={"slots": idx.shape, "info": 2})
    return slots


def slots_by_source(idx: Array, sources: int) -> tuple[Array, Array, Array]:
    """Return the used slots of a list in the order of their sources [m * capacity], and where those of each begin and how many."""
    dims = {"slots": idx.size, "starts": sources, "lengths": sources}
    slots, starts, lengths = _transpose_callable()(idx, output_dims=dims)
    return slots, starts, lengths


@kernel
def _reverse_callable(code_bytes: int, images: int, cuda: bool) -> Call:
    name = f"jfrnn_reverse_{'cuda' if cuda else 'cpu'}_{code_bytes}_{images}"
    plan = functools.partial(_plan_reverse, code_bytes, images, cuda)
    return Call(name, ("idx", "codes"), dict.fromkeys(("slots", "info"), np.int32), plan)


def _plan_reverse(code_bytes: int, images: int, cuda: bool, shapes: Shapes, _: int) -> Plan:
    n, capacity = shapes["idx"]
    found = reverse.reverse_kernel(code_bytes, cuda)
    launch = Launch(found, reverse.LANES_PER_SLOT * n * capacity) if cuda else share(found, n, reverse.ROWS_AT_ONCE)
    return Plan([Clear("info", 8), launch], {"n": n, "capacity": capacity, "images": images})


@kernel
def _transpose_callable() -> Call:
    return Call("jfrnn_transpose_cpu", ("idx",), dict.fromkeys(("slots", "starts", "lengths"), np.int32), _plan_transpose)


def _plan_transpose(shapes: Shapes, _: int) -> Plan:
    m, capacity = shapes["idx"]
    return Plan([Launch(reverse.transpose_kernel())], {"n": shapes["starts"][0], "m": m, "capacity": capacity})
