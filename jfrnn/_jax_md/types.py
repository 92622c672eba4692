"""The types of jax-md's neighbor lists where jax-md is not installed. Where it is, its own are used and these are not read."""

import dataclasses
import enum
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax import Array

static = {"static": True}


class NeighborListFormat(enum.Enum):
    """What `idx` holds: rows of neighbors, or pairs (j, i), or those of them with j < i."""

    Dense = 0
    Sparse = 1
    OrderedSparse = 2


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
    """What went wrong in a list and all updates that led to it: `code`, bits of `PartitionErrorCode`, [] uint8."""

    code: Array


class _List:
    update_fn: Callable[..., Any]

    def update(self, position: Array, **kwargs: Any) -> Any:  # noqa: ANN401
        """Return the list at other positions [n, d]; jit and scan may call it."""
        return self.update_fn(position, self, **kwargs)

    def set(self, **fields: Any) -> Any:  # noqa: ANN401
        """Return a copy with other values of some fields."""
        return dataclasses.replace(self, **fields)  # pyright: ignore[reportArgumentType]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborList(_List):
    """The fields of `jax_md.partition.NeighborList`, in its order."""

    idx: Array
    reference_position: Array
    error: PartitionError
    cell_list_capacity: int | None = dataclasses.field(metadata=static)
    max_occupancy: int = dataclasses.field(metadata=static)
    format: NeighborListFormat = dataclasses.field(metadata=static)
    cell_size: float | None = dataclasses.field(metadata=static)
    cell_list_fn: Any = dataclasses.field(metadata=static)
    update_fn: Callable[..., Any] = dataclasses.field(metadata=static)

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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class NeighborListMultiImage(_List):
    """The fields of `jax_md.custom_partition.NeighborListMultiImage`, in its order."""

    idx: Any
    shifts: Array
    reference_position: Array
    reference_box: Array
    box: Array
    search_shifts: Array | None
    format: NeighborListFormat = dataclasses.field(metadata=static)
    max_occupancy: int = dataclasses.field(metadata=static)
    update_fn: Callable[..., Any] = dataclasses.field(metadata=static)
    did_buffer_overflow: Any = False

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
        return int(((self.idx[0] if isinstance(self.idx, tuple) else self.idx) < self.n_node).sum())


@dataclasses.dataclass(frozen=True)
class NeighborListFns:
    """Functions that make lists: allocate(position, extra_capacity=0, **kwargs) and update(position, neighbors, **kwargs)."""

    allocate: Callable[..., Any]
    update: Callable[..., Any]

    def __iter__(self) -> Iterator[Callable[..., Any]]:
        """Return both, for `allocate, update = fns`."""
        return iter((self.allocate, self.update))


NeighborListMultiImageFns = NeighborListFns
