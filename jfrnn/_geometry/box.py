"""The public class `Box`: the periodic cell, given by edge lengths or by lattice vectors."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jfrnn._tracing import Given, own_transfers

Numbers = Any  # an array of NumPy or JAX, concrete or traced


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, init=False)
class Box:
    """A periodic box: space repeats along its lattice vectors. A pytree; lengths, vectors and origin may be traced.

    Attributes:
        vectors: Edge lengths [length], shape [d], or lattice vectors, one per row, shape [d, d].
        origin: A corner of the cell [length], shape [d].
        periodic: Whether each axis is periodic. Static.
        images: How many cells away a periodic image may lie and still be a neighbor, per axis; None: see `Box`. Static.
    """

    vectors: Numbers
    origin: Numbers
    periodic: tuple[bool, ...]
    images: tuple[int, ...] | None

    def __init__(
        self,
        lengths_or_matrix: Given,
        periodic: bool | Sequence[bool] = True,
        origin: Given = 0.0,
        *,
        images: int | Sequence[int] | None = None,
    ) -> None:
        """Make a box from its edge lengths or from its lattice vectors.

        Args:
            lengths_or_matrix: Edge lengths [length], shape [2] or [3], all > 0; or lattice vectors [length], one per row, shape [2,
                2] or [3, 3], of any handedness and skew. If skewed vectors are known while tracing, the search works in short
                vectors of the same lattice; shifts still count the given vectors. Rows of axes that are not periodic only need to
                be finite. Values are rounded once to the dtype of the positions.
            periodic: One bool for all axes, or one per axis (per row of the matrix).
            origin: A corner of the cell [length], a number or shape [d]. It changes no pair; a search is fastest if particles lie
                between origin and origin + vectors.
            images: How many cells away a periodic image may lie and still be a neighbor: a static int, or one per axis. Default: as
                many as the cutoff needs if the box is known while tracing. For a traced box the default is the minimum image alone,
                which needs a box at least 2.05 (cutoff + skin) wide along every periodic axis; a smaller box sets a status bit.

        Raises:
            TypeError, ValueError: an argument is of the wrong kind, shape or range.
        """
        vectors = _real("lengths_or_matrix", lengths_or_matrix)
        if vectors.shape not in ((2,), (3,), (2, 2), (3, 3)):
            raise ValueError(
                f"lengths_or_matrix must have shape [d] (lengths) or [d, d] (lattice vectors) with d = 2 or 3, got shape "
                f"{list(vectors.shape)}."
            )
        dim = vectors.shape[0]
        corner = _real("origin", origin)
        if corner.shape not in ((), (dim,)):
            raise ValueError(f"origin must be a number or have shape [{dim}], got shape {list(corner.shape)}.")
        flags = _per_axis("periodic", periodic, dim, (bool, np.bool_), "bool")
        reach = None if images is None else _per_axis("images", images, dim, (int, np.integer), "int >= 0", least=0)
        with own_transfers():
            check_box_values(vectors, corner, flags)
        self._set(vectors, corner if corner.shape else corner + np.zeros(dim, corner.dtype), flags, reach)

    def _set(self, vectors: Numbers, origin: Numbers, periodic: tuple[bool, ...], images: tuple[int, ...] | None) -> None:
        for name, value in (("vectors", vectors), ("origin", origin), ("periodic", periodic), ("images", images)):
            object.__setattr__(self, name, value)

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        """Return the arrays with their names, and the static fields."""
        keys = (jax.tree_util.GetAttrKey("vectors"), jax.tree_util.GetAttrKey("origin"))
        return tuple(zip(keys, (self.vectors, self.origin), strict=True)), (self.periodic, self.images)

    @classmethod
    def tree_unflatten(cls, static: tuple[tuple[bool, ...], tuple[int, ...] | None], arrays: Iterable[Numbers]) -> "Box":
        """Make a box from its parts without checking them again."""
        box = object.__new__(cls)
        vectors, origin = arrays
        box._set(vectors, origin, *static)
        return box

    @property
    def dim(self) -> int:
        """Number of axes, 2 or 3."""
        return len(self.periodic)

    @property
    def orthogonal(self) -> bool:
        """Whether the box was given by lengths."""
        return np.ndim(self.vectors) == 1


def _real(name: str, value: Given) -> Numbers:
    """Return floats: a traced array unchanged, everything else as a new NumPy array."""
    if isinstance(value, Tracer):
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise TypeError(f"{name} must be real numbers, got a traced {value.dtype}.")
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {type(value).__name__} {value!r}.")
    return array.astype(array.dtype if array.dtype in (np.float32, np.float64) else np.float64)  # a copy of the user's array


def _per_axis(name: str, value: Given, dim: int, kinds: tuple[type, ...], what: str, least: int | None = None) -> tuple[Any, ...]:
    values = tuple(value) if isinstance(value, Sequence | np.ndarray) else (value,) * dim
    right = all(isinstance(v, kinds) and (least is None or (not isinstance(v, bool) and v >= least)) for v in values)
    if not right:
        raise TypeError(f"{name} must be one {what} or one per axis, known while tracing, got {value!r}.")
    if len(values) != dim:
        raise ValueError(f"{name} must be one {what} or one per axis ({dim}), got {len(values)}.")
    return tuple(v.item() if isinstance(v, np.generic) else v for v in values)


def check_box_values(vectors: Numbers, origin: Numbers, periodic: tuple[bool, ...]) -> None:
    for name, value in (("lengths_or_matrix", vectors), ("origin", origin)):
        if not isinstance(value, Tracer) and not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, got {value.tolist()}.")
    if isinstance(vectors, Tracer):
        return
    if vectors.ndim == 1 and not (vectors[list(periodic)] > 0).all():
        raise ValueError(f"lengths of periodic axes must be positive, got {vectors.tolist()}; give a matrix for other handedness.")
    if vectors.ndim == 2 and any(periodic):
        rows = vectors[list(periodic)].astype(np.float64)
        size = np.abs(rows).max(axis=1, keepdims=True)
        if not size.all() or np.linalg.matrix_rank(rows / size) < len(rows):
            raise ValueError(f"periodic lattice vectors must be linearly independent, got the rows {vectors.tolist()}.")


def round_box(box: Box, dtype: np.dtype) -> Box:
    """Return a box with its arrays rounded to a dtype; it keeps which axes are periodic, but not `images`."""
    with own_transfers():
        return Box.tree_unflatten((box.periodic, None), tuple(jnp.asarray(x).astype(dtype) for x in (box.vectors, box.origin)))
