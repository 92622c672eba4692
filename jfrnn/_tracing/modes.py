"""JAX's modes: explicit broadcasting, explicit transfers, and arrays gathered from explicit mesh axes.

`jax_numpy_rank_promotion="raise"` forbids operands of different rank. `jax.transfer_guard("disallow")` forbids implicit transfers
between host and device, also of the library's own numbers. On a mesh with explicit axes, the type of an array tells over which axes
it is sharded, and sorts, sums and lookups along such an axis are forbidden.
"""

import contextlib
from contextlib import AbstractContextManager

import jax
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jfrnn._tracing.forks import refuse_forks


def gather(x: Array) -> Array:
    """Return x replicated on every device, if its type says that it is sharded over explicit mesh axes.

    Along automatic axes the compiler does this where needed. `jfrnn.distributed` divides the work instead.
    """
    spread = jax.typeof(x).sharding
    if all(axes is None for axes in spread.spec):
        return x
    if isinstance(x, Tracer) or not isinstance(x.sharding, NamedSharding):
        return jax.sharding.reshard(x, NamedSharding(spread.mesh, PartitionSpec()))
    mesh = x.sharding.mesh
    if jax.sharding.get_abstract_mesh().empty:  # outside a mesh, its type must not name one
        mesh = Mesh(np.asarray(mesh.devices), mesh.axis_names)
    return jax.device_put(x, NamedSharding(mesh, PartitionSpec()))


def own_transfers() -> AbstractContextManager[object]:
    """Allow the library's own transfers between host and device, like explicit `device_put` and `device_get`.

    `jax.transfer_guard("disallow_explicit")` forbids these too. Arrays of users must be on the device before: transferring their
    NumPy arrays is left to them. Whatever enters here works with arrays, so forked processes are refused.
    """
    refuse_forks()
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
    """Say whether implicit transfers to the device are guarded."""
    return _guard_of_moves() in ("disallow", "log")


def _guard_of_moves() -> str | None:
    return jax.config.jax_transfer_guard_host_to_device  # pyright: ignore[reportAttributeAccessIssue]
