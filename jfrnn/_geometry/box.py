"""The public class `Box`: the periodic cell, given by edge lengths or by lattice vectors."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jfrnn._geometry.reduced import count_cells, short_vectors
from jfrnn._tracing import Given, Real, as_array, as_dtype, own_transfers, portable

_FLAT, _FLAT_ULPS = 1e-12, 16  # the square of a height beside edges of length 1, also in units of eps, that rounding leaves of none
_SINGULAR = 1e-9  # determinants below may be those of dependent rows
Numbers = Any  # an array of NumPy or JAX, concrete or traced


@portable
@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, init=False)
class Box:
    """A periodic box: space repeats along its lattice vectors. A pytree; lengths, vectors and origin may be traced.

    Attributes:
        vectors: Edge lengths [length], shape [d], or lattice vectors, one per row, shape [d, d]. With `per_system`, one such array
            per system of a batch, shape [systems, d] or [systems, d, d].
        origin: A corner of the cell [length], shape [d]; with `per_system` [systems, d].
        flags: Whether each axis of each system is periodic, shape [systems, d], bool; None: `periodic` says it for all.
        numbers: How many of each vector make up the short ones in which the search works, whole floats, shape [systems, d, d],
            where systems have vectors far longer than need be; None: the vectors are used as they are given.
        periodic: Whether each axis is periodic; all True if `flags` tell. Static.
        images: How many cells away a periodic image may lie and still be a neighbor, per axis; None: see `Box`. Static.
        per_system: Whether each system of a batch has a box of its own. Static.
        fractional: Whether positions count the lattice vectors. Static.
        images_of_list: The images of the list whose box this is (`nbrs.box`), which count where the vectors are traced. Static.

    >>> import jax.numpy as jnp, jfrnn
    >>> nbrs = jfrnn.search(jnp.array([[0.1, 0.5], [0.9, 0.5]]), 0.3, box=jfrnn.Box([1.0, 1.0]))
    >>> nbrs.count.tolist()
    [1, 1]
    """

    vectors: Numbers
    origin: Numbers
    flags: Numbers | None
    numbers: Numbers | None
    periodic: tuple[bool, ...]
    images: tuple[int, ...] | None
    per_system: bool
    fractional: bool
    images_of_list: tuple[int, ...] | None

    def __init__(
        self,
        lengths_or_matrix: Given,
        periodic: bool | Sequence[bool] | Given = True,
        origin: Given = 0.0,
        *,
        images: int | Sequence[int] | None = None,
        per_system: bool | None = None,
        fractional: bool = False,
    ) -> None:
        """Make a box from its edge lengths or from its lattice vectors, or one box for each system of a batch.

        Args:
            lengths_or_matrix: Edge lengths [length], shape [2] or [3], all > 0; or lattice vectors [length], one per row, shape [2,
                2] or [3, 3], of any handedness and skew. If skewed vectors are known while tracing, the search works in short
                vectors of the same lattice; shifts still count the given vectors. Rows of axes that are not periodic only need to
                be finite. Values are rounded once to the dtype of the positions. For a box per system: lengths of shape [systems,
                d] with `per_system=True`, or vectors of shape [systems, d, d]. If these are known when the box is made, those of
                systems that are skewed strongly are replaced by short ones, too; the box holds them as data, so that it may be an
                argument of a compiled function. Vectors that are traced are used as they are given.
            periodic: One bool for all axes, or one per axis (per row of the matrix); for a box per system also an array of bool,
                shape [systems, d], which may be traced.
            origin: A corner of the cell [length], a number or shape [d], or with a box per system [systems, d]. It changes no pair;
                a search is fastest if particles lie between origin and origin + vectors.
            images: How many cells away a periodic image may lie and still be a neighbor: a static int, or one per axis, as
                `images_for` counts them. Default: as many as the cutoff needs if the box is known while tracing. For a traced box
                the default is the minimum image alone (0), which needs a box at least 2.05 (cutoff + skin) wide along every
                periodic axis; a smaller box sets a status bit. For a box per system: as many as any system needs; a system is
                searched for its own alone. Where the box of a list (`nbrs.box`) is traced, it has the images of the list.
            per_system: Whether the first axis counts the systems of a batch, so that each has a box of its own. Default: whether
                there are three axes. Lengths [systems, d] need True, as they would else be lattice vectors.
            fractional: Whether positions, and queries, count the lattice vectors, along axes that are not periodic too: they lie at
                positions @ vectors, where `origin` adds nothing. Each component of this product is computed in twice the precision
                and rounded once to the dtype of the positions, the same on every device, and what a pair is is decided exactly on
                the result. All else is as it would be for such positions: cutoffs, skins, displacements and distances are lengths,
                shifts whole numbers that count from the positions as given. Derivatives in positions and vectors go through the
                product, whose own vectors are those of the box that a call is given.

        Raises:
            TypeError, ValueError: an argument is of the wrong kind, shape or range.
        """
        vectors = _real("lengths_or_matrix", lengths_or_matrix)
        many = vectors.ndim == 3 if per_system is None else per_system
        if not isinstance(many, bool | np.bool_):
            raise TypeError(f"per_system must be True, False or None, known while tracing, got {per_system!r}.")
        shape = vectors.shape[bool(many) :]
        if shape not in ((2,), (3,), (2, 2), (3, 3)) or vectors.ndim != len(shape) + bool(many) or 0 in vectors.shape:
            raise ValueError(
                f"lengths_or_matrix must have shape [d] (lengths) or [d, d] (lattice vectors) with d = 2 or 3, or [systems, d, d], "
                f"or with per_system=True [systems, d], got shape {list(vectors.shape)}"
                f"{': a cube is Box([length] * 3)' if vectors.ndim == 0 else ''}"
                f"{': lengths and angles are Box.from_parameters(lengths, angles)' if vectors.shape == (6,) else ''}."
            )
        dim, systems = shape[0], vectors.shape[: bool(many)]
        corner = _real("origin", origin)
        if corner.shape not in ((), (dim,), (*systems, dim)):
            wanted = f"[{dim}]{f' or {[*systems, dim]}' if many else ''}"
            raise ValueError(f"origin must be a number or have shape {wanted}, got shape {list(corner.shape)}.")
        flags = _flags_of_systems(periodic, (*systems, dim)) if many and np.ndim(periodic) == 2 else None
        axes = (True,) * dim if flags is not None else _per_axis("periodic", periodic, dim, (bool, np.bool_), "bool")
        reach = None if images is None else _per_axis("images", images, dim, (int, np.integer), "int >= 0", least=0)
        full = corner if corner.shape == (*systems, dim) else corner + np.zeros((*systems, dim), corner.dtype)
        if not isinstance(fractional, bool | np.bool_):
            raise TypeError(f"fractional must be True or False, known while tracing, got {fractional!r}.")
        self._set((vectors, full, flags, None), (axes, reach, bool(many), bool(fractional), None))
        with own_transfers():
            check_box_values(self)
            if many and not self.orthogonal and not any(isinstance(x, Tracer) for x in (vectors, flags)):
                known = np.broadcast_to(np.array(axes) if flags is None else np.asarray(flags), (*systems, dim))
                object.__setattr__(self, "numbers", short_vectors(np.asarray(vectors, np.float64), known))

    @classmethod
    def from_parameters(  # noqa: D417 (four arguments share a line)
        cls,
        lengths: Given,
        angles: Given,
        periodic: bool | Sequence[bool] | Given = True,
        origin: Given = 0.0,
        *,
        images: int | Sequence[int] | None = None,
        fractional: bool = False,
    ) -> "Box":
        """Make a box from the lengths of its lattice vectors and the angles between them.

        The first vector lies along x, the second in the plane of x and y with y > 0, the third, if there is one, has z > 0.

        Args:
            lengths: Of the vectors a, b and c [length], shape [3]; in 2D a and b, shape [2].
            angles: Between b and c, a and c, a and b [degree], shape [3]; in 2D between a and b, a number. 90 makes an exact 0.
            periodic, origin, images, fractional: As in `Box`.

        Returns:
            A `Box` with lattice vectors [d, d], lower triangular.

        Raises:
            TypeError, ValueError: an argument is of the wrong kind, shape or range, or no cell has such angles.

        >>> import jfrnn
        >>> jfrnn.Box.from_parameters([2.0, 3.0, 4.0], [90.0, 90.0, 90.0]).vectors.tolist()
        [[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]]
        """
        return cls(_cell_of(lengths, angles), periodic, origin, images=images, fractional=fractional)

    def _set(self, arrays: Iterable[Numbers], static: tuple[Any, ...]) -> None:
        for field, value in zip(dataclasses.fields(self), (*arrays, *static), strict=True):
            object.__setattr__(self, field.name, value)

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        """Return the arrays with their names, and the static fields."""
        arrays = {"vectors": self.vectors, "origin": self.origin, "flags": self.flags, "numbers": self.numbers}
        return tuple((jax.tree_util.GetAttrKey(name), x) for name, x in arrays.items()), self.kind

    @classmethod
    def tree_unflatten(cls, static: tuple[Any, ...], arrays: Iterable[Numbers]) -> "Box":
        """Make a box from its parts without checking them again."""
        box = object.__new__(cls)
        box._set(arrays, static)
        return box

    def images_for(self, cutoff: float) -> tuple[int, ...]:
        """Return how many cells away a neighbor may lie along each axis, as `images` takes it; 0: the minimum image suffices.

        Args:
            cutoff: Interaction radius [length]; of a list with a skin, cutoff + skin; the largest one where cutoffs differ.

        Raises:
            TypeError: the box is traced, or cutoff is not a number.
            ValueError: cutoff is not positive and finite, or the box is degenerate.

        >>> import jfrnn
        >>> jfrnn.Box([10.0, 10.0, 3.0]).images_for(4.0), jfrnn.Box([10.0, 10.0, 10.0]).images_for(4.0)
        ((1, 1, 2), (0, 0, 0))
        """
        if isinstance(self.vectors, Tracer) or isinstance(self.flags, Tracer):
            raise TypeError("images_for() reads the vectors of a box, and these are traced: ask outside of jax.jit.")
        if isinstance(cutoff, Tracer | bool) or not isinstance(cutoff, Real):
            raise TypeError(f"cutoff must be a number, got {type(cutoff).__name__}.")
        if not 0 < cutoff < math.inf:
            raise ValueError(f"cutoff must be positive and finite, got {cutoff}.")
        single = np.dtype(np.float32)  # which needs as many as float64, or more
        with own_transfers():
            check_box_values(self)
            flags = np.array(self.periodic) if self.flags is None else np.asarray(self.flags)
            radius = float(np.nextafter(np.float32(cutoff), np.float32(np.inf)))
            reach, nearest = count_cells(searched_vectors(self, single), flags, self.orthogonal, radius, single)
        return (0,) * self.dim if nearest else reach

    def of_list(self, images: tuple[int, ...] | None, like: "Box | None" = None) -> "Box":
        """Return this box as that of a list with so many images, whose shifts count the short vectors of `like`, a box before."""
        arrays = self.vectors, self.origin, self.flags, self.numbers if like is None else like.numbers
        return Box.tree_unflatten((self.periodic, None, self.per_system, self.fractional, images), arrays)

    @property
    def kind(self) -> tuple[tuple[bool, ...], tuple[int, ...] | None, bool, bool, tuple[int, ...] | None]:
        """The static fields."""
        return self.periodic, self.images, self.per_system, self.fractional, self.images_of_list

    @property
    def dim(self) -> int:
        """Number of axes, 2 or 3."""
        return len(self.periodic)

    @property
    def orthogonal(self) -> bool:
        """Whether the box was given by lengths."""
        return np.ndim(self.vectors) == 1 + self.per_system


def _cell_of(lengths: Given, angles: Given) -> Numbers:
    """Return the lattice vectors of a cell with these lengths and angles [degree], one per row; traced if one of both is."""
    sizes, between = _real("lengths", lengths), _real("angles", angles)
    if sizes.shape not in ((2,), (3,)) or between.shape not in {(2,): ((), (1,)), (3,): ((3,),)}[sizes.shape]:
        raise ValueError(
            f"lengths and angles must have shape [3] each, or lengths [2] and angles [] in 2D, got {list(sizes.shape)} and "
            f"{list(between.shape)}."
        )
    xp = jnp if isinstance(sizes, Tracer) or isinstance(between, Tracer) else np
    if xp is np and not (np.isfinite(sizes).all() and (sizes > 0).all() and (between > 0).all() and (between < 180).all()):
        raise ValueError(f"lengths must be positive, and angles lie between 0 and 180 degrees, got {lengths} and {angles}.")
    between = between.reshape(-1)
    cosines = xp.where(between == 90, 0, xp.cos(xp.deg2rad(between))).astype(between.dtype)
    gamma, nothing = cosines[-1], xp.zeros((), between.dtype)
    height = xp.sqrt(1 - gamma**2)
    if sizes.shape == (2,):
        rows = [[1 + nothing, nothing], [gamma, height]]
    else:
        along = (cosines[0] - cosines[1] * gamma) / height
        square = 1 - cosines[1] ** 2 - along**2
        if xp is np and not square > max(_FLAT, _FLAT_ULPS * np.finfo(square.dtype).eps):
            raise ValueError(f"angles must be those of a cell, each less than the sum of the others, got {angles}.")
        rows = [[1 + nothing, nothing, nothing], [gamma, height, nothing], [cosines[1], along, xp.sqrt(square)]]
    return xp.stack([xp.stack(row) for row in rows]).astype(sizes.dtype) * sizes[:, None]


def _flags_of_systems(periodic: Given, shape: tuple[int, ...]) -> Numbers:
    """Return which axes of each system are periodic: a traced array unchanged, everything else as a new NumPy array."""
    flags = periodic if isinstance(periodic, Tracer) else np.array(periodic)
    if flags.dtype != np.bool_ or flags.shape != shape:
        raise ValueError(
            f"periodic must be one bool, one per axis, or an array of bool of shape {list(shape)}, got {flags.dtype} of shape "
            f"{list(flags.shape)}."
        )
    return flags


def _real(name: str, value: Given) -> Numbers:
    """Return floats: a traced array unchanged, everything else as a new NumPy array."""
    if isinstance(value, Tracer):
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise TypeError(f"{name} must be real numbers, got a traced {value.dtype}.")
        return value
    array = np.asarray(value if isinstance(value, list | tuple) else as_array(name, value))
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


def check_box_values(box: Box) -> None:
    """Raise if known values are not those of a box, or of one per system."""
    given = box.vectors, box.origin, box.periodic if box.flags is None else box.flags
    vectors, origin, flags = (x if isinstance(x, Tracer) else np.asarray(x) for x in given)
    for name, value in (("lengths_or_matrix", vectors), ("origin", origin)):
        if not isinstance(value, Tracer) and not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, got {_tell_bad(value, ~np.isfinite(value), box)}.")
    if isinstance(vectors, Tracer) or isinstance(flags, Tracer):
        return
    if box.orthogonal:
        if (bad := (vectors <= 0) & flags).any():
            told = _tell_bad(vectors, bad, box)
            raise ValueError(f"lengths of periodic axes must be positive, got {told}; give a matrix for other handedness.")
        return
    rows = np.where(flags[..., None], vectors.astype(np.float64), 0)
    size = np.abs(rows).max(axis=-1, keepdims=True)
    scaled = rows / np.where(size > 0, size, 1)
    if flags.all() and (np.abs(np.linalg.det(scaled)) > _SINGULAR).all():  # ranks take ten times as long
        return
    bad = np.linalg.matrix_rank(scaled) < flags.sum(axis=-1)
    if bad.any():
        raise ValueError(f"periodic lattice vectors must be linearly independent, got the rows {_tell_bad(vectors, bad, box)}.")


def check_box_range(box: Box, dtype: np.dtype) -> None:
    """Raise if known values overflow in the dtype of positions, or the reciprocal of an edge does."""
    most = float(np.finfo(dtype).max) / 8
    for name, value in (("lengths_or_matrix", box.vectors), ("origin", box.origin)):
        if isinstance(value, np.ndarray) and (bad := np.abs(value) > most).any():
            told = _tell_bad(value, bad, box)
            raise ValueError(
                f"{name} must not exceed {most:.2g}, as positions are {dtype}, got {told}: choose another unit of length."
            )


def _tell_bad(values: np.ndarray, bad: np.ndarray, box: Box) -> str:
    """Return values as text; with a box per system those of the first bad one."""
    if not box.per_system:
        return str(values.tolist())
    first = int(np.argmax(bad.reshape(len(bad), -1).any(axis=1)))
    return f"{values[first].tolist()} in system {first}"


def searched_vectors(box: Box, dtype: np.dtype) -> np.ndarray:
    """Return the vectors of a box as rounded to a dtype or, with short ones of each system, those, in float64."""
    vectors = np.asarray(box.vectors, dtype).astype(np.float64)
    return vectors if box.numbers is None else np.asarray(box.numbers, np.float64) @ vectors


def round_box(box: Box, dtype: np.dtype) -> Box:
    """Return a box with its arrays rounded to a dtype."""
    with own_transfers():
        given = ((box.vectors, dtype), (box.origin, dtype), (box.flags, np.dtype(bool)), (box.numbers, dtype))
        return Box.tree_unflatten(box.kind, [None if x is None else as_dtype(x, kind) for x, kind in given])
