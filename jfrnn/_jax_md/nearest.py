"""`jax_md.partition.neighbor_list` by jfrnn: lists of the nearest image of each pair."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._geometry import Box, Status
from jfrnn._jax_md.spaces import Dense, OrderedSparse, Space, Sparse, check_format, floats_of, partition, space_of
from jfrnn._search import NeighborList as Kept
from jfrnn._search import flatten, search

Given = Any  # numbers, and arrays of NumPy or JAX
_DEFORM = {"perturbation", "new_box"}  # with these, a space of jax-md measures something else


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class NeighborList(partition.NeighborList):
    """A list as jax-md reads it, and a `jax_md.partition.NeighborList` where that is installed. A pytree.

    Attributes:
        idx: Dense: neighbors, shape [n, max_occupancy], int32; else pairs, shape [2, max_occupancy], first the neighbors. Unused
            places hold n. Pairs are those within r_cutoff + dr_threshold when the list was last rebuilt.
        reference_position: Positions at that time, shape [n, d].
        error: A `PartitionError`. Every bit of `Status` that the list sets has a code here: a box that shrank has that of cells,
            all others that of an overflow.
        kept: The list of jfrnn from which idx comes, or None where all pairs are measured by the displacement function.
        occupancy: How much room idx takes, shape [], int32; over all updates, it may exceed `max_occupancy`.
        measured_in: The matrix of box= with which the displacement function last chose the pairs, shape [d, d]; NaN without.
        exact: Whether pairs are those of `kept`, decided exactly; else the displacement function chooses among them. Static.
        cell_list_capacity, cell_size, cell_list_fn: None.
        max_occupancy, format, update_fn: As in jax-md. Static.
    """

    kept: Kept | None
    occupancy: Array
    measured_in: Array
    exact: bool = dataclasses.field(metadata={"static": True})


def neighbor_list(
    displacement_or_metric: Callable[..., Array] | None,
    box: Given,
    r_cutoff: Given,
    dr_threshold: Given = 0.0,
    capacity_multiplier: float = 1.25,
    disable_cell_list: bool = False,
    mask_self: bool = True,
    custom_mask_function: Callable[[Array], Array] | None = None,
    fractional_coordinates: bool = False,
    format: Given = Dense,
    **static_kwargs: Given,
) -> Any:  # noqa: ANN401
    """Return functions that allocate and update a list of neighbors, as `jax_md.partition.neighbor_list` does.

    Where the function is a displacement or metric of `jax_md.space.free`, `periodic` or `periodic_general`, pairs are decided
    exactly, in the box of that space. Any other function chooses, in its own arithmetic, among the pairs that are within sqrt(d)
    (r_cutoff + dr_threshold) in the periodic box=, which are all that jax-md promises to look at. In a box that is too small for
    the nearest image to be the only one, and in 1D, it is asked about all n² pairs, as in jax-md.

    Args:
        displacement_or_metric: `f(Ra, Rb, **kwargs)`, a vector or a distance [length]; None: the nearest image in `box`, exactly.
        box: Edge length, edge lengths [d], or a matrix [d, d] whose columns are the lattice vectors [length].
        r_cutoff: Distance within which pairs interact [length]. If it or dr_threshold is traced, the functions refuse to be called.
        dr_threshold: Skin [length]: the list holds pairs within r_cutoff + dr_threshold, and is rebuilt after half of that motion.
        capacity_multiplier: Factor on the room that the pairs take when the list is allocated.
        disable_cell_list: Measure all pairs by the function.
        mask_self: Whether particles are none of their own neighbors.
        custom_mask_function: Given rows of neighbors [n, k] int32, in which n means none, returns them with some replaced by n.
        fractional_coordinates: Positions count lattice vectors; allocate and update then take box= of the moment, in any form.
        format: `Dense`, `Sparse` or `OrderedSparse`.
        **static_kwargs: Not used, as in jax-md.

    Returns:
        A `NeighborListFns`: `allocate(position, extra_capacity=0, **kwargs)`, not inside jit, and
        `update(position, neighbors, **kwargs)`. Keywords are those of the displacement function. Its lists are `NeighborList`.

    Raises:
        ValueError, TypeError: an argument is of the wrong kind, shape or range. `allocate` also raises what `NeighborList.check`
            of jfrnn would, as for positions that are not finite.
    """
    form = check_format(format)
    if isinstance(r_cutoff, Tracer) or isinstance(dr_threshold, Tracer):  # as where an energy is differentiated by its lengths
        return partition.NeighborListFns(_refuse, _refuse)
    cutoff, skin = float(r_cutoff), float(dr_threshold)
    reach = cutoff + skin
    if not (cutoff > 0 and 0 <= skin < np.inf):
        raise ValueError(f"r_cutoff must be above 0, and dr_threshold finite and not below 0, got {cutoff} and {skin}.")

    def own_space(dim: int) -> Space | None:
        return Space(box, fractional_coordinates) if displacement_or_metric is None else space_of(displacement_or_metric, dim)

    def squared(a: Array, b: Array, **kwargs: Given) -> Array:
        if displacement_or_metric is None:
            raise ValueError(
                f"box must be at least 2.05 (r_cutoff + dr_threshold) = {2.05 * reach} wide, or displacement_or_metric given."
            )
        away = displacement_or_metric(a, b, **kwargs)
        return away**2 if away.ndim == 0 else jnp.sum(away**2)

    def finish(rows: Array, room: int, packed: bool) -> tuple[Array, Array]:
        """Return what idx holds, and how much room that takes; rows are packed to the left, or have n anywhere."""
        n, own = len(rows), jnp.arange(len(rows), dtype=jnp.int32)[:, None]
        rows = rows if custom_mask_function is None else custom_mask_function(rows)
        if form is OrderedSparse:
            rows = jnp.where(rows < own, rows, n)
        used = rows < n
        if form is Dense:
            place = jnp.cumsum(used, axis=1, dtype=jnp.int32)
            count = jnp.max(place[:, -1:], initial=0)
            if packed and custom_mask_function is None:
                return jnp.pad(rows, ((0, 0), (0, max(room - rows.shape[1], 0))), constant_values=n)[:, :room], count
            empty = jnp.full((n, room), n, jnp.int32)
            return empty.at[own, jnp.where(used, place - 1, room)].set(rows, mode="drop"), count
        if 0 in (room, *rows.shape):
            return jnp.full((2, room), n, jnp.int32), used.sum(dtype=jnp.int32)
        flat = flatten(used, room)
        return jnp.stack([jnp.where(flat.rows < n, rows.reshape(-1)[flat.slots], n), flat.rows]), flat.offsets[-1]

    @functools.partial(jax.jit, static_argnames="cells")  # as in jax-md: XLA rounds numbers of bfloat16 less often in a program
    def are_near(position: Array, rows: Array, cells: bool, kwargs: dict[str, Given]) -> Array:
        ask = functools.partial(squared, **kwargs)
        orders = [ask] * (cells or form is not Dense) + [lambda a, b: ask(b, a)] * (form is Dense)  # in which jax-md asks
        near = [jax.vmap(jax.vmap(order, (None, 0)))(position, position[rows]) < reach**2 for order in orders]
        return functools.reduce(jnp.logical_and, near)

    def rows_of(position: Array, kept: Kept | None, exact: bool, kwargs: dict[str, Given]) -> Array:
        """Return the neighbors of each particle, where n means none."""
        if kept is not None and exact:
            return kept.idx
        n, own = len(position), jnp.arange(len(position), dtype=jnp.int32)
        rows = jnp.broadcast_to(own, (n, n)) if kept is None else kept.idx
        near = (rows < n) & are_near(position, rows, kept is not None, kwargs)
        near = near & (rows != own[:, None]) if mask_self else near
        return jnp.where(near, rows, n)

    def find(position: Array, kwargs: dict[str, Given], **options: Given) -> tuple[Kept | None, bool]:
        """Return a list of jfrnn, or None where all pairs are measured, and whether the pairs are decided by it alone."""
        dim = position.shape[1]
        space = own_space(dim)
        exact = space is not None and space.fractional == fractional_coordinates and not _DEFORM & kwargs.keys()
        exact = exact and (fractional_coordinates or "box" not in kwargs)
        if space is None or not exact:  # what jax-md promises to look at: cubes of cells as wide as the cutoff
            space = Space(kwargs.get("box", box), fractional_coordinates)
        elif "box" in kwargs:
            space = Space(kwargs["box"], True)
        radius = cutoff if exact else max(reach * dim**0.5 - skin, reach)
        if dim not in (2, 3) or position.dtype not in (np.float32, np.float64) or disable_cell_list or cutoff == np.inf:
            return None, False
        within = _box_of(space, dim)
        if within is not None and not isinstance(within.vectors, Tracer) and any(within.images_for(radius + skin)):
            return None, False  # a list of jax-md holds the nearest image alone
        kept = search(position, radius, skin=skin, include_self=not mask_self, box=within, **options)
        return kept, exact

    def find_anew(position: Array, neighbors: NeighborList, kwargs: dict[str, Given]) -> NeighborList:
        """Find the neighbors of a list that other functions made, which know other cutoffs, boxes or displacements.

        All but pairs and positions stays as it was, so that loops can carry the list; who made it finds its own pairs anew.
        """
        if not isinstance(neighbors, NeighborList):
            raise TypeError(f"update() was given a list of {type(neighbors).__module__}: allocate one with these functions.")
        if neighbors.format != form:
            raise ValueError(f"update() of format {form.name} was given a list of format {neighbors.format.name}: allocate anew.")
        (n, dim), room, theirs = position.shape, neighbors.max_occupancy, getattr(neighbors.update_fn, "settings", None)
        most = n
        if neighbors.kept is not None and theirs is not None:  # as many as at the density of that list, and half more
            wider = reach * dim**0.5 / (theirs[2] + theirs[3])
            most = min(n, int(1.5 * neighbors.kept.capacity * max(wider, 1.0) ** dim) + 32)
        kept, exact = find(position, kwargs, capacity=most)
        idx, held = finish(rows_of(position, kept, exact, kwargs), room, exact)
        status = jnp.where(jnp.isfinite(position).all(), 0, Status.NONFINITE.value) if kept is None else kept.status
        code = neighbors.error.code | jnp.where(held > room, 1, 0).astype(jnp.uint8) | _code_of(status)
        made = {"idx": idx, "reference_position": position, "error": partition.PartitionError(code)}
        held, nowhere = jnp.maximum(held, neighbors.occupancy), jnp.full_like(neighbors.measured_in, jnp.inf)
        return dataclasses.replace(neighbors, **made, occupancy=held, measured_in=nowhere)

    def allocate(position: Array, extra_capacity: int = 0, **kwargs: Given) -> NeighborList:
        position = floats_of(position)
        if isinstance(position, Tracer):
            raise TypeError(
                "allocate() chooses shapes from positions and cannot run inside jax.jit: call it outside, update inside."
            )
        if not jnp.issubdtype(position.dtype, jnp.floating):
            raise TypeError(f"position must hold floats, got {position.dtype}.")
        finite = jnp.isfinite(position).all(axis=1)
        if not bool(finite.all()):
            at = int(jnp.argmin(finite))
            raise ValueError(f"position holds non-finite coordinates, {position[at]} of particle {at}.")
        n = len(position)
        kept, exact = find(position, kwargs, slack=max(float(capacity_multiplier), 1.0))
        if kept is not None:
            kept.check()
        rows = rows_of(position, kept, exact, kwargs)
        occupancy = int(finish(rows, 0, exact)[1])
        most = {Dense: n - mask_self, Sparse: n * (n - mask_self), OrderedSparse: n * (n - 1) // 2}[form]
        extra = extra_capacity if form is Dense else n * extra_capacity
        room = max(min(int(occupancy * capacity_multiplier + extra), most), 0)
        if kept is not None and exact and form is Dense and room > kept.capacity:
            kept, _ = find(position, kwargs, capacity=room)
            rows = rows_of(position, kept, exact, kwargs)
        idx, held = finish(rows, room, exact)
        error = partition.PartitionError(jnp.where(held > room, 1, 0).astype(jnp.uint8))
        fixed = (None, room, form, None, None, update)
        chosen = {"occupancy": held, "measured_in": _matrix_of(kwargs.get("box", jnp.nan), position), "exact": exact}
        return NeighborList(idx, position, error, *fixed, kept=kept, **chosen)

    def update(position: Array, neighbors: NeighborList, **kwargs: Given) -> NeighborList:
        position = floats_of(position)
        if "box" in kwargs and not (fractional_coordinates or disable_cell_list):
            raise ValueError("a list takes box= only with fractional_coordinates=True or disable_cell_list=True.")
        if neighbors.update_fn is not update and not _alike(getattr(neighbors.update_fn, "settings", None), settings):
            return find_anew(position, neighbors, kwargs)
        kept, room, exact = neighbors.kept, neighbors.max_occupancy, neighbors.exact
        dim, present = position.shape[1], None
        if fractional_coordinates and kept is not None:
            own = own_space(dim) if exact else None
            present = _box_of(Space(kwargs.get("box", box if own is None else own.box), True), dim)
        if exact and _DEFORM & kwargs.keys():
            raise TypeError(f"update() got {', '.join(_DEFORM & kwargs.keys())}, with which the list was not allocated.")
        new = None if kept is None else kept.update(position, box=present)
        moved = new.rebuild_count != kept.rebuild_count if new is not None and kept is not None and skin else jnp.asarray(False)
        measured_in = _matrix_of(kwargs.get("box", jnp.nan), position)
        moved = moved | jnp.isinf(neighbors.measured_in).any()  # others have chosen the pairs
        if not exact:
            away = jax.vmap(functools.partial(squared, **kwargs))(position, neighbors.reference_position)
            resized = ~jnp.array_equal(measured_in, neighbors.measured_in, equal_nan=True)
            moved = moved | resized | ~(away <= (skin / 2) ** 2).all()

        def rebuild() -> tuple[Array, ...]:
            return *finish(rows_of(position, new, exact, kwargs), room, exact), position

        def keep() -> tuple[Array, ...]:
            return neighbors.idx, neighbors.occupancy, neighbors.reference_position

        idx, held, reference = rebuild() if skin == 0 else lax.cond(moved, rebuild, keep)
        code = neighbors.error.code | jnp.where(held > room, 1, 0).astype(jnp.uint8)
        status = jnp.where(jnp.isfinite(position).all(), 0, Status.NONFINITE.value) if new is None else new.status
        code = code | _code_of(status)
        error, held = partition.PartitionError(code), jnp.maximum(held, neighbors.occupancy)
        now = {"reference_position": reference, "error": error, "kept": new, "occupancy": held, "measured_in": measured_in}
        return dataclasses.replace(neighbors, idx=idx, **now)

    functions = displacement_or_metric, custom_mask_function
    settings = functions, box, cutoff, skin, form, disable_cell_list, mask_self, fractional_coordinates
    update.settings = settings  # pyright: ignore[reportFunctionMemberAccess]
    return partition.NeighborListFns(allocate, update)


def _refuse(*_: Given, **__: Given) -> Any:  # noqa: ANN401
    raise TypeError(
        "r_cutoff and dr_threshold must be known to allocate or update a list, and were traced: make its functions outside of "
        "jax.jit and jax.grad, or call the list's own update()."
    )


def _alike(some: Any, others: tuple) -> bool:  # noqa: ANN401
    """Say whether functions were made with the same arguments: displacements may be two of the same space of jax-md."""
    if some is None:
        return False
    (move, mask), box, *rest = some
    (other_move, other_mask), other_box, *others_rest = others
    if rest != others_rest or mask is not other_mask or not _same_box(box, other_box):
        return False
    if move is other_move:
        return True
    both = [None if each is None else space_of(each, np.shape(box)[0] if np.ndim(box) else 3) for each in (move, other_move)]
    known, other = both
    return known is not None and other is not None and known.fractional == other.fractional and _same_box(known.box, other.box)


def _same_box(box: Given, other: Given) -> bool:
    """Say whether two boxes are known to be the same."""
    if box is other:
        return True
    if box is None or other is None or isinstance(box, Tracer) or isinstance(other, Tracer):
        return False
    return bool(np.array_equal(np.asarray(box), np.asarray(other)))


def _code_of(status: Array) -> Array:
    """Return the code of an error, uint8: every bit of a list sets one, and says that `allocate` is to be called.

    Where more room does not help, as with positions that are not finite, `allocate` raises what is wrong.
    """
    shrunk = (status & Status.BOX_TOO_SMALL.value) != 0
    others = (status & ~Status.BOX_TOO_SMALL.value) != 0
    codes = partition.PartitionErrorCode.CELL_SIZE_TOO_SMALL, partition.PartitionErrorCode.NEIGHBOR_LIST_OVERFLOW
    return jnp.where(shrunk, codes[0].value, 0).astype(jnp.uint8) | jnp.where(others, codes[1].value, 0).astype(jnp.uint8)


def _matrix_of(box: Given, position: Array) -> Array:
    """Return the matrix of a box in any form, [d, d]."""
    dim = position.shape[1]
    matrix = jnp.asarray(box, position.dtype if position.dtype.itemsize > 2 else np.float32)
    return matrix if matrix.ndim == 2 else jnp.where(jnp.eye(dim, dtype=bool), matrix, 0 * matrix)


def _box_of(space: Space, dim: int) -> Box | None:
    """Return the box of a space: of lattice vectors where positions are fractions, so that any box may follow."""
    if space.box is None:
        return None
    box = space.box if isinstance(space.box, Array) else np.asarray(space.box)
    xp = jnp if isinstance(box, Tracer) else np
    if box.ndim < 2:
        box = xp.broadcast_to(box, (dim,))
        return Box(xp.diag(box) if space.fractional else box, fractional=space.fractional)
    return Box(box.T, fractional=space.fractional)
