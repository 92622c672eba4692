"""`jax_md.custom_partition.neighbor_list_multi_image` by jfrnn: lists of all images of each pair."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry import Box
from jfrnn._jax_md.spaces import Dense, OrderedSparse, Sparse, check_format, custom_partition, floats_of
from jfrnn._search import NeighborList as Kept
from jfrnn._search import flatten, search

Given = Any  # numbers, and arrays of NumPy or JAX
_theirs = getattr(custom_partition, "neighbor_list_multi_image", None)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class NeighborListMultiImage(custom_partition.NeighborListMultiImage):
    """A list with all images of each pair, as jax-md reads it. A pytree.

    Attributes:
        idx: Dense: neighbors j, shape [n, max_occupancy]; else a tuple of particles i and neighbors j, [max_occupancy] each, int32.
            Unused places hold n. OrderedSparse holds of (i, j, S) and (j, i, -S) the one whose S has a positive number first, and
            of S = 0 the one with i < j.
        shifts: Whole numbers S [..., d], int32: pairs are r_j + S @ box.T - r_i apart.
        reference_position: Positions when the list was last rebuilt, shape [n, d].
        reference_box: The box at that time, shape [d, d].
        box: The present box, shape [d, d].
        did_buffer_overflow: Whether pairs are missing, for lack of room, because the box shrank, or because positions are not
            finite or too far away: allocate again, which raises what room cannot help. [] bool.
        kept: The list of jfrnn from which idx and shifts come.
        search_shifts: None.
        max_occupancy, format, update_fn: As in jax-md. Static.
    """

    kept: Kept


def neighbor_list_multi_image(  # noqa: D417 (four arguments share a line)
    displacement_or_metric: Given,
    box: Given,
    r_cutoff: Given,
    dr_threshold: Given = 0.0,
    capacity_multiplier: float = 1.25,
    pbc: Given = None,
    fractional_coordinates: bool = True,
    ordered: bool = False,
    format: Given = Sparse,
    **kwargs: Given,
) -> Any:  # noqa: ANN401
    """Return functions that allocate and update a list with all images of pairs, as `neighbor_list_multi_image` of jax-md does.

    Args:
        displacement_or_metric: Not used.
        box: A matrix [d, d] whose columns are the lattice vectors [length], or edge lengths.
        r_cutoff, dr_threshold, capacity_multiplier, fractional_coordinates: As in `neighbor_list`.
        pbc: Which axes are periodic, [d] bools; default: all.
        ordered: As `format=OrderedSparse`.
        format: `Dense`, `Sparse` or `OrderedSparse`.
        **kwargs: Not used, as in jax-md.

    Returns:
        A `NeighborListMultiImageFns`, the lists of which are `NeighborListMultiImage`; both functions take box=. In 1D, and of
        positions of float16 or bfloat16, `allocate` returns a list of jax-md's own, decided by its arithmetic.

    Raises:
        ValueError, TypeError: an argument is of the wrong kind, shape or range, or jax-md's own list is needed and not there.
    """
    form, cutoff, skin = check_format(format), float(r_cutoff), float(dr_threshold)
    form = OrderedSparse if ordered and form is Sparse else form

    def box_of(box: Given, dim: int, like: Box | None = None) -> tuple[Array, Box]:
        matrix = jnp.asarray(box)
        matrix = jnp.eye(dim) * matrix if matrix.ndim < 2 else matrix
        vectors = matrix.T if isinstance(matrix, Tracer) or like is not None else np.asarray(matrix).T
        axes = like.periodic if like is not None else True if pbc is None else np.asarray(pbc).tolist()
        return matrix, Box(vectors, axes, fractional=fractional_coordinates)

    def finish(kept: Kept, position: Array, made: Box, room: int) -> tuple[Any, Array, Array]:
        n = len(position)
        quiet = dataclasses.replace(kept, status=jnp.zeros_like(kept.status))  # else it raises what the caller is told
        shifts = quiet.shifts(position, box=made)
        used = kept.idx < n
        if form is OrderedSparse:
            i = jnp.arange(n, dtype=jnp.int32)[:, None]
            ahead = i < kept.idx
            for k in reversed(range(shifts.shape[-1])):  # the first number that is not 0 decides
                ahead = jnp.where(shifts[..., k] != 0, shifts[..., k] > 0, ahead)
            used = used & ahead
        if form is Dense:
            more = ((0, 0), (0, max(room - kept.capacity, 0)))
            idx, shifts = jnp.pad(kept.idx, more, constant_values=n)[:, :room], jnp.pad(shifts, (*more, (0, 0)))[:, :room]
            return idx, shifts, jnp.max(kept.count, initial=0)
        if 0 in used.shape:
            none = jnp.full(room, n, jnp.int32)
            return (none, none), jnp.zeros((room, shifts.shape[-1]), jnp.int32), jnp.int32(0)
        flat = flatten(used, room)
        real_pair = flat.rows < n
        senders = jnp.where(real_pair, kept.idx.reshape(-1)[flat.slots], n)
        shifts = jnp.where(real_pair[:, None], shifts.reshape(used.size, -1)[flat.slots], 0)
        return (flat.rows, senders), shifts, flat.offsets[-1]

    def made_of(fields: tuple[Any, ...], overflow: Array, kept: Kept, room: int) -> NeighborListMultiImage:
        return NeighborListMultiImage(*fields, None, form, room, update, overflow, kept=kept)  # pyright: ignore

    def allocate(position: Array, extra_capacity: int = 0, box: Given = box, **given: Given) -> NeighborListMultiImage:
        position = floats_of(position)
        n, dim = position.shape
        if dim not in (2, 3) or position.dtype in (np.float16, jnp.bfloat16):
            if _theirs is None:
                raise TypeError(
                    "position must have shape [n, 2] or [n, 3] and dtype float32 or float64, got "
                    f"{list(position.shape)} and {position.dtype}: of others, install jax-md, which then makes the list itself."
                )
            matrix = jnp.asarray(box) if np.ndim(box) == 2 else jnp.eye(dim) * jnp.asarray(box)
            own = _theirs(None, matrix, cutoff, skin, capacity_multiplier, pbc, fractional_coordinates, format=form)
            return own.allocate(position, extra_capacity)
        matrix, made = box_of(box, dim)
        kept = search(position, cutoff, box=made, skin=skin, slack=max(float(capacity_multiplier), 1.0))
        kept.check()
        occupancy = int(finish(kept, position, made, 1)[2])
        room = max(int(occupancy * capacity_multiplier) + extra_capacity * (1 if form is Dense else n), 1)
        if room > kept.capacity and form is Dense:
            kept = search(position, cutoff, box=made, skin=skin, capacity=room)
        idx, shifts, held = finish(kept, position, made, room)
        return made_of((idx, shifts, position, matrix, matrix), held > room, kept, room)

    def update(position: Array, neighbors: NeighborListMultiImage, box: Given = None, **given: Given) -> NeighborListMultiImage:
        if not isinstance(neighbors, NeighborListMultiImage):  # jax-md's own
            return neighbors.update(position, **{} if box is None else {"box": box})
        position, room, old = floats_of(position), neighbors.max_occupancy, neighbors.kept
        others = neighbors.update_fn is not update and getattr(neighbors.update_fn, "settings", None) != settings
        if others and neighbors.format != form:
            raise ValueError(f"update() of format {form.name} was given a list of format {neighbors.format.name}: allocate anew.")
        matrix, made = box_of(neighbors.box if box is None else box, position.shape[1], None if others else old.box)
        kept = (
            old.update(position, box=made) if not others else search(position, cutoff, box=made, skin=skin, capacity=old.capacity)
        )
        idx, shifts, held = finish(kept, position, made, room)
        moved = jnp.asarray(True) if skin == 0 or others else kept.rebuild_count != old.rebuild_count
        reference = jnp.where(moved, position, neighbors.reference_position)
        reference_box = jnp.where(moved, matrix, neighbors.reference_box)
        overflow = neighbors.did_buffer_overflow | (held > room) | (kept.status != 0)
        made = made_of((idx, shifts, reference, reference_box, matrix), overflow, old if others else kept, room)
        return dataclasses.replace(made, update_fn=neighbors.update_fn)  # so that loops can carry it, whoever updates it

    settings = cutoff, skin, form, fractional_coordinates, None if pbc is None else np.asarray(pbc).tolist()
    update.settings = settings  # pyright: ignore[reportFunctionMemberAccess]
    return custom_partition.NeighborListMultiImageFns(allocate, update)
