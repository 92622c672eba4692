"""The neighbor lists of jax-md, found by jfrnn: `partition.neighbor_list` and `custom_partition.neighbor_list_multi_image`.

The functions take the arguments of jax-md's and return what its energies, `smap` and simulations read. jax-md need not be
installed; where it has been imported, formats are its own.

>>> import jax.numpy as jnp
>>> from jfrnn import jax_md
>>> fns = jax_md.neighbor_list(lambda a, b, **_: a - b, 10.0, 1.5)
>>> nbrs = fns.allocate(jnp.array([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0]]))
>>> nbrs.idx.tolist(), bool(nbrs.update(jnp.zeros((3, 2))).did_buffer_overflow)
([[1], [0], [3]], True)
"""

import dataclasses
import enum
import functools
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._geometry import Box, Status
from jfrnn._search import NeighborList as Kept
from jfrnn._search import flatten, search

__all__ = ["Dense", "NeighborListFormat", "OrderedSparse", "Sparse", "neighbor_list", "neighbor_list_multi_image"]

Distance = Callable[..., Array]
Given = Any  # numbers, and arrays of NumPy or JAX
Format = Any  # a member of `NeighborListFormat`, or of jax-md's
_PROBES = 32  # pairs of points at which a displacement function is asked what it is


class NeighborListFormat(enum.Enum):
    """What `idx` holds: rows of neighbors, or pairs (j, i), or those of them with j < i."""

    Dense = 0
    Sparse = 1
    OrderedSparse = 2


Dense, Sparse, OrderedSparse = NeighborListFormat


class PartitionErrorCode(enum.IntEnum):
    """Bits of an error, numbered as in jax-md."""

    NONE = 0
    NEIGHBOR_LIST_OVERFLOW = 1
    CELL_LIST_OVERFLOW = 2
    CELL_SIZE_TOO_SMALL = 4
    MALFORMED_BOX = 8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PartitionError:
    """What went wrong in this list and all updates that led to it: `code`, bits of `PartitionErrorCode`, [] uint8."""

    code: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList:
    """A list as jax-md reads it. A pytree.

    Attributes:
        idx: Dense: neighbors, shape [n, max_occupancy], int32; else pairs, shape [2, max_occupancy], first the neighbors. Unused
            places hold n. Pairs are those within r_cutoff + dr_threshold when the list was last rebuilt.
        reference_position: Positions at that time, shape [n, d].
        error: A `PartitionError`. Every bit of `Status` that the list sets has a code here: a box that shrank has that of cells,
            all others that of an overflow.
        kept: The list of jfrnn from which idx comes, or None where all pairs are measured by the displacement function.
        occupancy: How much room idx takes, shape [], int32; over all updates, it may exceed `max_occupancy`.
        max_occupancy, format, update_fn: As in jax-md. Static.
    """

    idx: Array
    reference_position: Array
    error: PartitionError
    kept: Kept | None
    occupancy: Array
    max_occupancy: int = dataclasses.field(metadata={"static": True})
    format: Format = dataclasses.field(metadata={"static": True})
    update_fn: Callable[..., "NeighborList"] = dataclasses.field(metadata={"static": True})
    cell_list_capacity: None = dataclasses.field(default=None, metadata={"static": True})
    cell_size: None = dataclasses.field(default=None, metadata={"static": True})
    cell_list_fn: None = dataclasses.field(default=None, metadata={"static": True})

    def update(self, position: Array, **kwargs: Given) -> "NeighborList":
        """Return the list at other positions [n, d], rebuilt if one has moved dr_threshold/2; jit and scan may call it."""
        return self.update_fn(position, self, **kwargs)

    @property
    def did_buffer_overflow(self) -> Array:
        """Whether pairs are missing for lack of room: allocate again."""
        return self.error.code & (PartitionErrorCode.NEIGHBOR_LIST_OVERFLOW | PartitionErrorCode.CELL_LIST_OVERFLOW)

    @property
    def cell_size_too_small(self) -> Array:
        """Whether pairs may be missing because the box shrank: allocate again."""
        return self.error.code & PartitionErrorCode.CELL_SIZE_TOO_SMALL

    @property
    def malformed_box(self) -> Array:
        """Always 0: boxes may be any matrix."""
        return self.error.code & PartitionErrorCode.MALFORMED_BOX


@dataclasses.dataclass(frozen=True)
class NeighborListFns:
    """Functions that make lists: allocate(position, extra_capacity=0, **kwargs) and update(position, neighbors, **kwargs)."""

    allocate: Callable[..., Any]
    update: Callable[..., Any]

    def __iter__(self) -> Iterator[Callable[..., Any]]:
        """Return both, for `allocate, update = fns`."""
        return iter((self.allocate, self.update))

    def __call__(self, position: Array, neighbors: Any = None, extra_capacity: int = 0, **kwargs: Given) -> Any:  # noqa: ANN401
        """Allocate, or update where neighbors are given, as old code of jax-md does."""
        return (
            self.allocate(position, extra_capacity, **kwargs) if neighbors is None else self.update(position, neighbors, **kwargs)
        )


def neighbor_list(
    displacement_or_metric: Distance,
    box: Given,
    r_cutoff: Given,
    dr_threshold: Given = 0.0,
    capacity_multiplier: float = 1.25,
    disable_cell_list: bool = False,
    mask_self: bool = True,
    custom_mask_function: Callable[[Array], Array] | None = None,
    fractional_coordinates: bool = False,
    format: Format = Dense,
    **static_kwargs: Given,
) -> NeighborListFns:
    """Return functions that allocate and update a list of neighbors, as `jax_md.partition.neighbor_list` does.

    Where the displacement function is that of free space, or the nearest image in this box, pairs are found by jfrnn, exactly; it
    is asked at a few random points when a list is allocated. Any other function, and any box less than 2.05 (r_cutoff +
    dr_threshold) wide, is served by measuring all n² pairs with it, as jax-md does in small boxes.

    Args:
        displacement_or_metric: `f(Ra, Rb, **kwargs)`, a vector or a distance [length].
        box: Edge length, edge lengths [d], or a matrix [d, d] whose columns are the lattice vectors [length].
        r_cutoff: Distance within which pairs interact [length].
        dr_threshold: Skin [length]: the list holds pairs within r_cutoff + dr_threshold, and is rebuilt after half of that motion.
        capacity_multiplier: Factor on the room that the pairs take when the list is allocated.
        disable_cell_list: Measure all pairs.
        mask_self: Whether particles are none of their own neighbors.
        custom_mask_function: Given rows of neighbors [n, k] int32, in which n means none, returns them with some replaced by n.
        fractional_coordinates: Positions count lattice vectors; allocate and update then take box= of the moment.
        format: `Dense`, `Sparse` or `OrderedSparse`, those of jax-md or of this module.
        **static_kwargs: Not used, as in jax-md.

    Returns:
        A `NeighborListFns`: `allocate(position, extra_capacity=0, **kwargs)`, not inside jit, and
        `update(position, neighbors, **kwargs)`. Its lists are `NeighborList`.

    Raises:
        ValueError, TypeError: an argument is of the wrong kind, shape or range. `allocate` also raises what `NeighborList.check`
            of jfrnn would, as for positions that are not finite.
    """
    own, cutoff, skin = NeighborListFormat[format.name], float(r_cutoff), float(dr_threshold)
    metric = _as_metric(displacement_or_metric)

    def finish(rows: Array, room: int) -> tuple[Array, Array]:
        """Return what idx holds, and how much room that takes."""
        n = len(rows)
        rows = rows if custom_mask_function is None else custom_mask_function(rows)
        if own is OrderedSparse:
            rows = jnp.where(rows < jnp.arange(n, dtype=rows.dtype)[:, None], rows, n)
        if own is Dense:
            count = jnp.max((rows < n).sum(1, dtype=jnp.int32), initial=0)
            rows = rows if custom_mask_function is None else jnp.sort(rows, axis=1)
            return jnp.pad(rows, ((0, 0), (0, max(room - rows.shape[1], 0))), constant_values=n)[:, :room], count
        if 0 in (room, *rows.shape):
            return jnp.full((2, room), n, jnp.int32), (rows < n).sum(dtype=jnp.int32)
        flat = flatten(rows < n, room)
        return jnp.stack([jnp.where(flat.rows < n, rows.reshape(-1)[flat.slots], n), flat.rows]), flat.offsets[-1]

    def all_pairs(position: Array, kwargs: dict[str, Given]) -> Array:
        n = len(position)
        of_row = jax.vmap(functools.partial(metric, **kwargs), (None, 0))
        near = jax.vmap(of_row, (0, None))(position, position) < cutoff + skin
        near = near & ~jnp.eye(n, dtype=bool) if mask_self else near
        return jnp.sort(jnp.where(near, jnp.arange(n, dtype=jnp.int32), n), axis=1)

    def allocate(position: Array, extra_capacity: int = 0, **kwargs: Given) -> NeighborList:
        position = jnp.asarray(position)
        if isinstance(position, Tracer):
            raise TypeError(
                "allocate() chooses shapes from positions and cannot run inside jax.jit: call it outside, update inside."
            )
        current, n = kwargs.get("box", box), len(position)
        kind = None if disable_cell_list else _kind_of(metric, current, fractional_coordinates, position, kwargs)
        kept, given = None, {"skin": skin, "include_self": not mask_self}
        if kind == "periodic" or (kind == "free" and fractional_coordinates):
            given["box"] = _box_of(current, position.shape[1], kind == "periodic", fractional_coordinates)
        if kind is not None:
            kept = search(position, cutoff, slack=max(float(capacity_multiplier), 1.0), **given)
            kept.check()
            kept = kept if kept.images is None else None  # a list of jax-md holds the nearest image alone
        rows = all_pairs(position, kwargs) if kept is None else kept.idx
        occupancy = int(finish(rows, 0 if own is not Dense else rows.shape[1])[1])
        most = {Dense: n - mask_self, Sparse: n * (n - mask_self), OrderedSparse: n * (n - 1) // 2}[own]
        extra = extra_capacity if own is Dense else n * extra_capacity
        room = max(min(int(occupancy * capacity_multiplier + extra), most), 0)
        if kept is not None and own is Dense and room > kept.capacity:
            kept = search(position, cutoff, capacity=room, **given)
            rows = kept.idx
        idx, held = finish(rows, room)
        error = PartitionError(jnp.where(held > room, 1, 0).astype(jnp.uint8))
        return NeighborList(idx, position, error, kept, held, room, _theirs(own, format), update)

    def update(position: Array, neighbors: NeighborList, **kwargs: Given) -> NeighborList:
        if "box" in kwargs and not fractional_coordinates:
            raise ValueError("a list takes box= only with fractional_coordinates=True: make the list with it.")
        position, kept, room = jnp.asarray(position), neighbors.kept, neighbors.max_occupancy
        fresh = neighbors
        if kept is None:
            away = jax.vmap(functools.partial(metric, **kwargs))(position, neighbors.reference_position)
            moved = jnp.asarray(skin == 0) | ~(away <= skin / 2).all()
            rows = functools.partial(all_pairs, position, kwargs)
        else:
            unknown = [name for name in kwargs if name != "box"]
            if unknown:
                raise TypeError(
                    f"update() knows the keyword box alone, got {', '.join(unknown)}: make the list with disable_cell_list=True."
                )
            new = kept.update(position, box=_box_like(kept.box, kwargs["box"]) if "box" in kwargs else None)
            moved = jnp.asarray(True) if skin == 0 else new.rebuild_count != kept.rebuild_count
            fresh = dataclasses.replace(neighbors, kept=new)
            rows = lambda: new.idx  # noqa: E731
        make = lambda: (*finish(rows(), room), position)  # noqa: E731
        keep = lambda: (neighbors.idx, neighbors.occupancy, neighbors.reference_position)  # noqa: E731
        idx, held, reference = make() if skin == 0 else lax.cond(moved, make, keep)
        code = neighbors.error.code | jnp.where(held > room, 1, 0).astype(jnp.uint8)
        if fresh.kept is not None:
            code = code | _code_of(fresh.kept.status)
        held = jnp.maximum(held, neighbors.occupancy)
        return dataclasses.replace(fresh, idx=idx, reference_position=reference, error=PartitionError(code), occupancy=held)

    return NeighborListFns(allocate, update)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborListMultiImage:
    """A list with all images of each pair, as jax-md reads it. A pytree.

    Attributes:
        idx: Dense: neighbors j, shape [n, max_occupancy]; else a tuple of particles i and neighbors j, [max_occupancy] each, int32.
            Unused places hold n. OrderedSparse holds of (i, j, S) and (j, i, -S) the one whose S has a positive number first, and
            of S = 0 the one with i < j.
        shifts: Whole numbers S [..., d], of the dtype of positions: pairs are r_j + S @ box.T - r_i apart.
        reference_position: Positions when the list was last rebuilt, shape [n, d].
        reference_box: The box at that time, shape [d, d].
        box: The present box, shape [d, d].
        did_buffer_overflow: Whether pairs are missing, for lack of room, because the box shrank, or because positions are not
            finite or too far away: allocate again, which raises what room cannot help. [] bool.
        kept: The list of jfrnn from which idx and shifts come.
        max_occupancy, format, update_fn: As in jax-md. Static.
    """

    idx: Array | tuple[Array, Array]
    shifts: Array
    reference_position: Array
    reference_box: Array
    box: Array
    did_buffer_overflow: Array
    kept: Kept
    max_occupancy: int = dataclasses.field(metadata={"static": True})
    format: Format = dataclasses.field(metadata={"static": True})
    update_fn: Callable[..., "NeighborListMultiImage"] = dataclasses.field(metadata={"static": True})

    def update(self, position: Array, **kwargs: Given) -> "NeighborListMultiImage":
        """Return the list at other positions [n, d], and with box= in another box."""
        return self.update_fn(position, self, **kwargs)

    @property
    def receivers(self) -> Array:
        """Particles i, of sparse formats."""
        return self._pairs("receivers")[0]

    @property
    def senders(self) -> Array:
        """Neighbors j, of sparse formats."""
        return self._pairs("senders")[1]

    def _pairs(self, name: str) -> tuple[Array, Array]:
        if isinstance(self.idx, tuple):
            return self.idx
        raise ValueError(f"{name} property not available for Dense format: read idx.")

    @property
    def n_node(self) -> int:
        """Number of particles."""
        return len(self.reference_position)

    @property
    def n_edges(self) -> int:
        """Number of pairs; waits for the device."""
        return int(((self.idx if isinstance(self.idx, Array) else self.idx[0]) < self.n_node).sum())

    @property
    def max_neighbors(self) -> int:
        """Places of each particle, of the dense format."""
        if isinstance(self.idx, tuple):
            raise ValueError("max_neighbors property only available for Dense format: read max_occupancy.")
        return self.max_occupancy


def neighbor_list_multi_image(
    displacement_or_metric: Given,
    box: Given,
    r_cutoff: Given,
    dr_threshold: Given = 0.0,
    capacity_multiplier: float = 1.25,
    pbc: Given = None,
    fractional_coordinates: bool = True,
    ordered: bool = False,
    format: Format = Sparse,
    **kwargs: Given,
) -> NeighborListFns:
    """Return functions that allocate and update a list with all images of pairs, as `neighbor_list_multi_image` of jax-md does.

    Args:
        displacement_or_metric: Not used.
        box: A matrix [d, d] whose columns are the lattice vectors [length], or edge lengths.
        r_cutoff: As in `neighbor_list`, and dr_threshold, capacity_multiplier and fractional_coordinates likewise.
        dr_threshold: As in `neighbor_list`.
        capacity_multiplier: As in `neighbor_list`.
        pbc: Which axes are periodic, [d] bools; default: all.
        fractional_coordinates: As in `neighbor_list`.
        ordered: As `format=OrderedSparse`.
        format: `Dense`, `Sparse` or `OrderedSparse`.
        **kwargs: Not used, as in jax-md.

    Returns:
        A `NeighborListFns`, the lists of which are `NeighborListMultiImage`; both functions take box=.

    Raises:
        ValueError, TypeError: an argument is of the wrong kind, shape or range.
    """
    own, cutoff, skin = NeighborListFormat[format.name], float(r_cutoff), float(dr_threshold)
    own = OrderedSparse if ordered and own is Sparse else own

    def box_of(box: Given, dim: int, like: Box | None = None) -> tuple[Array, Box]:
        matrix = jnp.asarray(box)
        matrix = jnp.eye(dim) * matrix if matrix.ndim < 2 else matrix
        vectors = matrix.T if isinstance(matrix, Tracer) or like is not None else np.asarray(matrix).T
        axes = like.periodic if like is not None else True if pbc is None else np.asarray(pbc).tolist()
        return matrix, Box(vectors, axes, fractional=fractional_coordinates)

    def finish(kept: Kept, position: Array, made: Box, room: int) -> tuple[Any, Array, Array]:
        n, whole = (
            len(position),
            dataclasses.replace(kept, status=jnp.zeros_like(kept.status)),
        )  # else it raises what the caller is told
        shifts = whole.shifts(position, box=made if kept.box is not None else None)
        used = kept.idx < n
        if own is OrderedSparse:
            i = jnp.arange(n, dtype=jnp.int32)[:, None]
            first, ahead = jnp.zeros(used.shape, bool), i < kept.idx
            for k in range(shifts.shape[-1]):  # the first number that is not 0 decides
                ahead = jnp.where(~first & (shifts[..., k] != 0), shifts[..., k] > 0, ahead)
                first = first | (shifts[..., k] != 0)
            used = used & ahead
        if own is Dense:
            more = ((0, 0), (0, max(room - kept.capacity, 0)))
            idx, shifts = jnp.pad(kept.idx, more, constant_values=n)[:, :room], jnp.pad(shifts, (*more, (0, 0)))[:, :room]
            return idx, shifts.astype(position.dtype), jnp.max(kept.count, initial=0)
        if 0 in used.shape:
            none = jnp.full(room, n, jnp.int32)
            return (none, none), jnp.zeros((room, shifts.shape[-1]), position.dtype), jnp.int32(0)
        flat = flatten(used, room)
        real_pair = flat.rows < n
        senders = jnp.where(real_pair, kept.idx.reshape(-1)[flat.slots], n)
        shifts = jnp.where(real_pair[:, None], shifts.reshape(used.size, -1)[flat.slots], 0)
        return (flat.rows, senders), shifts.astype(position.dtype), flat.offsets[-1]

    def allocate(position: Array, extra_capacity: int = 0, **given: Given) -> NeighborListMultiImage:
        position = jnp.asarray(position)
        n, dim = position.shape
        matrix, made = box_of(given.get("box", box), dim)
        kept = search(position, cutoff, box=made, skin=skin, slack=max(float(capacity_multiplier), 1.0))
        kept.check()
        occupancy = int(finish(kept, position, made, 1)[2])
        room = max(int(occupancy * capacity_multiplier) + extra_capacity * (1 if own is Dense else n), 1)
        if room > kept.capacity and own is Dense:
            kept = search(position, cutoff, box=made, skin=skin, capacity=room)
        idx, shifts, held = finish(kept, position, made, room)
        return NeighborListMultiImage(idx, shifts, position, matrix, matrix, held > room, kept, room, _theirs(own, format), update)

    def update(position: Array, neighbors: NeighborListMultiImage, **given: Given) -> NeighborListMultiImage:
        position, room = jnp.asarray(position), neighbors.max_occupancy
        matrix, made = box_of(given.get("box", neighbors.box), position.shape[1], neighbors.kept.box)
        kept = neighbors.kept.update(position, box=made if neighbors.kept.box is not None else None)
        idx, shifts, held = finish(kept, position, made, room)
        moved = jnp.asarray(True) if skin == 0 else kept.rebuild_count != neighbors.kept.rebuild_count
        reference = jnp.where(moved, position, neighbors.reference_position)
        reference_box = jnp.where(moved, matrix, neighbors.reference_box)
        overflow = neighbors.did_buffer_overflow | (held > room) | (kept.status != 0)
        return NeighborListMultiImage(idx, shifts, reference, reference_box, matrix, overflow, kept, room, neighbors.format, update)

    return NeighborListFns(allocate, update)


def _code_of(status: Array) -> Array:
    """Return the code of an error, uint8: every bit of a list sets one, and says that `allocate` is to be called.

    Where more room does not help, as with positions that are not finite, `allocate` raises what is wrong.
    """
    shrunk = (status & Status.BOX_TOO_SMALL.value) != 0
    others = (status & ~Status.BOX_TOO_SMALL.value) != 0
    codes = PartitionErrorCode.CELL_SIZE_TOO_SMALL, PartitionErrorCode.NEIGHBOR_LIST_OVERFLOW
    return jnp.where(shrunk, codes[0].value, 0).astype(jnp.uint8) | jnp.where(others, codes[1].value, 0).astype(jnp.uint8)


def _theirs(own: NeighborListFormat, given: Format) -> Format:
    """Return a format as jax-md has it, which compares by identity, if it has been imported."""
    partition = sys.modules.get("jax_md.partition")
    return given if partition is None else partition.NeighborListFormat[own.name]


def _as_metric(function: Distance) -> Distance:
    def metric(a: Array, b: Array, **kwargs: Given) -> Array:
        away = function(a, b, **kwargs)
        return away if away.ndim == 0 else _norm(away)

    return metric


def _norm(vector: Array) -> Array:
    """Return the length of a vector."""
    return jnp.sqrt(jnp.sum(vector**2))


def _matrix(box: Given, dim: int) -> np.ndarray:
    box = np.asarray(box, np.float64)
    return np.eye(dim) * box if box.ndim < 2 else box


def _kind_of(metric: Distance, box: Given, fractional: bool, position: Array, kwargs: dict[str, Given]) -> str | None:
    """Say whether a metric is that of free space, or of the nearest image in a box; None: of neither, or that is not known."""
    dim = position.shape[1]
    if dim not in (2, 3) or isinstance(box, Tracer) or set(kwargs) - {"box"}:
        return None
    matrix, rng = _matrix(box, dim), np.random.default_rng(0)
    a, b = (rng.uniform(-0.2, 1.2, (_PROBES, dim)) for _ in range(2))
    ends = [jnp.asarray(x if fractional else x @ matrix.T, position.dtype) for x in (a, b)]
    try:
        found = np.asarray(jax.vmap(functools.partial(metric, **kwargs))(*ends))
    except (TypeError, ValueError):
        return None
    away = a - b
    expected = {"free": away @ matrix.T, "periodic": (away - np.round(away)) @ matrix.T}
    for kind, vectors in expected.items():
        if np.allclose(found, np.linalg.norm(vectors, axis=1), rtol=1e-3, atol=1e-3 * np.abs(matrix).max()):
            return kind
    return None


def _box_of(box: Given, dim: int, periodic: bool, fractional: bool) -> Box:
    box = np.asarray(box)
    return Box(np.full(dim, box) if box.ndim == 0 else box if box.ndim == 1 else box.T, periodic, fractional=fractional)


def _box_like(made: Box | None, box: Given) -> Box | None:
    """Return the box of the moment in the form in which the list has it; in free space there is none, but for fractions."""
    if made is None:
        return None
    box, dim = jnp.asarray(box, made.vectors.dtype), made.dim
    if made.orthogonal and box.ndim == 2:
        raise ValueError(f"box must be a length or {dim} lengths, as when the list was allocated, got a matrix: allocate with one.")
    box = jnp.full(dim, box) if box.ndim == 0 else box
    vectors = box if made.orthogonal else jnp.diag(box) if box.ndim == 1 else box.T
    return Box(vectors, made.periodic, fractional=made.fractional)
