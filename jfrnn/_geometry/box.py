"""The public `Box`: along which lattice vectors space repeats itself."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jfrnn._tracing import Given, own_transfers

Numbers = Any  # an array of NumPy or of JAX, traced or not


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, init=False)
class Box:
    """Say along which lattice vectors space repeats itself. A pytree; lengths, vectors and origin may be traced.

    Attributes:
        vectors: Lengths of the edges [length], shape [d], or lattice vectors, one per row, shape [d, d].
        origin: A corner of the cell [length], shape [d].
        periodic: For each axis, whether space repeats itself along it. Static.
        images: For each axis, over how many cells to either side a pair may reach; None: see `Box`. Static.
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
        """Make a box from the lengths of its edges or from its lattice vectors.

        Args:
            lengths_or_matrix: Lengths [length], shape [2] or [3], all > 0, of edges along the axes; or lattice vectors [length],
                one per row, shape [2, 2] or [3, 3], of any handedness and skew (where they are known while tracing, short ones of
                the same lattice are found; shifts count the given ones). Along an axis that is not periodic nothing but
                finite numbers is asked of them. Rounded once to the dtype of the positions.
            periodic: One bool for all axes, or one per axis (per row of the matrix).
            origin: A corner of the cell [length], a number or shape [d]. It changes no pair; a search is fastest where particles
                lie between origin and origin + vectors.
            images: Over how many cells to either side a pair may reach, a static int or one per axis. Default: as many as the
                cutoff needs where the box is known while tracing; where it is traced, nothing but the nearest image of a particle
                is looked at, which needs a box at least 2.05 (cutoff + skin) wide along every periodic axis. A box that
                is too small for that sets a status bit.

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
        """Return the arrays with their names, and what is static."""
        keys = (jax.tree_util.GetAttrKey("vectors"), jax.tree_util.GetAttrKey("origin"))
        return tuple(zip(keys, (self.vectors, self.origin), strict=True)), (self.periodic, self.images)

    @classmethod
    def tree_unflatten(cls, static: tuple[tuple[bool, ...], tuple[int, ...] | None], arrays: Iterable[Numbers]) -> "Box":
        """Make a box of arrays that nobody checks again."""
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
    """Return floats, a traced array as it is and everything else as a NumPy array of its own."""
    if isinstance(value, Tracer):
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise TypeError(f"{name} must be real numbers, got a traced {value.dtype}.")
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {type(value).__name__} {value!r}.")
    return array.astype(array.dtype if array.dtype in (np.float32, np.float64) else np.float64)  # a copy, whoever changes the other


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
    """Round a box to a dtype; what is left of it are its arrays and its periodic axes."""
    with own_transfers():
        return Box.tree_unflatten((box.periodic, None), tuple(jnp.asarray(x).astype(dtype) for x in (box.vectors, box.origin)))
