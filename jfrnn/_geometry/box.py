"""Periodic boxes: the public `Box`, and the `Lattice` that engines work with.

A pair of images (i, j, S) is a pair iff |x_j - x_i + S·A| < cutoff, where the rows A_k of A are the lattice vectors and S is a
vector of integers, 0 along axes that are not periodic. Nothing is decided on wrapped coordinates: wrapping only brings particles
into one cell of the lattice, so that few images need be looked at. What rounding can do there is bounded by `Wrapped.slack`
(coordinates) and `Wrapped.reach` (cells), and whatever lies within those bounds of the cutoff is decided on the given floats.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._geometry.exact import Shifted, combined
from jfrnn._geometry.reduced import Basis, reduced_basis
from jfrnn._tracing import leading_axes, own_transfers

_NEAREST = 0.49  # cutoff over width up to which the nearest image is the only one, with room for rounding
_MANY_IMAGES = 2**15 - 1  # from which on shorter lattice vectors are looked for
_MOST_IMAGES = 2**22  # of which tables take 100 MB
_MOST_VECTORS = 2**23  # of the given ones in a shift: float32 says whole numbers below 2^24 exactly


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

    vectors: Any
    origin: Any
    periodic: tuple[bool, ...]
    images: tuple[int, ...] | None

    def __init__(
        self,
        lengths_or_matrix: Any,  # noqa: ANN401
        periodic: bool | Sequence[bool] = True,
        origin: Any = 0.0,  # noqa: ANN401
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
            _check_values(vectors, corner, flags)
        self._set(vectors, corner if corner.shape else corner + np.zeros(dim, corner.dtype), flags, reach)

    def _set(self, vectors: Any, origin: Any, periodic: tuple[bool, ...], images: tuple[int, ...] | None) -> None:  # noqa: ANN401
        for name, value in (("vectors", vectors), ("origin", origin), ("periodic", periodic), ("images", images)):
            object.__setattr__(self, name, value)

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        """Return the arrays with their names, and what is static."""
        keys = (jax.tree_util.GetAttrKey("vectors"), jax.tree_util.GetAttrKey("origin"))
        return tuple(zip(keys, (self.vectors, self.origin), strict=True)), (self.periodic, self.images)

    @classmethod
    def tree_unflatten(cls, static: Any, arrays: Any) -> "Box":  # noqa: ANN401
        """Make a box of arrays that nobody checks again."""
        box = object.__new__(cls)
        box._set(*arrays, *static)
        return box

    @property
    def dim(self) -> int:
        """Number of axes, 2 or 3."""
        return len(self.periodic)

    @property
    def orthogonal(self) -> bool:
        """Whether the box was given by lengths."""
        return np.ndim(self.vectors) == 1


def _real(name: str, value: Any) -> Any:  # noqa: ANN401
    """Return floats, a traced array as it is and everything else as a NumPy array of its own."""
    if isinstance(value, Tracer):
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise TypeError(f"{name} must be real numbers, got a traced {value.dtype}.")
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {type(value).__name__} {value!r}.")
    return array.astype(array.dtype if array.dtype in (np.float32, np.float64) else np.float64)  # a copy, whoever changes the other


def _per_axis(name: str, value: Any, dim: int, kinds: tuple[type, ...], what: str, least: int | None = None) -> tuple[Any, ...]:  # noqa: ANN401
    values = tuple(value) if isinstance(value, Sequence | np.ndarray) else (value,) * dim
    right = all(isinstance(v, kinds) and (least is None or (not isinstance(v, bool) and v >= least)) for v in values)
    if not right:
        raise TypeError(f"{name} must be one {what} or one per axis, known while tracing, got {value!r}.")
    if len(values) != dim:
        raise ValueError(f"{name} must be one {what} or one per axis ({dim}), got {len(values)}.")
    return tuple(v.item() if isinstance(v, np.generic) else v for v in values)


def _check_values(vectors: Any, origin: Any, periodic: tuple[bool, ...]) -> None:  # noqa: ANN401
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


def fixed_box(box: Box, dtype: np.dtype) -> Box:
    """Round a box to a dtype; what is left of it are its arrays and its periodic axes."""
    with own_transfers():
        return Box.tree_unflatten((box.periodic, None), tuple(jnp.asarray(x).astype(dtype) for x in (box.vectors, box.origin)))


# --- what is static about the images -------------------------------------------------------------------------------------


class Images(NamedTuple):
    """How the images of a search are told apart; static.

    Attributes:
        periodic: One bool per axis.
        orthogonal: Lattice vectors lie along the axes.
        reach: Over how many cells to either side a pair may reach, per axis; 0 along axes that are not periodic.
        nearest: No pair has more than one image within the cutoff, the nearest one: no image need be stored.
        basis: Of which whole numbers of the given lattice vectors those consist that shifts count; None: of themselves.
    """

    periodic: tuple[bool, ...]
    orthogonal: bool
    reach: tuple[int, ...]
    nearest: bool
    basis: Basis | None = None

    @property
    def shifts(self) -> np.ndarray:
        """All lattice shifts within reach, shape [images, d], int32; the row number is the code of the image."""
        axes = np.meshgrid(*(np.arange(-k, k + 1, dtype=np.int32) for k in self.reach), indexing="ij")
        return np.stack(axes, axis=-1).reshape(-1, len(self.reach))

    @property
    def numbers(self) -> np.ndarray:
        """The basis, shape [d, d], int64."""
        return np.eye(len(self.reach), dtype=np.int64) if self.basis is None else np.array(self.basis)

    @property
    def total(self) -> int:
        """Number of shifts within reach."""
        return math.prod(2 * k + 1 for k in self.reach)

    @property
    def home(self) -> int:
        """The code of the shift 0."""
        return (self.total - 1) // 2

    @property
    def dtype(self) -> np.dtype:
        """Of the codes in a list: 1 B up to 256 of them, 2 B up to 32 768."""
        return np.dtype(np.uint8 if self.total <= 256 else np.int16 if self.total <= 2**15 else np.int32)


def images_of(box: Box, radius: float | None, dtype: np.dtype, sources: int) -> Images:
    """Choose which images a search with this radius, the largest one, looks at; None: it is known only from data.

    Raises:
        ValueError: the cutoff spans more images than can be told apart.
    """
    if box.images is None and radius is not None and not isinstance(box.vectors, Tracer):
        with own_transfers():
            vectors = np.asarray(box.vectors, dtype).astype(np.float64)
        images = _needed_images(vectors, box, radius, None)
        if not box.orthogonal and _too_many(images, sources, _MANY_IMAGES):
            basis, short = reduced_basis(vectors, box.periodic)
            reduced = _needed_images(short, box, radius, basis)
            images = reduced if reduced.total < images.total and _are_exact(reduced) else images
        return checked_images(images, sources)
    wanted = (0,) * box.dim if box.images is None else box.images
    nearest = not any(k for k, p in zip(wanted, box.periodic, strict=True) if p)
    reach = tuple(max(k, 1) if p else 0 for k, p in zip(wanted, box.periodic, strict=True))
    return checked_images(Images(box.periodic, box.orthogonal, reach, nearest), sources)


def _needed_images(vectors: np.ndarray, box: Box, radius: float, basis: Basis | None) -> Images:
    """Return the images that a radius needs in a lattice of these vectors."""
    share = radius / _widths(vectors, box.periodic)
    # room for the rounding of coordinates: far fewer than a hundredth of a cell
    reach = tuple(math.ceil(s + 0.01) if p else 0 for s, p in zip(share.tolist(), box.periodic, strict=True))
    return Images(box.periodic, box.orthogonal, reach, bool((share <= _NEAREST).all()), basis)


def _too_many(images: Images, sources: int, most: int) -> bool:
    return images.total > most or (not images.nearest and sources * images.total >= 2**31)


def _are_exact(images: Images) -> bool:
    """Say whether shifts in the given vectors are whole numbers that every dtype holds."""
    return (2 * LARGEST_TURN + max(images.reach)) * np.abs(images.numbers).sum(axis=0).max() <= _MOST_VECTORS


def checked_images(images: Images, sources: int) -> Images:
    """Return images of which there are not too many.

    Raises:
        ValueError: there are more images than can be told apart.
    """
    if images.total > _MOST_IMAGES:
        raise ValueError(
            f"box is too small for this cutoff: pairs reach over {images.reach} cells along the axes, {images.total} images, "
            f"whose tables take {24 * images.total // 10**6} MB; {_MOST_IMAGES} have room, {24 * _MOST_IMAGES // 10**6} MB. "
            "Replicate the particles into a larger box, or give short lattice vectors."
        )
    if not images.nearest and sources * images.total >= 2**31:
        raise ValueError(
            f"box is too small for its particles: {sources} of them with {images.total} images each are more than int32 can number."
        )
    return images


def grown_images(kind: Images, boxes: Sequence[Box], radius: float | None, dtype: np.dtype, sources: int, short: bool) -> Images:
    """Choose the images of a list that is made again: those that it has, and those that this radius needs in each of these boxes.

    `short`: a search met a box that needs more of them. Where none of these boxes does, it was another: then twice as many.

    Raises:
        ValueError: a box is none, or too small for this radius.
    """
    for box in boxes:
        _check_values(np.asarray(box.vectors), np.asarray(box.origin), box.periodic)
    kinds = [kind, *(images_of(box, radius, dtype, sources) for box in boxes)]
    if len({k.basis for k in kinds}) > 1:  # numbers of images can be compared in one basis only: that of the last box
        kinds = [_in_basis(box, radius, dtype, kinds[-1]) for box in boxes]
        kind = Images(kind.periodic, kind.orthogonal, kinds[-1].reach, kinds[-1].nearest, kinds[-1].basis)
    reach, nearest = tuple(map(max, *(k.reach for k in kinds), kind.reach)), all(k.nearest for k in kinds)
    if short and (reach, nearest) == (kind.reach, kind.nearest):
        reach, nearest = reach if nearest else tuple(2 * k for k in reach), False
    return checked_images(kind._replace(reach=reach, nearest=nearest), sources)


def _in_basis(box: Box, radius: float | None, dtype: np.dtype, like: Images) -> Images:
    if radius is None:
        return like
    vectors = np.asarray(box.vectors, dtype).astype(np.float64)
    return _needed_images(like.numbers @ vectors, box, radius, like.basis)


def _widths(vectors: np.ndarray, periodic: tuple[bool, ...]) -> np.ndarray:
    """Return the distances of opposite faces [d], infinite along axes that are not periodic."""
    rows = np.diag(vectors) if vectors.ndim == 1 else vectors
    widths = np.full(len(rows), np.inf)
    span = rows[list(periodic)]
    widths[list(periodic)] = 1 / np.linalg.norm(np.linalg.pinv(span), axis=0)
    return widths


# --- what a compiled program computes ------------------------------------------------------------------------------------


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lattice:
    """A box in the dtype of the positions, ready to wrap them.

    Attributes:
        matrix: [d, d] lattice vectors, one per row; rows of axes that are not periodic are 0. Short ones, and rounded, where the
            images have a basis.
        given: [d, d] those that were given: what is exact is said in them.
        transform: [d, d]; (x - origin) @ transform are fractions of the lattice vectors along periodic axes, lengths along others.
        origin: [d].
        images: Static.
    """

    matrix: Array
    given: Array
    transform: Array
    origin: Array
    images: Images = dataclasses.field(metadata={"static": True})

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.images.periodic)


def make_lattice(box: Box, images: Images, dtype: np.dtype) -> Lattice:
    """Round a box to a dtype, once, and find its transform."""
    vectors, origin = jnp.asarray(box.vectors).astype(dtype), jnp.asarray(box.origin).astype(dtype)
    rows = jnp.diag(vectors) if box.orthogonal else vectors
    flags = np.array(box.periodic)
    given = matrix = jnp.where(flags[:, None], rows, 0)
    if box.orthogonal:
        lengths = jnp.where(flags, vectors, 1)
        return Lattice(matrix, given, jnp.diag(1 / lengths), origin, images)
    if images.basis is not None:
        matrix = combined(images.basis, given)
    return Lattice(matrix, given, _inverse(_completed(matrix, box.periodic)), origin, images)


def _completed(matrix: Array, periodic: tuple[bool, ...]) -> Array:
    """Replace the rows of axes that are not periodic by unit vectors normal to all that are, and to each other."""
    dim, free = len(periodic), [k for k, p in enumerate(periodic) if not p]
    rows = [matrix[k] / jnp.max(jnp.abs(matrix[k])) if p else matrix[k] for k, p in enumerate(periodic)]
    spans = [rows[k] for k, p in enumerate(periodic) if p]
    if len(free) == dim:
        normals = list(jnp.eye(dim, dtype=matrix.dtype))
    elif dim == 2:
        normals = [jnp.stack([-spans[0][1], spans[0][0]])] if free else []
    elif len(free) == 1:
        normals = [jnp.cross(spans[0], spans[1])]
    elif len(free) == 2:
        least = jnp.eye(3, dtype=matrix.dtype)[jnp.argmin(jnp.abs(spans[0]))]
        first = jnp.cross(spans[0], least)
        normals = [first, jnp.cross(spans[0], first)]
    else:
        normals = []
    result = list(matrix)
    for k, normal in zip(free, normals, strict=True):
        result[k] = normal / jnp.sqrt(jnp.sum(normal**2))
    return jnp.stack(result)


def _inverse(matrix: Array) -> Array:
    """Invert a [d, d] matrix by cofactors of its scaled rows, then once by Newton's step."""
    size = jnp.max(jnp.abs(matrix), axis=1, keepdims=True)
    rows = matrix / size
    if len(matrix) == 2:
        adjugate = jnp.stack([jnp.stack([rows[1, 1], -rows[0, 1]]), jnp.stack([-rows[1, 0], rows[0, 0]])])
    else:
        adjugate = jnp.stack([jnp.cross(rows[k - 2], rows[k - 1]) for k in range(3)], axis=1)
    inverse = adjugate / jnp.sum(rows[0] * adjugate[:, 0])
    inverse = inverse @ (2 * jnp.eye(len(rows), dtype=rows.dtype) - _product(rows, inverse))
    return inverse / size.T


def _diagonal(matrix: Array) -> Array:
    return jnp.stack([matrix[k, k] for k in range(len(matrix))])  # not a gather, which would be a kernel of its own


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)  # not a matmul, which may be made in fewer bits


def is_valid(lattice: Lattice) -> Array:
    """Say whether a lattice is one: finite, its vectors independent, lengths positive; [] bool."""
    right = jnp.isfinite(lattice.matrix).all() & jnp.isfinite(lattice.transform).all() & jnp.isfinite(lattice.origin).all()
    if lattice.images.orthogonal:
        right = right & (_diagonal(lattice.matrix) >= 0).all()
    return right


class Wrapped(NamedTuple):
    """Particles in one cell of the lattice, and what rounding may have done on the way.

    Attributes:
        sources: [n, d] wrapped, near enough: x - turns @ matrix but for rounding; NaN where they are out of range.
        queries: [m, d] likewise; the sources again where they are the queries.
        turns: [n] int32, see `packed_turns`.
        query_turns: [m] int32.
        slack: [] bound on the error of a component of a difference of wrapped coordinates, with a shift within reach.
        reach: [d] half the width of the stencil, in units of the transform: no pair is farther apart along an axis.
        margin: [d] of the reach, what does not depend on the radius.
        enough: [] bool: the images that are looked at are all that there can be.
        met: [] int32, the bits `NOT_FINITE` and `TOO_FAR` where there is such a particle; the lower bits are of turns.
    """

    sources: Array
    queries: Array
    turns: Array
    query_turns: Array
    slack: Array
    reach: Array
    margin: Array
    enough: Array
    met: Array


LARGEST_TURN = 511  # cells between a particle and the box: three such numbers share an int32, and S·A is exact in half mantissas
_TURN_BITS = 10
NOT_FINITE, TOO_FAR = 1 << _TURN_BITS, 2 << _TURN_BITS


def packed_turns(points: Array, lattice: Lattice) -> Array:
    """Count the lattice vectors between the cell and each point, 0 along open axes: [n] int32, 10 bits for each axis.

    -1 where a point is not finite, -2 where it is farther away than `LARGEST_TURN`.
    """
    fractions, periodic = fractions_of(points, lattice), lattice.images.periodic
    turns = [jnp.floor(fractions[:, k]) if p else jnp.zeros_like(fractions[:, k]) for k, p in enumerate(periodic)]
    finite = functools.reduce(jnp.logical_and, (jnp.isfinite(points[:, k]) for k in range(lattice.dim)))
    near = functools.reduce(jnp.logical_and, (jnp.abs(x) <= LARGEST_TURN for x in turns), finite)
    parts = [(x.astype(jnp.int32) + (LARGEST_TURN + 1)) << (k * _TURN_BITS) for k, x in enumerate(turns)]
    packed = jnp.where(near, functools.reduce(jnp.bitwise_or, parts), jnp.where(finite, -2, -1))
    return lax.optimization_barrier(packed)  # computed once, so that whoever asks gets the same


def _met(packed: Array, dim: int) -> Array:
    """Return the largest number of turns, and the bits of what is none, [] int32.

    Reductions that any number of devices can do together: XLA has no bitwise one of integers for that.
    """
    most = jnp.max(jnp.abs(unpacked_turns(packed, dim)), initial=0)
    nowhere, far = jnp.any(packed == -1), jnp.any(packed == -2)
    return most | jnp.where(nowhere, NOT_FINITE, 0).astype(jnp.int32) | jnp.where(far, TOO_FAR, 0).astype(jnp.int32)


def unpacked_turns(packed: Array, dim: int) -> Array:
    """Read what `packed_turns` wrote: [..., d] int32, 0 where it is negative."""
    places = np.arange(dim, dtype=np.int32) * _TURN_BITS
    parts = packed[..., None] >> places.reshape((1,) * packed.ndim + (dim,))
    return jnp.where(packed[..., None] < 0, 0, (parts & ((1 << _TURN_BITS) - 1)) - (LARGEST_TURN + 1))


def fractions_of(points: Array, lattice: Lattice) -> Array:
    """Return points [n, d] in units of the transform."""
    from_origin = points - lattice.origin[None]
    if lattice.images.orthogonal:
        return from_origin * _diagonal(lattice.transform)[None]
    return _product(from_origin, lattice.transform) if len(points) else from_origin


def translation(shifts: Array, lattice: Lattice) -> Array:
    """Return shifts @ matrix, [..., d], for whole floats; differentiable in the lattice."""
    if lattice.images.orthogonal:
        return shifts * leading_axes(_diagonal(lattice.matrix), shifts.ndim)
    rows = [leading_axes(lattice.matrix[k], shifts.ndim) for k in range(lattice.dim)]
    return sum((shifts[..., k, None] * rows[k] for k, p in enumerate(lattice.images.periodic) if p), jnp.zeros_like(shifts))


def wrap(sources: Array, queries: Array | None, lattice: Lattice, radius: np.floating | Array) -> Wrapped:
    """Bring particles into one cell of the lattice, and bound what rounding does.

    With u the computed units of the transform, u' the exact ones of the same transform, and R = matrix @ transform - 1 its
    residual (periodic columns), |u_j + S - u_i - (x_j - x_i + S·A) @ transform| is at most the rounding of u_i and u_j and
    sum |S|·|R|; and |d @ transform| <= |d|·|column of the transform|. `reach` adds these up, each rounded up generously.
    """
    dtype, images, dim = np.dtype(sources.dtype), lattice.images, lattice.dim
    eps, periodic = jnp.finfo(dtype).eps, np.array(images.periodic)
    clouds = [sources] if queries is None else [sources, queries]
    packed, wrapped = [packed_turns(points, lattice) for points in clouds], []
    for points, turns in zip(clouds, packed, strict=True):
        off = unpacked_turns(turns, dim).astype(dtype)
        moved = jnp.where((off == 0).all(axis=1, keepdims=True), points, points - translation(off, lattice))
        wrapped.append(jnp.where(turns[:, None] >= 0, moved, jnp.nan))
    met = functools.reduce(jnp.bitwise_or, (_met(turns, dim) for turns in packed))
    most = (met & LARGEST_TURN).astype(dtype)  # at least as many as the largest number of turns, less than twice as many

    matrix, transform = jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    spans = matrix.sum(axis=0)
    size = jnp.abs(lattice.origin) + (most + 1) * spans  # of what lies so many lattice vectors away
    if not (images.orthogonal or periodic.all()):
        finite = [jnp.max(jnp.abs(x), axis=0, initial=0, where=jnp.isfinite(x)) for x in wrapped]
        size = size + functools.reduce(jnp.maximum, finite)
    residual = jnp.abs(_product(lattice.matrix, lattice.transform) - jnp.diag(jnp.asarray(periodic, dtype)))
    residual = residual + 8 * eps * _product(matrix, transform)
    shifts = most + max(images.reach) + 1
    rounding = 8 * eps * _product(size[None], transform)[0] + 2 * shifts * residual.sum(axis=0)
    if images.orthogonal:
        rounding = jnp.where(periodic, rounding, 0)  # open axes are walked in raw coordinates
    length = jnp.sqrt(jnp.sum((transform * radius) ** 2, axis=0)) * (1 + 16 * eps)
    margin = 2 * rounding + jnp.where(periodic, 8 * eps, 0)
    reach = length + margin
    limit = jnp.where(periodic, 0.5 if images.nearest else jnp.asarray(images.reach, dtype), jnp.inf)
    enough = (reach < limit).all() if images.nearest else (reach <= limit).all()
    slack = _wrapping_error(most, lattice)
    return Wrapped(wrapped[0], wrapped[-1], packed[0], packed[-1], slack, reach, margin, enough, met)


def _wrapping_error(most: Array, lattice: Lattice) -> Array:
    """Bound the error of a component of x_j - x_i that wrapping both, by at most so many turns, and moving one to an image made.

    In units of u = eps/2: t·A of whole numbers takes u|t·A|, nothing for 0, 1, 2, and d times that where d such products add up;
    the sum with a coordinate of the cell takes u of it. What is not wrapped loses nothing.
    """
    dim, images = lattice.dim, lattice.images
    u = 0.525 * jnp.finfo(lattice.matrix.dtype).eps  # a twentieth more than half: for second orders, and for this sum
    spans = jnp.abs(lattice.matrix).sum(axis=0)  # 0 for components that no lattice vector has
    cell = jnp.where(spans > 0, jnp.abs(lattice.origin) + spans, 0)
    products = 1 if images.orthogonal else 2 * dim
    wrapping = jnp.where(most > 0, products * most * spans + cell, 0)
    reach = max(images.reach)
    moving = (0 if images.orthogonal and reach <= 2 else products * reach) * spans + cell + reach * spans
    return u * jnp.max(2 * wrapping + moving, initial=0)


def shifted_pairs(difference: Array, shifts: Array, lattice: Lattice) -> Shifted:
    """Return x_j - x_i + S·A for differences [m, k, d], differentiable, and what their exact test needs.

    In units of u = eps/2, a component is off by at most u|x_j - x_i|, (2d + 1) u|S·A| and u of their sum; 8 eps covers that.
    """
    vectors, fixed = difference + translation(shifts, lattice), lax.stop_gradient(lattice)
    sizes = lax.stop_gradient(jnp.where(jnp.isfinite(difference), jnp.abs(difference), 0))
    spans = functools.reduce(jnp.maximum, (jnp.abs(shifts[..., k]) for k in range(lattice.dim))) + 1
    rows = [jnp.abs(fixed.matrix[k]) for k in range(lattice.dim)]
    moved = functools.reduce(jnp.add, rows)  # 0 for components that no lattice vector has: nothing is added to them
    parts = [jnp.where(moved[k] > 0, sizes[..., k] + spans * moved[k], 0) for k in range(lattice.dim)]
    slack = 8 * jnp.finfo(moved.dtype).eps * functools.reduce(jnp.maximum, parts)
    return Shifted(vectors, shifts, slack, fixed.given, lattice.images.orthogonal, lattice.images.basis)


class Motion(NamedTuple):
    """How far points moved, whole lattice vectors apart: one that was wrapped into the box has not moved.

    Attributes:
        axes: d arrays [n], what is left of each component, rounded up.
        sure: [n] bool: no rounding can make the lattice vectors that were taken off others, and S·A is exact with them.
        home: [n, d] int32, how many lattice vectors a point would lie from the box without those.
    """

    axes: list[Array]
    sure: Array
    home: Array


def motion_of(before: Array, now: Array, lattice: Lattice) -> Motion:
    """Measure motion [n, d] modulo the lattice."""
    eps, periodic = jnp.finfo(now.dtype).eps, np.array(lattice.images.periodic)
    difference, matrix, transform = now - before, jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    units, turns = _units_of(difference, lattice), turns_between(before, now, lattice)
    size, taken = jnp.abs(difference), jnp.abs(turns)
    rounding = 4 * eps * (size + translation(taken, dataclasses.replace(lattice, matrix=matrix)))
    was_turned = (turns != 0).any(axis=1)
    left = jnp.abs(difference - translation(turns, lattice)) + jnp.where(was_turned[:, None], rounding, 0)
    residual = jnp.abs(_product(lattice.matrix, lattice.transform) - jnp.diag(jnp.asarray(periodic, now.dtype)))
    most = jnp.max(taken, axis=1, keepdims=True, initial=0) + 1
    unsure = 8 * eps * _units_of(size, dataclasses.replace(lattice, transform=transform)) + 2 * most * residual.sum(axis=0)[None]
    sure = jnp.where(periodic[None], jnp.abs(units - turns) + unsure < 0.5, True).all(axis=1)
    packed = packed_turns(now, lattice)
    home = unpacked_turns(packed, lattice.dim) - jnp.clip(turns, -(2.0**20), 2.0**20).astype(jnp.int32)
    return Motion(list(left.T), sure & ((packed >= 0) | ~was_turned), home)


def turns_between(before: Array, now: Array, lattice: Lattice) -> Array:
    """Count the lattice vectors by which points [n, d] were moved, as wrapping does: whole floats, 0 along open axes."""
    before, now = lax.stop_gradient((before, now))
    return -nearest_shifts(jnp.where(jnp.isfinite(now - before).all(axis=1, keepdims=True), now - before, 0), lattice)


def given_shifts(shifts: Array, images: Images) -> Array:
    """Return shifts [..., d], whole numbers, in the lattice vectors as they were given: int32."""
    counts = shifts.astype(jnp.int32)
    if images.basis is None:
        return counts
    rows = [np.array(row, np.int32).reshape((1,) * (counts.ndim - 1) + (-1,)) for row in images.basis]
    return functools.reduce(jnp.add, (counts[..., k, None] * row for k, row in enumerate(rows)))


def forward_shifts(shifts: Array, images: Images) -> Array:
    """Return shifts [..., d] with the sign for which their first number that is not 0, in the given vectors, is positive."""
    given, backward = given_shifts(shifts, images), jnp.zeros(shifts.shape[:-1], bool)
    for k in reversed(range(shifts.shape[-1])):
        backward = (given[..., k] < 0) | ((given[..., k] == 0) & backward)
    return jnp.where(backward[..., None], -shifts, shifts)


def box_change(before: Lattice, now: Lattice, home: Sequence[Array]) -> Array:
    """Bound how far the change of a box can move one image of points against another, for pairs within reach.

    `home`, arrays [n, d] int32, says how many lattice vectors the points lie from the box (`Motion`).
    """
    dtype, places = now.matrix.dtype, [x for x in home if len(x)]
    if not places:
        return jnp.zeros((), dtype)
    highest = functools.reduce(jnp.maximum, (jnp.max(x, axis=0) for x in places))
    lowest = functools.reduce(jnp.minimum, (jnp.min(x, axis=0) for x in places))
    eps = jnp.finfo(dtype).eps
    moved = jnp.sqrt(jnp.sum((now.matrix - before.matrix) ** 2, axis=1)) * (1 + 16 * eps)
    if now.images.basis is not None:  # short vectors are rounded
        moved = jnp.where(moved > 0, moved + 4 * eps * jnp.sum(jnp.abs(now.matrix), axis=1), moved)
    return jnp.sum(((highest - lowest).astype(dtype) + np.array(now.images.reach, dtype)) * moved)


def nearest_shifts(difference: Array, lattice: Lattice) -> Array:
    """Return the lattice shifts [..., d], whole floats, that bring differences x_j - x_i [..., d] nearest to 0."""
    units = _units_of(lax.stop_gradient(difference), lattice)
    return lax.stop_gradient(jnp.where(np.array(lattice.images.periodic), -jnp.round(units), 0))


def _units_of(difference: Array, lattice: Lattice) -> Array:
    """Return differences [..., d] in units of the transform."""
    if lattice.images.orthogonal:
        return difference * leading_axes(_diagonal(lattice.transform), difference.ndim)
    rows = [leading_axes(lattice.transform[m], difference.ndim) for m in range(lattice.dim)]
    return functools.reduce(jnp.add, (difference[..., m, None] * row for m, row in enumerate(rows)))
