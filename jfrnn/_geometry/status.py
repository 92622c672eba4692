"""Status bits: each names a problem that only the data reveal; and the error for lists that are too small.

What stands in place of numbers that may be wrong, so that they are not taken for right, is NaN, or the smallest integer (where
that is 0, the largest).
"""

import enum
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._tracing import Given


class Status(enum.IntFlag):
    """Problems that a search found in its data. Bits stay set over updates; `NeighborList.check` turns them into errors."""

    OK = 0
    ROW_OVERFLOW = 1
    NONFINITE = 2
    BOX_TOO_SMALL = 4
    OUT_OF_RANGE = 8
    INVALID_CUTOFF = 16
    NONFINITE_VERTEX = 32
    FACE_OUT_OF_RANGE = 64
    SHARD_OVERFLOW = 128
    HALO_OVERFLOW = 256
    HALO_TOO_FAR = 512
    TOTAL_OVERFLOW = 1024
    SYSTEM_WITHOUT_BOX = 2048
    EXCLUDED_OUT_OF_RANGE = 4096

    @property
    def message(self) -> str:
        """One sentence for each bit that is set, with the remedy."""
        return " ".join(text for bit, text in _MESSAGES.items() if bit in self) or "nothing to report."


_MESSAGES = {
    Status.ROW_OVERFLOW: "At least one row of the neighbor list holds more neighbors than `capacity`.",
    Status.NONFINITE: (
        "`positions` (or `queries`) hold non-finite coordinates (NaN or infinite): those particles have no neighbors. "
        "Find them with jnp.isfinite(positions).all(axis=1)."
    ),
    Status.BOX_TOO_SMALL: (
        "`box` is degenerate, or too small for the images that were looked at, so that pairs may be missing: a traced box must be "
        "at least 2.05 (cutoff + skin) wide along every periodic axis, unless jfrnn.Box(..., images=k) says over how many cells "
        "to either side a pair may reach, as box.images_for(cutoff + skin) tells. Outside jit, search() and grow() of a list see "
        "how many images a box needs."
    ),
    Status.OUT_OF_RANGE: (
        "`positions` (or `queries`) lie too far away from a periodic box: those particles have no neighbors. Up to 2^19 lengths of "
        "a box (float64: 2^30), and at least 511 vectors of a skewed one, are no trouble; farther away, a run has exploded, or "
        "positions have another unit than the box. Find them with jnp.abs(positions / lengths).max(axis=1) > 511, or with "
        "positions @ jnp.linalg.inv(vectors) in place of the quotient."
    ),
    Status.INVALID_CUTOFF: (
        "`cutoff` holds values that are negative or not finite, or, where not 0, too small or large for their dtype: those "
        "particles have no neighbors. Find them with ~(jnp.isfinite(cutoff) & (cutoff >= 0)). A table must be "
        "symmetric as well, and hold all `species`."
    ),
    Status.NONFINITE_VERTEX: (
        "`vertices` that faces name hold non-finite coordinates (NaN or infinite): those faces are nobody's neighbors. "
        "Find them with ~jnp.isfinite(vertices[faces]).all(axis=(1, 2))."
    ),
    Status.FACE_OUT_OF_RANGE: (
        "`faces` name vertices that do not exist: those faces are nobody's neighbors. Find them with "
        "((faces < 0) | (faces >= len(vertices))).any(axis=1)."
    ),
    Status.SHARD_OVERFLOW: "A shard would have got more particles than it has room for: none of them changed their shard.",
    Status.HALO_OVERFLOW: "A message to a neighboring shard holds fewer particles than it should: pairs may be missing.",
    Status.HALO_TOO_FAR: "Pairs reach to shards farther away than messages go: pairs may be missing.",
    Status.SYSTEM_WITHOUT_BOX: (
        "`batch` names systems for which `box` holds no box, or that int32 cannot number: those particles have no neighbors. "
        "Number systems from 0 to the length of `box.vectors` - 1, and particles that are not there -1."
    ),
    Status.EXCLUDED_OUT_OF_RANGE: (
        "`exclude` names particles that do not exist: those pairs exclude nothing. Number particles from 0 on, and "
        "write -1 in rows that are padding."
    ),
    Status.TOTAL_OVERFLOW: "The list held more pairs than the `total` that `require` was told: exports of that length lack pairs.",
}


def known_status(status: Array) -> Status | None:
    """Return the bits of a list, or the union over a batch of lists; None while traced."""
    if isinstance(status, Tracer):
        return None
    bits: Any = jax.device_get(status)  # the array caches it: asking again costs nothing
    return Status(int(np.bitwise_or.reduce(bits, axis=None)))


def shape_of(rows: Given, axes: int = 2) -> tuple[Any, ...]:
    """Return the shape of an array of rows, or of so many axes at least; for anything else as many times None."""
    shape = tuple(getattr(rows, "shape", ()))
    return shape if len(shape) >= axes else (None,) * axes


def tell(x: Given, how: Callable[[np.ndarray], object]) -> str:
    """Summarize an array for a `repr`, or say why its values are not available."""
    if isinstance(x, Tracer):
        return "traced"
    if not isinstance(x, np.ndarray | Array):
        return type(x).__name__
    if isinstance(x, Array) and x.is_deleted():
        return "deleted"
    if isinstance(x, Array) and not (x.is_fully_addressable or x.is_fully_replicated):
        return "elsewhere"
    if x.dtype.kind not in "biu":  # of a tree like a list, as JAX's derivatives in one are
        return "float0" if x.dtype == jax.dtypes.float0 else str(x.dtype)
    return str(how(jax.device_get(x)))


def names_of_bits(status: Given) -> str:
    """Return the names of the bits that are set, for a `repr`."""

    def names(bits: np.ndarray) -> str:
        found = Status(int(np.bitwise_or.reduce(bits, axis=None)))
        return " | ".join(bit.name or "" for bit in Status if bit and bit in found) or "OK"

    return tell(status, names)


def pairs_and_status(count: Given, status: Given) -> str:
    """Return the number of pairs and the names of set bits, for a `repr`."""
    return f"{tell(count, lambda x: np.sum(x, dtype=np.int64))} pairs, status {names_of_bits(status)}"


class NeighborOverflowError(RuntimeError):
    """A neighbor list was too small; `required` is the capacity that holds every row, or of a flat list the total of all pairs.

    Attributes:
        required: The largest number of neighbors of one row, or the number of pairs.
        capacity: The slots per row, or of all pairs, that the list had.
        name: The argument that was too small, "capacity" or "total".
    """

    def __init__(self, required: int, capacity: int, name: str = "capacity") -> None:
        self.required = required
        self.capacity = capacity
        self.name = name
        flat = name == "total"
        held, verb = (f"there are {required} pairs", "search_edges") if flat else (f"one row has {required} neighbors", "search")
        super().__init__(
            f"{name}={capacity} is too small: {held}. Search again with {name}={required} or more; called outside jax.jit without "
            f"`{name}`, {verb} counts first and cannot overflow."
        )

    def __reduce__(self) -> tuple[type, tuple[int, int, str]]:
        """Return how to unpickle the error; by default only the message is pickled, which makes process pools hang."""
        return type(self), (self.required, self.capacity, self.name)


ROWS_ARE_WHOLE = Status.NONFINITE | Status.TOTAL_OVERFLOW  # bits that do not mean missing neighbors in rows


def are_whole(status: Array, spared: Status = ROWS_ARE_WHOLE) -> Array:
    """Say whether no pair is missing as far as status bits tell, of which the spared ones tell nothing of that; [] bool."""
    return (status & np.int32(~spared.value)) == 0


def are_finite(points: Array) -> Array:
    """Say which points have finite coordinates: [rows] bool. It takes no reduction, which XLA would not fuse."""
    return functools.reduce(jnp.logical_and, (jnp.isfinite(points[:, k]) for k in range(points.shape[1])))


def good_rows(points: Array, active: Array | None, whole: Array | None) -> Array:
    """Say which rows [m] are valid: those of finite points and of inactive particles, provided that no pairs are missing."""
    finite = are_finite(lax.stop_gradient(points))
    good = finite if active is None else finite | ~active
    return good if whole is None else good & whole


def mark_rows(x: Array, good: Array) -> Array:
    """Replace rows that are not good by NaN (integers: the smallest one, or of unsigned ones, where that is 0, the largest).

    Derivatives of these rows become NaN too.

    `good` [rows] says it of each row, or [] of all.
    """
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x * _spread(jnp.where(good, 1, jnp.nan).astype(x.dtype), x.ndim)
    limits = jnp.iinfo(x.dtype)
    return jnp.where(_spread(good, x.ndim), x, x.dtype.type(limits.min or limits.max))


def _spread(good: Array, ndim: int) -> Array:
    return good.reshape(*good.shape, *[1] * (ndim - good.ndim)) if good.ndim else good
