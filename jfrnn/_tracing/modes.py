"""What JAX's own modes ask of the library: broadcasting that is written out, transfers that are asked for, arrays in one piece.

`jax_numpy_rank_promotion="raise"` forbids operands of different rank. `jax.transfer_guard("disallow")` forbids whatever moves
between host and device without being asked to, numbers of the library too. On a mesh with explicit axes an array's type says over
which of them it is spread, and sorts, sums and lookups along such an axis are forbidden.
"""

import contextlib
from contextlib import AbstractContextManager

import jax
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def leading_axes(x: Array, ndim: int) -> Array:
    """Return x with axes of length 1 in front, so that it has `ndim` of them."""
    return x.reshape((1,) * (ndim - x.ndim) + x.shape)


def gather(x: Array) -> Array:
    """Return x in one piece on every device, where its type says that it is spread over explicit axes of a mesh.

    Along automatic axes the compiler does so where it has to. `jfrnn.distributed` spreads the work as well.
    """
    spread = jax.typeof(x).sharding
    if all(axes is None for axes in spread.spec):
        return x
    if isinstance(x, Tracer) or not isinstance(x.sharding, NamedSharding):
        return jax.sharding.reshard(x, NamedSharding(spread.mesh, PartitionSpec()))
    mesh = x.sharding.mesh
    if jax.sharding.get_abstract_mesh().empty:  # then its type is to say nothing of a mesh, as those of other arrays do
        mesh = Mesh(np.asarray(mesh.devices), mesh.axis_names)
    return jax.device_put(x, NamedSharding(mesh, PartitionSpec()))


def own_transfers() -> AbstractContextManager[object]:
    """Let the library move its own numbers to the device, and read back those that it has to, as `device_put` and `device_get` do.

    Where `jax.transfer_guard("disallow_explicit")` forbids these as well, it does so here. What users pass is to be on the device
    before: an array of NumPy is theirs to move.
    """
    guards = (
        (_guard_of_moves(), jax.transfer_guard_host_to_device),
        (jax.config.jax_transfer_guard_device_to_host, jax.transfer_guard_device_to_host),  # pyright: ignore[reportAttributeAccessIssue]
    )
    stack = contextlib.ExitStack()
    for level, guard in guards:
        if level in ("disallow", "log"):
            stack.enter_context(guard("allow"))
    return stack


def guards_transfers() -> bool:
    """Say whether transfers to the device are looked at which nobody asked for."""
    return _guard_of_moves() in ("disallow", "log")


def _guard_of_moves() -> str | None:
    return jax.config.jax_transfer_guard_host_to_device  # pyright: ignore[reportAttributeAccessIssue]
