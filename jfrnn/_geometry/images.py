"""Periodic images: choose, while tracing, which lattice shifts of each particle a search considers.

An image pair (i, j, S) is a pair iff |x_j - x_i + S·A| < cutoff. The rows of A are the lattice vectors; S is a vector of integers
that is 0 along axes that are not periodic.
"""

import contextlib
import functools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry.box import Box, check_box_values, searched_vectors
from jfrnn._geometry.reduced import Basis, count_cells, reduced_basis
from jfrnn._geometry.status import Status
from jfrnn._tracing import own_transfers

LARGEST_TURN = 511  # most cells between a particle and the box: three such numbers fit into an int32, and S·A is exact
_MANY_IMAGES = 2**15 - 1  # with more images, shorter lattice vectors are looked for
_MOST_IMAGES = 2**22  # their tables take 100 MB
_MOST_VECTORS = 2**23  # largest sum of given vectors in a shift: float32 holds whole numbers up to 2^24 exactly


class Images(NamedTuple):
    """The periodic images that a search considers; static.

    Attributes:
        periodic: One bool per axis.
        orthogonal: Whether the lattice vectors lie along the axes.
        reach: How many cells away an image may lie and still be a neighbor, per axis; 0 along axes that are not periodic.
        nearest: Whether the minimum image of a pair is its only one within the cutoff, so that lists store no images.
        basis: The vectors that shifts count, as whole-number combinations of the given ones; None: the given ones.
        per_system: Whether each system of a batch has a box of its own; `reach` is then the largest of any.
        short: Whether shifts count vectors that each system has by itself (`Box.numbers`).
    """

    periodic: tuple[bool, ...]
    orthogonal: bool
    reach: tuple[int, ...]
    nearest: bool
    basis: Basis | None = None
    per_system: bool = False
    short: bool = False

    @property
    def shifts(self) -> np.ndarray:
        """All lattice shifts within reach, shape [images, d], int32; the row number is the image code."""
        axes = np.meshgrid(*(np.arange(-k, k + 1, dtype=np.int32) for k in self.reach), indexing="ij")
        return np.stack(axes, axis=-1).reshape(-1, len(self.reach))

    @property
    def numbers(self) -> np.ndarray:
        """The basis as an array, shape [d, d], int64."""
        return np.eye(len(self.reach), dtype=np.int64) if self.basis is None else np.array(self.basis)

    @property
    def counts_short(self) -> bool:
        """Whether shifts count short vectors instead of the given ones."""
        return self.basis is not None or self.short

    @property
    def total(self) -> int:
        """Number of shifts within reach."""
        return math.prod(2 * k + 1 for k in self.reach)

    @property
    def home(self) -> int:
        """The image code of the shift 0."""
        return (self.total - 1) // 2

    def code_of(self, shifts: Iterable[Array]) -> Array:
        """Return the image codes of shifts within reach, whole numbers along each axis."""
        first, *others = (shift + most for shift, most in zip(shifts, self.reach, strict=True))
        bases = (2 * most + 1 for most in self.reach[1:])
        return functools.reduce(lambda code, axis: code * axis[0] + axis[1], zip(bases, others, strict=True), first)

    @property
    def dtype(self) -> np.dtype:
        """Dtype of image codes in a list: 1 B for up to 256 images, 2 B for up to 32 768."""
        return np.dtype(np.uint8 if self.total <= 256 else np.int16 if self.total <= 2**15 else np.int32)


def images_of(box: Box, radius: float | None, dtype: np.dtype, sources: int) -> Images:
    """Choose the images for a search with this largest cutoff; `radius` is None if only the data tell it.

    Raises:
        ValueError: the cutoff spans more images than the codes can number.
    """
    if box.images is None and radius is not None and not isinstance(box.vectors, Tracer) and not isinstance(box.flags, Tracer):
        with own_transfers():
            images = _needed_images(searched_vectors(box, dtype), box, radius, dtype, None)
        many = images.total > _MANY_IMAGES or (not images.nearest and sources * images.total >= 2**31)
        if many and not (box.orthogonal or box.per_system):
            basis, short = reduced_basis(searched_vectors(box, dtype), box.periodic)
            reduced = _needed_images(short, box, radius, dtype, basis)
            numbers = (2 * LARGEST_TURN + max(reduced.reach)) * np.abs(reduced.numbers).sum(axis=0)  # of given vectors in a shift
            images = reduced if reduced.total < images.total and numbers.max() <= _MOST_VECTORS else images
        return check_images(images, sources)
    wanted = box.images or box.images_of_list or (0,) * box.dim
    nearest = not any(k for k, p in zip(wanted, box.periodic, strict=True) if p)
    reach = tuple(max(k, 1) if p else 0 for k, p in zip(wanted, box.periodic, strict=True))
    kind = Images(box.periodic, box.orthogonal, reach, nearest, None, box.per_system, box.numbers is not None)
    return check_images(kind, sources)


def refuse_status(status: Status, box: Box | None, images: Images | None, radius: float | None, more: str = "") -> None:
    """Raise what bits report, and `more`, if any is set; of a box with too few images, say how many its cutoff needs.

    Raises:
        ValueError: a bit is set.
    """
    if not status:
        return
    text = status.message + more
    known = box is not None and not isinstance(box.vectors, Tracer) and not isinstance(box.flags, Tracer)
    if Status.BOX_TOO_SMALL in status and known and box is not None and images is not None and radius is not None:
        had = "" if images.counts_short else f", and here images={(0,) * box.dim if images.nearest else images.reach}"
        with contextlib.suppress(ValueError):  # a degenerate box has no number of images
            text += f" A radius of {radius:.6g} needs images={box.images_for(radius)} in this box as it is now{had}."
    raise ValueError(text)


def box_of_list(box: Box, kind: Images, radius: float | None) -> Box:
    """Return the box that a list keeps: with as many images as the list has, so that searches and sums in it have no fewer.

    A list may count short vectors; the box then has the images that the given ones need, if that is known.
    """
    if not kind.counts_short:
        return box.of_list((0,) * box.dim if kind.nearest else kind.reach)
    known = radius is not None and not isinstance(box.vectors, Tracer) and not isinstance(box.flags, Tracer)
    return box.of_list(box.images_for(radius) if known and radius is not None else box.images or box.images_of_list)


def _needed_images(vectors: np.ndarray, box: Box, radius: float, dtype: np.dtype, basis: Basis | None) -> Images:
    """Return the images that a cutoff needs in a lattice of these vectors."""
    flags = np.array(box.periodic) if box.flags is None else np.asarray(box.flags)
    reach, nearest = count_cells(vectors, flags, box.orthogonal, radius, dtype)
    return Images(box.periodic, box.orthogonal, reach, nearest, basis, box.per_system, box.numbers is not None)


def check_images(images: Images, sources: int) -> Images:
    """Return the images, after checking that there are not too many.

    Raises:
        ValueError: there are more images than the codes can number.
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
    """Choose the images of a list that is made again: its present ones and those that the cutoff needs in each of these boxes.

    `short` says that a search met a box that needs more images. If none of these boxes does, the reach is doubled. Refused is a box
    that is degenerate, or too small for this cutoff.
    """
    for box in boxes:
        check_box_values(box)
    kinds = [kind, *(images_of(box, radius, dtype, sources) for box in boxes)]
    if len({k.basis for k in kinds}) > 1 and radius is not None:  # reaches are comparable in one basis only: that of the last box
        basis, numbers = kinds[-1].basis, kinds[-1].numbers
        short_of = ((box, numbers @ np.asarray(box.vectors, dtype).astype(np.float64)) for box in boxes)
        kinds = [_needed_images(vectors, box, radius, dtype, basis) for box, vectors in short_of]
        kind = Images(kind.periodic, kind.orthogonal, kinds[-1].reach, kinds[-1].nearest, kinds[-1].basis)
    reach, nearest = tuple(map(max, *(k.reach for k in kinds), kind.reach)), all(k.nearest for k in kinds)
    if short and (reach, nearest) == (kind.reach, kind.nearest):
        reach, nearest = reach if nearest else tuple(2 * k for k in reach), False
    return check_images(kind._replace(reach=reach, nearest=nearest), sources)
