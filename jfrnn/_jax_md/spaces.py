"""jax-md, if it is installed: its types, its other names, and which of its spaces a displacement function belongs to."""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

try:
    with jax.numpy_dtype_promotion("standard"):  # under a stricter one, jax-md cannot be imported
        from jax_md import custom_partition, partition, space  # pyright: ignore[reportMissingImports]
except ImportError:
    import jfrnn._jax_md.types as partition

    custom_partition, space = partition, None

custom_partition: Any
partition: Any
NeighborListFormat = partition.NeighborListFormat
Dense, Sparse, OrderedSparse = NeighborListFormat


class Space(NamedTuple):
    """What a displacement function measures: the nearest image in a box (None: open space), of lengths or of fractions."""

    box: Any
    fractional: bool


def name_of_jax_md(name: str) -> Any:  # noqa: ANN401
    """Return what jax-md's modules of neighbor lists call by a name."""
    for module in (partition, custom_partition):
        if hasattr(module, name):
            return getattr(module, name)
    more = ": it is a name of jax-md, which is not installed, or of nothing" if space is None else ""
    raise AttributeError(f"module 'jfrnn.jax_md' has no attribute {name!r}{more}.")


def check_format(given: Any) -> Any:  # noqa: ANN401
    """Return the member of `NeighborListFormat` that has the name of what was given."""
    members, name = NeighborListFormat.__members__, getattr(given, "name", None)
    if name not in members:
        raise ValueError(f"format must be a member of NeighborListFormat, as Dense, Sparse or OrderedSparse, got {given!r}.")
    return members[name]


def floats_of(position: Any) -> Array:  # noqa: ANN401
    """Return positions as an array of JAX, whole numbers among them as floats."""
    position = jnp.asarray(position)
    return position.astype(float) if jnp.issubdtype(position.dtype, jnp.integer) else position


def space_of(function: Callable[..., Any], dim: int) -> Space | None:
    """Return the space of a displacement or metric that jax-md itself made; None: any other function.

    It is recognized by its code, not by what it returns somewhere, and its box is read from it.
    """
    if space is None:
        return None
    while isinstance(function, jax.stages.Wrapped):  # jax.jit
        function = function.__wrapped__  # pyright: ignore[reportAttributeAccessIssue]
    code, held = getattr(function, "__code__", None), {}
    free, periodic, general = (made[0] for made in (space.free(), space.periodic(1.0), space.periodic_general(1.0)))
    if code in (periodic.__code__, general.__code__, space.metric(free).__code__):
        held = inspect.getclosurevars(function).nonlocals
    if "displacement" in held:
        return space_of(held["displacement"], dim)
    if code is free.__code__:
        return Space(None, False)
    box = held.get("side", held.get("box"))
    if box is None or isinstance(box, Tracer) or np.shape(box) not in ((), (dim,), (dim, dim)[: 2 * ("box" in held)]):
        return None
    return Space(box, bool(held.get("fractional_coordinates", False)))
