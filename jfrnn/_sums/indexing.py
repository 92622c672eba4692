"""Rules of primitives that move windows of an array by indices (see `jfrnn._sums.primitives`).

An index that is constant costs nothing: numbers of scalars are moved. One that depends on data, such as the species of a particle,
selects among all places where the window can begin. Axes are taken in the order in which their indices are known: of a table that
is read by kinds of i and of j, what is left is a row of it that serves all pairs of i.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from jfrnn._sums.scalars import Equation, NoTranslationError, Rule, Values

MOST_PLACES = 64  # most places to which data may say that something is added; the gradient of a table has one sum for each

Starts = dict[int, int]  # per axis the scalar that says where a window begins


def choose(eqn: Equation, which: Values, cases: Sequence[Values], dtype: str) -> Values:
    """Return the case that `which` selects, a bool or an integer; an integer out of range selects the nearest case."""
    kind = eqn.scalars.nodes[int(which.flat[0])].dtype if which.size else "bool"
    if kind == "bool":
        return eqn.each("select", which, cases[1], cases[0], dtype=dtype)
    result = cases[0]
    for k, case in enumerate(cases[1:], 1):
        beyond = eqn.each("ge", which, eqn.full(k, dtype=kind), dtype="bool")
        result = eqn.each("select", beyond, case, result, dtype=dtype)
    return result


def _compare(eqn: Equation, operation: str, index: int, number: int) -> Values:
    return eqn.each(operation, np.array(index), eqn.full(number, dtype=eqn.scalars.nodes[index].dtype), dtype="bool")


def _take(eqn: Equation, operand: Values, starts: Starts, sizes: Sequence[int]) -> Values:
    """Return the window of these sizes that begins at `starts`, moved until all of it is in range."""
    for axis in sorted(starts, key=lambda axis: eqn.scalars.latest_input(starts[axis])):
        index, places = starts[axis], operand.shape[axis] - sizes[axis] + 1
        known = eqn.scalars.value(index)
        range_of_places = range(places) if known is None else [min(max(int(known), 0), places - 1)]
        windows = [operand.take(range(at, at + sizes[axis]), axis) for at in range_of_places]
        operand = windows[0] if len(windows) == 1 else choose(eqn, np.array(index), windows, eqn.outputs[0].dtype)
    return operand


def _is_inside(eqn: Equation, shape: Sequence[int], starts: Starts, sizes: Sequence[int]) -> Values:
    """Say whether all of a window is in range."""
    inside = eqn.full(True, dtype="bool")
    for axis, index in starts.items():
        for operation, bound in (("ge", 0), ("le", shape[axis] - sizes[axis])):
            inside = eqn.each("both", inside, _compare(eqn, operation, index, bound), dtype="bool")
    return inside


def dynamic_slice(eqn: Equation, inputs: list[Values]) -> list[Values]:
    """Translate `lax.dynamic_slice`."""
    operand, *indices = inputs
    return [_take(eqn, operand, {axis: int(index) for axis, index in enumerate(indices)}, eqn.params["slice_sizes"])]


def gather(eqn: Equation, inputs: list[Values]) -> list[Values]:
    """Translate `lax.gather`: a window for each vector of indices."""
    (operand, indices), dims, sizes = inputs, eqn.params["dimension_numbers"], eqn.params["slice_sizes"]
    batching = dims.operand_batching_dims, dims.start_indices_batching_dims
    gone = (*dims.collapsed_slice_dims, *dims.operand_batching_dims)
    windows = []
    for place in np.ndindex(indices.shape[:-1]):
        part, starts = operand, dict(zip(dims.start_index_map, indices[place].tolist(), strict=True))
        for axis, of_indices in zip(*batching, strict=True):
            part = part.take([place[of_indices]], axis)
        window = _take(eqn, part, starts, sizes)
        if _mode(eqn) == "FILL_OR_DROP":
            inside = _is_inside(eqn, operand.shape, starts, sizes)
            window = eqn.each("select", inside, window, eqn.full(eqn.params["fill_value"]))
        windows.append(np.squeeze(window, gone))
    shape = [size for axis, size in enumerate(sizes) if axis not in gone]
    found = np.array(windows, int).reshape((*indices.shape[:-1], *shape))
    return [np.moveaxis(found, range(indices.ndim - 1, found.ndim), dims.offset_dims)]


def _mode(eqn: Equation) -> str:
    name = eqn.params["mode"].name
    if name not in ("CLIP", "FILL_OR_DROP", "PROMISE_IN_BOUNDS"):
        raise NoTranslationError(f"the primitive {eqn.primitive.name!r} has no translation into a kernel with the mode {name}.")
    return name


# --- into an array ----------------------------------------------------------------------------------------------------

Change = Callable[[Equation, Values, Values, Values], Values]  # (old, new, whether it is there) -> what becomes of it


def set_window(eqn: Equation, old: Values, new: Values, there: Values) -> Values:
    """Replace what is there."""
    return eqn.each("select", there, new, old)


def add_window(eqn: Equation, old: Values, new: Values, there: Values) -> Values:
    """Add to what is there."""
    return eqn.each("select", there, eqn.each("add", old, new), old)


def _put(eqn: Equation, operand: Values, window: Values, starts: Starts, clamped: bool, change: Change) -> Values:
    """Return the operand, changed by a window that begins at `starts`; one that is not in range is moved there, or dropped."""
    result, axes = operand.copy(), list(starts)
    of_axes = [list(_places(eqn, operand, window, axis, starts[axis], clamped)) for axis in axes]
    if math.prod(map(len, of_axes)) > MOST_PLACES:
        raise NoTranslationError(
            f"the primitive {eqn.primitive.name!r} has no translation into a kernel where data choose among more than "
            f'{MOST_PLACES} places, as in the gradient of table[i["kind"], j["kind"]] by a large table: pass backend="jax".'
        )
    for places in itertools.product(*of_axes):
        at = [slice(0, size) for size in window.shape]
        there = eqn.full(True, dtype="bool")
        for axis, (place, is_it) in zip(axes, places, strict=True):
            at[axis] = slice(place, place + window.shape[axis])
            there = eqn.each("both", there, is_it, dtype="bool")
        result[tuple(at)] = change(eqn, result[tuple(at)], window, there)
    return result


def _places(eqn: Equation, operand: Values, window: Values, axis: int, index: int, clamped: bool) -> Iterator[tuple[int, Values]]:
    """Yield where a window can begin along an axis, and whether it begins there."""
    last = operand.shape[axis] - window.shape[axis]
    for place in range(last + 1):
        operation = "eq" if not clamped else "le" if place == 0 else "ge" if place == last else "eq"
        there = eqn.full(True, dtype="bool") if clamped and last == 0 else _compare(eqn, operation, index, place)
        if eqn.scalars.value(int(there)) in (None, True):
            yield place, there


def dynamic_update_slice(eqn: Equation, inputs: list[Values]) -> list[Values]:
    """Translate `lax.dynamic_update_slice`."""
    operand, window, *indices = inputs
    return [_put(eqn, operand, window, {axis: int(index) for axis, index in enumerate(indices)}, True, set_window)]


def scatter(change: Change) -> Rule:
    """Return the rule of a scatter, by what becomes of an element to which it brings another."""

    def rule(eqn: Equation, inputs: list[Values]) -> list[Values]:
        (result, indices, updates), dims = inputs, eqn.params["dimension_numbers"]
        result, clamped = result.copy(), _mode(eqn) == "CLIP"
        windows = np.moveaxis(updates, dims.update_window_dims, range(indices.ndim - 1, updates.ndim))
        gone = sorted((*dims.inserted_window_dims, *dims.operand_batching_dims))
        for place in np.ndindex(indices.shape[:-1]):
            starts = dict(zip(dims.scatter_dims_to_operand_dims, indices[place].tolist(), strict=True))
            part: list[slice] = [slice(None)] * result.ndim
            for axis, of_indices in zip(dims.operand_batching_dims, dims.scatter_indices_batching_dims, strict=True):
                part[axis] = slice(place[of_indices], place[of_indices] + 1)
            window = np.expand_dims(windows[place], tuple(gone))
            result[tuple(part)] = _put(eqn, result[tuple(part)], window, starts, clamped, change)
        return [result]

    return rule
