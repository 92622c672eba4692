"""The `Lattice`: a periodic box in the dtype of the positions, its inverse, and lattice shifts of pairs.

A shift is a vector of whole numbers of lattice vectors. In a strongly skewed lattice a search counts short vectors of the same
lattice; `given_shifts` converts such shifts to the given vectors.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.box import Box
from jfrnn._geometry.exact import Shifted
from jfrnn._geometry.floats import WHOLE_BITS, distill, half_mantissa
from jfrnn._geometry.images import Images
from jfrnn._geometry.reduced import Basis
from jfrnn._tracing import leading_axes


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lattice:
    """A periodic box in the dtype of the positions, ready to wrap them.

    Attributes:
        matrix: [d, d] lattice vectors that shifts count, one per row; rows of open axes are 0. Short, rounded vectors if `images`
            has a basis.
        given: [d, d] lattice vectors that the user gave; exact decisions use these.
        transform: [d, d]; (x - origin) @ transform are fractional coordinates along periodic axes, lengths along open ones.
        origin: [d] a corner of the cell.
        images: The images that the search considers. Static.
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
    """Round a box to a dtype once and compute its transform."""
    vectors, origin = jnp.asarray(box.vectors).astype(dtype), jnp.asarray(box.origin).astype(dtype)
    rows = jnp.diag(vectors) if box.orthogonal else vectors
    flags = np.array(box.periodic)
    given = matrix = jnp.where(flags[:, None], rows, 0)
    if box.orthogonal:
        lengths = jnp.where(flags, vectors, 1)
        return Lattice(matrix, given, jnp.diag(1 / lengths), origin, images)
    if images.basis is not None:
        matrix = combine(images.basis, given)
    return Lattice(matrix, given, _inverse(_complete(matrix, box.periodic)), origin, images)


def combine(basis: Basis, matrix: Array) -> Array:
    """Return basis @ matrix, the short vectors, with about one rounding per component; differentiable."""
    whole = np.array(basis)
    high = (whole + (1 << (WHOLE_BITS - 1))) >> WHOLE_BITS
    half = half_mantissa(lax.stop_gradient(matrix))
    terms = []
    for numbers, size in ((whole - (high << WHOLE_BITS), 1), (high, 2**WHOLE_BITS)):
        if numbers.any():
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
    size = jnp.max(jnp.abs(matrix), axis=1, keepdims=True)
    rows = matrix / size
    if len(matrix) == 2:
        adjugate = jnp.stack([jnp.stack([rows[1, 1], -rows[0, 1]]), jnp.stack([-rows[1, 0], rows[0, 0]])])
    else:
        adjugate = jnp.stack([jnp.cross(rows[k - 2], rows[k - 1]) for k in range(3)], axis=1)
    inverse = adjugate / jnp.sum(rows[0] * adjugate[:, 0])
    inverse = inverse @ (2 * jnp.eye(len(rows), dtype=rows.dtype) - product(rows, inverse))
    return inverse / size.T


def _diagonal(matrix: Array) -> Array:
    return jnp.stack([matrix[k, k] for k in range(len(matrix))])  # without a gather, which would be a separate kernel


def product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)  # without a matmul, which GPUs may compute in fewer bits


def is_valid(lattice: Lattice) -> Array:
    """Say whether a lattice is finite, its vectors independent and its lengths positive; [] bool."""
    right = jnp.isfinite(lattice.matrix).all() & jnp.isfinite(lattice.transform).all() & jnp.isfinite(lattice.origin).all()
    if lattice.images.orthogonal:
        right = right & (_diagonal(lattice.matrix) >= 0).all()
    return right


def fractions_of(points: Array, lattice: Lattice) -> Array:
    """Return the fractional coordinates of points [n, d] (lengths along open axes)."""
    from_origin = points - lattice.origin[None]
    if lattice.images.orthogonal:
        return from_origin * _diagonal(lattice.transform)[None]
    return product(from_origin, lattice.transform) if len(points) else from_origin


def translation(shifts: Array, lattice: Lattice) -> Array:
    """Return the lattice translations shifts @ matrix, [..., d], of whole floats; differentiable in the lattice."""
    if lattice.images.orthogonal:
        return shifts * leading_axes(_diagonal(lattice.matrix), shifts.ndim)
    rows = [leading_axes(lattice.matrix[k], shifts.ndim) for k in range(lattice.dim)]
    return sum((shifts[..., k, None] * rows[k] for k, p in enumerate(lattice.images.periodic) if p), jnp.zeros_like(shifts))


def shift_pairs(difference: Array, shifts: Array, lattice: Lattice) -> Shifted:
    """Return the displacements x_j - x_i + S·A [m, k, d], differentiable, with the data that their exact test needs.

    With u = eps/2, the errors of a component are at most u|x_j - x_i|, (2d + 1) u|S·A| and u times their sum; 8 eps covers them.
    """
    vectors, fixed = difference + translation(shifts, lattice), lax.stop_gradient(lattice)
    sizes = lax.stop_gradient(jnp.where(jnp.isfinite(difference), jnp.abs(difference), 0))
    spans = functools.reduce(jnp.maximum, (jnp.abs(shifts[..., k]) for k in range(lattice.dim))) + 1
    rows = [jnp.abs(fixed.matrix[k]) for k in range(lattice.dim)]
    moved = functools.reduce(jnp.add, rows)  # 0 for components to which no lattice vector contributes
    parts = [jnp.where(moved[k] > 0, sizes[..., k] + spans * moved[k], 0) for k in range(lattice.dim)]
    slack = 8 * jnp.finfo(moved.dtype).eps * functools.reduce(jnp.maximum, parts)
    return Shifted(vectors, shifts, slack, fixed.given, lattice.images.orthogonal, lattice.images.basis)


def given_shifts(shifts: Array, images: Images) -> Array:
    """Return shifts [..., d] of whole numbers in terms of the given lattice vectors, int32."""
    counts = shifts.astype(jnp.int32)
    if images.basis is None:
        return counts
    rows = [np.array(row, np.int32).reshape((1,) * (counts.ndim - 1) + (-1,)) for row in images.basis]
    return functools.reduce(jnp.add, (counts[..., k, None] * row for k, row in enumerate(rows)))


def forward_shifts(shifts: Array, images: Images) -> Array:
    """Return shifts [..., d], negated if needed so that the first nonzero number in the given vectors is positive."""
    given, backward = given_shifts(shifts, images), jnp.zeros(shifts.shape[:-1], bool)
    for k in reversed(range(shifts.shape[-1])):
        backward = (given[..., k] < 0) | ((given[..., k] == 0) & backward)
    return jnp.where(backward[..., None], -shifts, shifts)


def nearest_shifts(difference: Array, lattice: Lattice) -> Array:
    """Return the lattice shifts [..., d], whole floats, of the minimum images of differences x_j - x_i [..., d]."""
    units = units_of(lax.stop_gradient(difference), lattice)
    return lax.stop_gradient(jnp.where(np.array(lattice.images.periodic), -jnp.round(units), 0))


def units_of(difference: Array, lattice: Lattice) -> Array:
    """Return differences [..., d] in fractional coordinates (lengths along open axes)."""
    if lattice.images.orthogonal:
        return difference * leading_axes(_diagonal(lattice.transform), difference.ndim)
    rows = [leading_axes(lattice.transform[m], difference.ndim) for m in range(lattice.dim)]
    return functools.reduce(jnp.add, (difference[..., m, None] * row for m, row in enumerate(rows)))
