"""What each shard asks the single-device library about its own particles and its halo particles."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import PartitionSpec

from jfrnn._engine import ENGINES, Features, parse_backend
from jfrnn._geometry import check_cutoff, check_flag, check_skin, mark_rows
from jfrnn._search import count, list_radius, round_capacity
from jfrnn._shards.halo import Halo, exchange, halo_in_shard, halo_spec, rows_seen
from jfrnn._shards.particles import OVERFLOWS, Particles, check_particles, of_shards, spec_of
from jfrnn._tracing import Given, Tree

# The engines that support periodic boxes, which distributed particles may have.
BACKENDS = {name: engine for name, engine in ENGINES.items() if engine.refuse(Features(periodic=True)) is None}


class Asked(NamedTuple):
    """The options of a query about pairs; static."""

    cutoff: float
    skin: float
    include_self: bool
    closed: bool
    backend: Given

    def options(self, particles: Particles, active: Array) -> dict[str, Any]:
        """Return what the functions for one device are told of the particles that a shard sees, beside the cutoff and the skin."""
        kind = {"include_self": self.include_self, "closed": self.closed, "backend": self.backend}
        return kind | {"box": particles.box, "active": active}


def check_asked(particles: Particles, cutoff: Given, skin: object, include_self: object, closed: object, backend: Given) -> Asked:
    check_particles(particles)
    parse_backend(backend, BACKENDS, " on several devices")
    dtype = np.dtype(particles.positions.dtype)
    radius = check_cutoff(cutoff, dtype)
    skin = check_skin(skin, radius, dtype)
    if list_radius(radius, skin, dtype) > particles.reach:
        raise ValueError(
            f"cutoff + skin must be at most {particles.reach}, the reach with which the particles were spread, got "
            f"{radius} + {skin}: pass larger ones to scatter."
        )
    return Asked(radius, skin, check_flag("include_self", include_self), check_flag("closed", closed), backend)


def over_shards(fn: Callable[..., Tree], particles: Particles, out: Tree, *arguments: Tree) -> Tree:
    """Run a function of one shard's arrays on every shard; arguments of other types than those of this package have spread rows."""

    def spec(argument: Tree) -> Tree:
        if isinstance(argument, Particles):
            return spec_of(argument)
        if isinstance(argument, Halo):
            return halo_spec(particles)
        return jax.tree.map(lambda _: of_shards(particles.mesh), argument)

    specs = tuple(spec(argument) for argument in arguments)
    return jax.shard_map(fn, mesh=particles.mesh, in_specs=specs, out_specs=out, check_vma=False)(*arguments)


def check_halo(halo: object, particles: Particles) -> None:
    """Raise for a halo of particles with another layout; a halo made before `grow` has another layout.

    Raises:
        TypeError, ValueError: the argument is no halo, or has other shapes.
    """
    if not isinstance(halo, Halo):
        raise TypeError(f"halo must be what jfrnn.distributed.halo returns, got {type(halo).__name__}.")
    wanted = particles.mesh.devices.size * rows_seen(particles)
    if halo.ids.shape != (wanted,):
        raise ValueError(
            f"halo has {halo.ids.shape[0]} rows, but particles with {particles.sizes} see {wanted}: after grow() make halos and "
            "lists anew."
        )


def on_each(fn: Callable[..., Tree], particles: Particles, *same: Tree) -> Tree:
    """Run a function on every device on its own particles, for what needs no neighbors, such as walls known to all devices.

    Args:
        fn: (particles, *same) -> a pytree of arrays with one row per row of the particles that it gets; their `positions`, `ids`,
            `active` and `values` are those of one device.
        particles: Distributed particles.
        *same: Pytrees of arrays that every device gets whole, such as vertices and faces.

    Returns:
        The result of fn, leaves [N, ...], rows as in `particles.positions`.

    Differentiable: as fn. Jit: yes, and fast only there. vmap: no.
    """
    specs = spec_of(particles), *(jax.tree.map(lambda _: PartitionSpec(), each) for each in same)
    rows = of_shards(particles.mesh)
    return jax.shard_map(fn, mesh=particles.mesh, in_specs=specs, out_specs=rows, check_vma=False)(particles, *same)


@jax.jit
def halo(particles: Particles) -> Halo:
    """Choose which particles are sent to which shards, once for several sums at the same positions.

    Args:
        particles: Distributed particles at these positions, on any shard.

    Returns:
        A `Halo` for these positions.

    Cost: a pass over the shard's particles per shard along an axis of the mesh. Differentiable: no gradient flows through. Jit:
    yes. vmap: no.
    """
    check_particles(particles)
    return over_shards(halo_in_shard, particles, halo_spec(particles), lax.stop_gradient(particles))


def gather_seen(particles: Particles, halo: Halo) -> tuple[Array, Array]:
    """Return the positions of the particles that a shard sees, its own and those of its halo, and in which rows there are any."""
    return exchange(particles.positions, halo, particles), halo.ids >= 0


def take_halo(particles: Particles, halo: Halo | None) -> tuple[Halo, Array]:
    """Return a halo, made anew without one, and whether it belongs to these rows and no particle is missing in it, [] bool."""
    found = halo_in_shard(particles) if halo is None else halo
    good = (found.status & OVERFLOWS.value) == 0
    if halo is not None:
        other = jnp.any(halo.ids[: particles.sizes.particles] != particles.ids)
        good &= ~lax.pmax(other, particles.mesh.axis_names)
    return found, good


@functools.partial(jax.jit, static_argnames="asked")
def counts(particles: Particles, halo: Halo | None, asked: Asked) -> Array:
    def count_shard(particles: Particles, halo: Halo | None) -> Array:
        halo, good = take_halo(particles, halo)
        x, active = gather_seen(particles, halo)
        radius = list_radius(asked.cutoff, asked.skin, np.dtype(x.dtype))
        counts = count(x, radius, **asked.options(particles, active))
        return mark_rows(counts[: particles.sizes.particles], good)

    return over_shards(count_shard, particles, of_shards(particles.mesh), lax.stop_gradient(particles), halo)


def count_capacity(particles: Particles, asked: Asked, slack: float) -> int:
    longest = int(jnp.max(counts(particles, None, asked), initial=0))
    return round_capacity(math.ceil(max(longest, 1) * slack))
