"""Where the pairs of a list stand the other way round, by Warp's kernels."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kernel, reverse


def reverse_slots(idx: Array, codes: Array | None, order: Array | None, images: int, cuda: bool) -> Array:
    """Return the slot of (j, i) for each slot of (i, j), of the opposite image: [n, capacity] int32, n * capacity for none.

    `order` [n]: in which order CUDA takes rows (-1: as they come), or None.
    """
    width, nothing, ordered = 0 if codes is None else codes.dtype.itemsize, jnp.zeros(1, jnp.int32), cuda and order is not None
    given = idx, nothing if codes is None else codes, order if ordered else nothing
    return _reverse_callable(width, images, ordered, cuda)(*given, output_dims={"slots": idx.shape, "info": 2})[0]


def slots_by_source(idx: Array, sources: int) -> tuple[Array, Array, Array]:
    """Return the used slots of a list in the order of their sources [m * capacity], and where those of each begin and how many."""
    slots, starts, lengths = _transpose_callable()(idx, output_dims={"slots": idx.size, "starts": sources, "lengths": sources})
    return slots, starts, lengths


def collect_slots(values: Array, slots: Array, starts: Array | None, lengths: Array | None, sources: int, cuda: bool) -> Array:
    """Return the sums of values [slots, width] over the slots of each source [sources, width]; see `jfrnn._search.present`."""
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


def pack_rows(rows: Array, counts: Array, offsets: Array, sources: int, total: int) -> tuple[Array, Array]:
    """Return the entries of rows [m, capacity] one after another, and the rows, [total] int32 each, padded by `sources` and m.

    `counts` [m] are how many each row has, at most `capacity`; `offsets` [m + 1] are where it begins, and where the last one ends.
    """

    def on(cuda: bool) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
        def pack(*given: Array) -> tuple[Array, Array]:
            dims = {"senders": total, "receivers": total, "info": 2}
            senders, receivers, _ = _pack_callable(sources, cuda)(*given, output_dims=dims)
            return senders, receivers

        return pack

    return on_platform(rows, counts, offsets, cpu=on(False), cuda=on(True))


def _share_or_launch(found: Kernel, places: int, lanes: int, cuda: bool) -> list[Clear | Launch]:
    """Return the launch of a kernel: on CUDA so many lanes for each place, on the CPU threads that share the places."""
    return [Launch(found, lanes * places)] if cuda else [Clear("info", 8), share(found, places, reverse.ROWS_AT_ONCE)]


@kernel
def _flatten_callable(cuda: bool) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        (m, capacity), numbers = shapes["mask"], {"total": shapes["slots"][0]}
        steps = _share_or_launch(reverse.flatten_kernel(cuda), m, reverse.LANES_PER_ROW, cuda)
        return Plan(steps, numbers | {"m": m, "capacity": capacity})

    results = {"receivers": np.int32, "slots": np.int32, "info": np.int32}
    return Call(f"jfrnn_flatten_{'cuda' if cuda else 'cpu'}", ("mask", "starts"), results, plan)


@kernel
def _pack_callable(sources: int, cuda: bool) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        (m, capacity), numbers = shapes["rows"], {"n": sources, "total": shapes["senders"][0]}
        steps = _share_or_launch(reverse.pack_kernel(cuda), m, reverse.LANES_PER_SHORT_ROW, cuda)
        return Plan(steps, numbers | {"m": m, "capacity": capacity})

    results = {"senders": np.int32, "receivers": np.int32, "info": np.int32}
    return Call(f"jfrnn_pack_{'cuda' if cuda else 'cpu'}_{sources}", ("rows", "counts", "starts"), results, plan)


@kernel
def _collect_callable(width: int, double: bool, by_source: bool, cuda: bool) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        (n, _), found = shapes["sums"], reverse.collect_kernel(width, double, by_source, cuda)
        numbers = {"n": n, "capacity": shapes["slots"][-1], "all": shapes["values"][0]}
        return Plan(_share_or_launch(found, n, reverse.LANES_PER_SHORT_ROW, cuda), numbers)

    name = f"jfrnn_collect_{'cuda' if cuda else 'cpu'}_{width}_{'f64' if double else 'f32'}{'_sorted' * by_source}"
    results = {"sums": np.float64 if double else np.float32, "info": np.int32}
    return Call(name, ("values", "slots", "starts", "lengths"), results, plan)


@kernel
def _reverse_callable(code_bytes: int, images: int, ordered: bool, cuda: bool) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        n, capacity = shapes["idx"]
        *clear, find = reverse.reverse_kernels(code_bytes, ordered, cuda)
        steps = [*map(Launch, clear), *_share_or_launch(find, n, reverse.LANES_PER_ROW, cuda)]
        return Plan(steps, {"n": n, "capacity": capacity, "images": images})

    name = f"jfrnn_reverse_{'cuda' if cuda else 'cpu'}_{code_bytes}_{images}{'_ordered' * ordered}"
    return Call(name, ("idx", "codes", "order"), dict.fromkeys(("slots", "info"), np.int32), plan)


@kernel
def _transpose_callable() -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        m, capacity = shapes["idx"]
        return Plan([Launch(reverse.transpose_kernel())], {"n": shapes["starts"][0], "m": m, "capacity": capacity})

    return Call("jfrnn_transpose_cpu", ("idx",), dict.fromkeys(("slots", "starts", "lengths"), np.int32), plan)
