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


def collect_slots(values: Array, slots: Array, starts: Array | None, lengths: Array | None, sources: int, cuda: bool) -> Array:
    """Return the sums of values [slots, width] over the slots of each source [sources, width]; see `jfrnn._search.reverse`."""
    by_source, nothing = starts is not None, jnp.zeros(1, jnp.int32)
    call = _collect_callable(values.shape[1], values.dtype == jnp.float64, by_source, cuda)
    given = values, slots, *(nothing if x is None else x for x in (starts, lengths))
    return call(*given, output_dims={"sums": (sources, values.shape[1]), "info": 2})[0]


def flatten_slots(mask: Array, starts: Array, total: int, cuda: bool) -> tuple[Array, Array]:
    """Return the rows of the slots that are set in a mask [m, capacity], and the slots, [total] int32 each.

    `starts` [m] are how many come before each row. What stands behind the last slot is undefined.
    """
    receivers, slots, _ = _flatten_callable(cuda)(mask, starts, output_dims={"receivers": total, "slots": total, "info": 2})
    return receivers, slots


@kernel
def _flatten_callable(cuda: bool) -> Call:
    name, plan = f"jfrnn_flatten_{'cuda' if cuda else 'cpu'}", functools.partial(_plan_flatten, cuda)
    return Call(name, ("mask", "starts"), dict.fromkeys(("receivers", "slots", "info"), np.int32), plan)


def _plan_flatten(cuda: bool, shapes: Shapes, _: int) -> Plan:
    m, capacity = shapes["mask"]
    found = reverse.flatten_kernel(cuda)
    launch = Launch(found, reverse.LANES_PER_ROW * m) if cuda else share(found, m, reverse.ROWS_AT_ONCE)
    numbers = {"m": m, "capacity": capacity, "total": shapes["slots"][0]}
    return Plan([launch] if cuda else [Clear("info", 8), launch], numbers)


@kernel
def _collect_callable(width: int, double: bool, by_source: bool, cuda: bool) -> Call:
    name = f"jfrnn_collect_{'cuda' if cuda else 'cpu'}_{width}_{'f64' if double else 'f32'}{'_sorted' * by_source}"
    results = {"sums": np.float64 if double else np.float32, "info": np.int32}
    return Call(name, ("values", "slots", "starts", "lengths"), results, functools.partial(_plan_collect, by_source, double, cuda))


def _plan_collect(by_source: bool, double: bool, cuda: bool, shapes: Shapes, _: int) -> Plan:
    (n, width), slots = shapes["sums"], shapes["slots"]
    found = reverse.collect_kernel(width, double, by_source, cuda)
    numbers = {"n": n, "capacity": slots[-1], "all": shapes["values"][0]}
    launch = Launch(found, reverse.LANES_PER_SLOT * n) if cuda else share(found, n, reverse.ROWS_AT_ONCE)
    return Plan([launch] if cuda else [Clear("info", 8), launch], numbers)


@kernel
def _reverse_callable(code_bytes: int, images: int, cuda: bool) -> Call:
    name = f"jfrnn_reverse_{'cuda' if cuda else 'cpu'}_{code_bytes}_{images}"
    plan = functools.partial(_plan_reverse, code_bytes, images, cuda)
    return Call(name, ("idx", "codes"), dict.fromkeys(("slots", "info"), np.int32), plan)


def _plan_reverse(code_bytes: int, images: int, cuda: bool, shapes: Shapes, _: int) -> Plan:
    n, capacity = shapes["idx"]
    clear, find = reverse.reverse_kernels(code_bytes, cuda)
    launch = Launch(find, reverse.LANES_PER_SLOT * n * capacity) if cuda else share(find, n, reverse.ROWS_AT_ONCE)
    first = Launch(clear, n * capacity if cuda else 1)
    return Plan([Clear("info", 8), first, launch], {"n": n, "capacity": capacity, "images": images})


@kernel
def _transpose_callable() -> Call:
    return Call("jfrnn_transpose_cpu", ("idx",), dict.fromkeys(("slots", "starts", "lengths"), np.int32), _plan_transpose)


def _plan_transpose(shapes: Shapes, _: int) -> Plan:
    m, capacity = shapes["idx"]
    return Plan([Launch(reverse.transpose_kernel())], {"n": shapes["starts"][0], "m": m, "capacity": capacity})
