"""Images: which lattice shifts of a particle a search looks at, chosen while tracing.

A pair of images (i, j, S) is a pair iff |x_j - x_i + S·A| < cutoff. The rows A_k of A are the lattice vectors, and S is a vector of
integers that is 0 along axes that are not periodic.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.core import Tracer

from jfrnn._geometry.box import Box, check_box_values
from jfrnn._geometry.reduced import Basis, reduced_basis
from jfrnn._tracing import own_transfers

LARGEST_TURN = 511  # cells between a particle and the box: three such numbers share an int32, and S·A is exact in half mantissas
_NEAREST = 0.49  # cutoff over width up to which the nearest image is the only one, with room for rounding
_MANY_IMAGES = 2**15 - 1  # from which on shorter lattice vectors are looked for
_MOST_IMAGES = 2**22  # of which tables take 100 MB
_MOST_VECTORS = 2**23  # of the given ones in a shift: float32 says whole numbers below 2^24 exactly


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
        return check_images(images, sources)
    wanted = (0,) * box.dim if box.images is None else box.images
    nearest = not any(k for k, p in zip(wanted, box.periodic, strict=True) if p)
    reach = tuple(max(k, 1) if p else 0 for k, p in zip(wanted, box.periodic, strict=True))
    return check_images(Images(box.periodic, box.orthogonal, reach, nearest), sources)


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


def check_images(images: Images, sources: int) -> Images:
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


def grow_images(kind: Images, boxes: Sequence[Box], radius: float | None, dtype: np.dtype, sources: int, short: bool) -> Images:
    """Choose the images of a list that is made again: those that it has, and those that this radius needs in each of these boxes.

    `short`: a search met a box that needs more of them. Where none of these boxes does, it was another: then twice as many.

    Raises:
        ValueError: a box is none, or too small for this radius.
    """
    for box in boxes:
        check_box_values(np.asarray(box.vectors), np.asarray(box.origin), box.periodic)
    kinds = [kind, *(images_of(box, radius, dtype, sources) for box in boxes)]
    if len({k.basis for k in kinds}) > 1:  # numbers of images can be compared in one basis only: that of the last box
        kinds = [_in_basis(box, radius, dtype, kinds[-1]) for box in boxes]
        kind = Images(kind.periodic, kind.orthogonal, kinds[-1].reach, kinds[-1].nearest, kinds[-1].basis)
    reach, nearest = tuple(map(max, *(k.reach for k in kinds), kind.reach)), all(k.nearest for k in kinds)
    if short and (reach, nearest) == (kind.reach, kind.nearest):
        reach, nearest = reach if nearest else tuple(2 * k for k in reach), False
    return check_images(kind._replace(reach=reach, nearest=nearest), sources)


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
