"""The `Lattice`: a periodic box in the dtype of the positions, its inverse, and lattice shifts of pairs.

A shift is a vector of whole numbers of lattice vectors. In a strongly skewed lattice a search counts short vectors of the same
lattice; `given_shifts` converts such shifts to the given vectors.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.box import Box
from jfrnn._geometry.exact import Shifted
from jfrnn._geometry.far import is_far, move_near
from jfrnn._geometry.floats import WHOLE_BITS, distill, half_mantissa, rounded_product
from jfrnn._geometry.images import Images
from jfrnn._tracing import on_platform


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lattice:
    """A periodic box in the dtype of the positions, ready to wrap them; or many, of which arrays have a first axis more.

    These are the boxes of systems or, after `of_rows`, those to which the rows of other arrays belong.

    Attributes:
        matrix: [d, d] lattice vectors that shifts count, one per row; rows of open axes are 0. Short, rounded vectors if `images`
            has a basis, or each system.
        given: [d, d] lattice vectors that the user gave; exact decisions use these. If `images.short`, [2 d, d]: behind them stands
            how many of each make up a vector of `matrix`, whole floats.
        transform: [d, d]; (x - origin) @ transform are fractional coordinates along periodic axes, lengths along open ones.
        origin: [d] a corner of the cell; one that is far away is moved as particles there are (`bring_near`).
        flags: [d] which axes are periodic, if that differs among many boxes; else None, and `images` tells.
        images: The images that the search considers. Static.
    """

    matrix: Array
    given: Array
    transform: Array
    origin: Array
    flags: Array | None
    images: Images = dataclasses.field(metadata={"static": True})

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.images.periodic)

    @property
    def periodic(self) -> Array | np.ndarray:
        """Which axes are periodic, [d] bool or as `flags`."""
        return np.array(self.images.periodic) if self.flags is None else self.flags

    @property
    def residual(self) -> Array:
        """The magnitude of matrix @ transform - 1 (0 instead of 1 along open axes): the rounding error of the transform."""
        unit = np.eye(self.dim, dtype=bool).reshape(*(1,) * (self.matrix.ndim - 2), self.dim, self.dim)
        exact = unit & self.spread(self.periodic, self.matrix.ndim)
        return jnp.abs(product(self.matrix, self.transform) - jnp.asarray(exact, self.matrix.dtype))

    def of_rows(self, systems: Array) -> "Lattice":
        """Return the box of each row of an array, given the system of each, [rows]; the nearest of those that there are."""
        return jax.tree.map(lambda x: x.at[systems].get(mode="clip"), self)

    def spread(self, x: Array | np.ndarray, ndim: int) -> Array | np.ndarray:
        """Return x [d], or one for each row [rows, d], so that it meets arrays [rows, ..., d] of so many axes."""
        return x.reshape(*x.shape[:-1], *(1,) * (ndim - x.ndim), x.shape[-1])


@jax.tree_util.register_pytree_with_keys_class
class KnownBox(Box):
    """A box whose lattice was found before: XLA takes longer to compile that than all that a search in a box is besides.

    `found` holds its numbers, and behind these what `jfrnn._geometry.wrapping` has found. Lists and their users have the plain box.
    """

    found: Array

    @classmethod
    def of(cls, box: Box, found: Array) -> "KnownBox":
        """Return a box, with what was found of it."""
        known = object.__new__(cls)
        known._set((box.vectors, box.origin, box.flags, box.numbers), box.kind)
        object.__setattr__(known, "found", found)
        return known

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        """Return the arrays with their names, and the static fields."""
        arrays, static = super().tree_flatten_with_keys()
        return (*arrays, (jax.tree_util.GetAttrKey("found"), self.found)), static

    @classmethod
    def tree_unflatten(cls, static: tuple[Any, ...], arrays: Iterable[Any]) -> "KnownBox":
        """Make a box from its parts without checking them again."""
        *of_box, found = arrays
        return cls.of(Box.tree_unflatten(static, of_box), found)

    def lattice(self, images: Images) -> Lattice:
        """Return its lattice, whose images were known when it was found."""
        d = self.dim
        matrix, given, transform, origin, _ = jnp.split(self.found, (d * d, 2 * d * d, 3 * d * d, 3 * d * d + d))
        return Lattice(matrix.reshape(d, d), given.reshape(d, d), transform.reshape(d, d), origin, None, images)


def plain_box(box: Box | None) -> Box | None:
    """Return a box without what is known of it."""
    if not isinstance(box, KnownBox):
        return box
    return Box.tree_unflatten(box.kind, (box.vectors, box.origin, box.flags, box.numbers))


def pack_lattice(lattice: Lattice) -> list[Array]:
    """Return the numbers of a lattice as `KnownBox` keeps them."""
    return [x.reshape(-1) for x in (lattice.matrix, lattice.given, lattice.transform, lattice.origin)]


def make_lattice(box: Box, images: Images, dtype: np.dtype) -> Lattice:
    """Round a box, or one per system, to a dtype once and compute its transform."""
    if isinstance(box, KnownBox):
        return box.lattice(images)
    vectors, origin = jnp.asarray(box.vectors).astype(dtype), jnp.asarray(box.origin).astype(dtype)
    if not box.per_system:
        matrix, given, transform = _make(vectors, None, None, box, images)
        made = Lattice(matrix, given, transform, origin, None, images)
        return dataclasses.replace(made, origin=_look_whether_far(origin[None], made).points[0])
    numbers = None if box.numbers is None or not images.short else lax.stop_gradient(jnp.asarray(box.numbers).astype(dtype))
    matrix, given, transform = jax.vmap(functools.partial(_make, box=box, images=images))(vectors, box.flags, numbers)
    made = Lattice(matrix, given, transform, origin, None if box.flags is None else jnp.asarray(box.flags), images)
    return dataclasses.replace(made, origin=_look_whether_far(origin, made).points)


def _make(vectors: Array, flags: Array | None, numbers: Array | None, box: Box, images: Images) -> tuple[Array, Array, Array]:
    """Return the vectors that shifts count, the given ones and the transform of one box."""
    periodic = np.array(box.periodic) if flags is None else flags
    rows = jnp.diag(vectors) if box.orthogonal else vectors
    given = matrix = jnp.where(periodic[:, None], rows, 0)
    if box.orthogonal:
        return matrix, given, jnp.diag(1 / jnp.where(periodic, vectors, 1))
    if images.basis is not None:
        matrix = combine(np.array(images.basis), given)
    if numbers is not None:
        matrix, given = combine(numbers.astype(jnp.int32), given), jnp.concatenate([given, numbers])
    if flags is None:
        return matrix, given, _inverse(_complete(matrix, box.periodic))
    whole = fixed = lax.stop_gradient(matrix)
    for axes in itertools.product((False, True), repeat=len(periodic)):
        whole = jnp.where((flags == np.array(axes)).all(), _complete(fixed, axes), whole)
    return matrix, given, _inverse(whole)


def combine(whole: np.ndarray | Array, matrix: Array) -> Array:
    """Return whole @ matrix, the short vectors of a basis, with about one rounding per component; differentiable."""
    high = (whole + (1 << (WHOLE_BITS - 1))) >> WHOLE_BITS
    half = half_mantissa(lax.stop_gradient(matrix))
    terms = []
    for numbers, size in ((whole - (high << WHOLE_BITS), 1), (high, 2**WHOLE_BITS)):
        if isinstance(numbers, Array) or numbers.any():
            times = numbers.astype(matrix.dtype)
            terms += [times[:, k, None] * (part[k] * size)[None] for k in range(len(whole)) for part in (matrix - half, half)]
    for _ in range(3):
        terms = distill(terms)
    return functools.reduce(jnp.add, terms)


def _complete(matrix: Array, periodic: tuple[bool, ...]) -> Array:
    """Replace the rows of open axes by unit vectors orthogonal to all periodic ones and to each other."""
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
    """Invert a [d, d] matrix by cofactors of its scaled rows, followed by one Newton step."""
    size = largest_component(jnp.abs(matrix))[:, None]
    rows = matrix / size
    cofactors = adjugate(rows)
    inverse = cofactors / add_rows((rows[0] * cofactors[:, 0])[:, None])[0]
    inverse = product(inverse, 2 * jnp.eye(len(rows), dtype=rows.dtype) - product(rows, inverse))
    return inverse / size.T


def adjugate(matrix: Array) -> Array:
    """Return the transposed cofactors of [..., d, d]."""
    rows = [matrix[..., k, :] for k in range(matrix.shape[-1])]
    if len(rows) == 2:
        (a, b), (c, d) = ((row[..., 0], row[..., 1]) for row in rows)
        return jnp.stack([jnp.stack([d, -b], axis=-1), jnp.stack([-c, a], axis=-1)], axis=-2)
    return jnp.stack([jnp.cross(rows[k - 2], rows[k - 1]) for k in range(3)], axis=-1)


def sides_of(lattice: Lattice) -> Array:
    """Return the lengths of the edges of a box along the axes, [..., d], 0 along open ones."""
    return _diagonal(lattice.matrix)


def _diagonal(matrix: Array) -> Array:
    columns = [matrix[..., k, k] for k in range(matrix.shape[-1])]  # without a gather, which would be a separate kernel
    return jnp.stack(columns, axis=-1)


def product(a: Array, b: Array) -> Array:
    """Return the matrix product, without a matmul, which GPUs may compute in fewer bits."""
    return functools.reduce(jnp.add, (a[..., :, k, None] * b[..., None, k, :] for k in range(b.shape[-2])))


def add_rows(matrix: Array) -> Array:
    """Return the sum of the rows of [..., d, d], without a reduction, which XLA might not fuse."""
    return functools.reduce(jnp.add, (matrix[..., k, :] for k in range(matrix.shape[-2])))


def largest_component(x: Array) -> Array:
    """Return the largest number of [..., d], likewise."""
    return functools.reduce(jnp.maximum, (x[..., k] for k in range(x.shape[-1])))


def is_valid(lattice: Lattice) -> Array:
    """Say whether a lattice is finite, its vectors independent and its lengths positive; [] bool, or of many [boxes]."""
    arrays = (lattice.matrix, (-2, -1)), (lattice.transform, (-2, -1)), (lattice.origin, (-1,))
    right = functools.reduce(jnp.logical_and, (jnp.isfinite(x).all(axis=axes) for x, axes in arrays))
    if lattice.images.orthogonal:
        right = right & (_diagonal(lattice.matrix) >= 0).all(axis=-1)
    return right


def fractions_of(points: Array, lattice: Lattice) -> Array:
    """Return the fractional coordinates of points [n, d] (lengths along open axes)."""
    from_origin = points - lattice.spread(lattice.origin, 2)
    if lattice.images.orthogonal:
        return from_origin * lattice.spread(_diagonal(lattice.transform), 2)
    if lattice.transform.ndim == 3:
        return add_rows(from_origin[:, :, None] * lattice.transform)
    return product(from_origin, lattice.transform) if len(points) else from_origin


def translation(shifts: Array, lattice: Lattice) -> Array:
    """Return the lattice translations shifts @ matrix, [..., d], of whole floats; differentiable in the lattice."""
    if lattice.images.orthogonal:
        return shifts * lattice.spread(sides_of(lattice), shifts.ndim)
    rows = [lattice.spread(lattice.matrix[..., k, :], shifts.ndim) for k in range(lattice.dim)]
    moves = [shifts[..., k, None] * rows[k] for k, p in enumerate(lattice.images.periodic) if p]
    return functools.reduce(jnp.add, moves) if moves else jnp.zeros_like(shifts)


def shift_pairs(difference: Array, shifts: Array, lattice: Lattice) -> Shifted:
    """Return the displacements x_j - x_i + S·A [m, k, d], differentiable, with the data that their exact test needs.

    With u = eps/2, the errors of a component are at most u|x_j - x_i|, (2d + 1) u|S·A| and u times their sum; 8 eps covers them.
    """
    vectors, fixed = difference + translation(shifts, lattice), lax.stop_gradient(lattice)
    sizes = lax.stop_gradient(jnp.where(jnp.isfinite(difference), jnp.abs(difference), 0))
    spans = functools.reduce(jnp.maximum, (jnp.abs(shifts[..., k]) for k in range(lattice.dim))) + 1
    rows = [jnp.abs(fixed.matrix[..., k, :]) for k in range(lattice.dim)]
    every = lattice.spread(functools.reduce(jnp.add, rows), difference.ndim)
    moved = [every[..., k] for k in range(lattice.dim)]  # 0 for components to which no lattice vector contributes
    parts = [jnp.where(moved[k] > 0, sizes[..., k] + spans * moved[k], 0) for k in range(lattice.dim)]
    slack = 8 * jnp.finfo(every.dtype).eps * functools.reduce(jnp.maximum, parts)
    return Shifted(vectors, shifts, slack, fixed.given, lattice.images.orthogonal, lattice.images.basis)


def given_shifts(shifts: Array, lattice: Lattice) -> Array:
    """Return shifts [..., d] of whole numbers in terms of the given lattice vectors, int32."""
    counts, images, dim = shifts.astype(jnp.int32), lattice.images, lattice.dim
    if not images.counts_short:
        return counts
    if images.basis is not None:
        rows = [np.array(row, np.int32).reshape((1,) * (counts.ndim - 1) + (-1,)) for row in images.basis]
    else:
        rows = [lattice.spread(lattice.given[..., dim + k, :], counts.ndim).astype(jnp.int32) for k in range(dim)]
    return functools.reduce(jnp.add, (counts[..., k, None] * row for k, row in enumerate(rows)))


def forward_shifts(shifts: Array, lattice: Lattice) -> Array:
    """Return shifts [..., d], negated if needed so that the first nonzero number in the given vectors is positive."""
    given, backward = given_shifts(shifts, lattice), jnp.zeros(shifts.shape[:-1], bool)
    for k in reversed(range(shifts.shape[-1])):
        backward = (given[..., k] < 0) | ((given[..., k] == 0) & backward)
    return jnp.where(backward[..., None], -shifts, shifts)


def nearest_shifts(difference: Array, lattice: Lattice) -> Array:
    """Return the lattice shifts [..., d], whole floats, of the minimum images of differences x_j - x_i [..., d]."""
    units = units_of(lax.stop_gradient(difference), lattice)
    return lax.stop_gradient(jnp.where(lattice.spread(lattice.periodic, units.ndim), -jnp.round(units), 0))


class Near(NamedTuple):
    """Points near the box.

    Attributes:
        points: [n, d] points - turns @ (given vectors), exactly; those that are too far away for that are unchanged.
        turns: [n, d] whole floats.
    """

    points: Array
    turns: Array


def bring_near(points: Array, lattice: Lattice) -> Near:
    """Move far points [n, d] near the box of a lattice, or each near that of its row (`jfrnn._geometry.far`).

    Differentiable in points and vectors. In lattices that are searched in short vectors, no points are moved.
    """
    if lattice.images.orthogonal and not lattice.images.counts_short:
        return _bring_each_near(points, lattice)
    return _look_whether_far(points, lattice)


def _look_whether_far(points: Array, lattice: Lattice) -> Near:
    """Bring points near behind a condition on a CPU, where that is worth it.

    A far origin is brought near 0 so: XLA would compute this for every particle anew, were it not behind a condition.
    """
    if lattice.images.counts_short:
        return Near(points, jnp.zeros_like(points))
    return on_platform(points, lattice, cpu=_bring_near_if_any_is_far, default=_bring_each_near)


def _bring_each_near(points: Array, lattice: Lattice, rarely: bool = False) -> Near:
    fixed, given = lax.stop_gradient((lattice, points))
    # of skewed vectors in twice the precision, so that all programs, and kernels, find the same
    units = units_of(given, fixed) if lattice.images.orthogonal else rounded_product(given, fixed.transform)
    periodic = fixed.spread(fixed.periodic, 2)
    return Near(*move_near(points, units, lattice.matrix, periodic, lattice.images.orthogonal, rarely))


def _bring_near_if_any_is_far(points: Array, lattice: Lattice) -> Near:
    """Look first: to compute moves that nothing takes is as long as a search on a CPU; on a GPU it takes longer to ask."""
    given, fixed = lax.stop_gradient((points, lattice))
    # at least as many vectors as they are away, but for rounding
    units = units_of(jnp.abs(given), dataclasses.replace(fixed, transform=jnp.abs(fixed.transform)))

    def stay(points: Array, lattice: Lattice) -> Near:
        del lattice
        none = jnp.where(jnp.abs(units) < 0, units, 0)  # is varied over devices as the moves are
        return Near(jnp.where(none == 0, points, none), none)

    move = functools.partial(_bring_each_near, rarely=True)
    return lax.cond(is_far(units * 1.001).any(), move, stay, points, lattice)


def units_of(difference: Array, lattice: Lattice) -> Array:
    """Return differences [..., d] in fractional coordinates (lengths along open axes)."""
    if lattice.images.orthogonal:
        return difference * lattice.spread(_diagonal(lattice.transform), difference.ndim)
    rows = [lattice.spread(lattice.transform[..., m, :], difference.ndim) for m in range(lattice.dim)]
    return functools.reduce(jnp.add, (difference[..., m, None] * row for m, row in enumerate(rows)))
