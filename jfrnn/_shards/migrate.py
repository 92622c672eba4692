"""Migration: choose bounds that balance the shards, and move each particle to the shard of its region."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Status, ordered_bits
from jfrnn._shards.calls import over_shards
from jfrnn._shards.halo import halo_in_shard
from jfrnn._shards.particles import Particles, check_particles, spec_of
from jfrnn._tracing import Tree, set_places

_DIGIT = 2  # bits of a bound per round of counting
_BUCKETS = 32  # a round of migration sends up to 1/32 of a shard, in equal parts to the other shards


@jax.jit
def migrate(particles: Particles) -> Particles:
    """Balance the bounds of the shards, and move each particle to the shard in whose region it lies.

    Rows change places, and values travel along. Only speed depends on it: `search` and `pair_sum` find the same pairs for any
    distribution. If a shard would get more particles than it has room for, all stay where they are, and a status bit is set.

    Args:
        particles: Distributed particles; they may have moved across several shards.

    Returns:
        The same n particles, with status bits and requirements that include those of this arrangement's halo.

    Cost: to find the bounds, each shard counts 16 times per axis of the mesh (float64: 32), three numbers per cut; then particles
    move in rounds, in each of which a shard sends up to a 32nd of its room. Particles that stay keep their rows. Differentiable: no
    gradient flows through. Jit: yes. vmap: no. Source: bounds by counting (Warren & Salmon 1993, doi:10.1145/169627.169640), found
    digit by digit.
    """
    check_particles(particles)
    return over_shards(_migrate_shard, particles, spec_of(particles), lax.stop_gradient(particles))


def _migrate_shard(particles: Particles) -> Particles:
    mesh, x, room = particles.mesh, particles.positions, particles.sizes.particles
    shards, here = mesh.devices.size, lax.axis_index(mesh.axis_names)
    there = particles.ids >= 0
    bounds, wanted = _balance(particles, there & jnp.isfinite(x).all(axis=1))
    wanted = jnp.where(jnp.isfinite(x).all(axis=1), wanted, here)
    fullest = jnp.max(lax.psum(_counts(jnp.where(there, wanted, shards), shards), mesh.axis_names))
    fits = fullest <= room
    goes = jnp.where(there, jnp.where(fits, wanted, here), shards)
    positions, ids, values = _move((x, particles.ids, particles.values), goes, particles)

    def where_used(leaf: Array) -> Array:
        return jnp.where((ids >= 0).reshape(-1, *[1] * (leaf.ndim - 1)), leaf, jnp.zeros((), leaf.dtype))

    positions, values = jax.tree.map(where_used, (positions, values))
    status = particles.status | jnp.where(fits, 0, Status.SHARD_OVERFLOW.value)
    bounds = tuple(jnp.where(fits, new, old) for new, old in zip(bounds, particles.bounds, strict=True))
    moved = dataclasses.replace(particles, positions=positions, ids=ids, values=values, bounds=bounds)
    halo = halo_in_shard(moved)
    required = particles.required.join(halo.required._replace(particles=fullest))
    return dataclasses.replace(moved, status=status | halo.status, required=required)


def _counts(goes: Array, shards: int) -> Array:
    """Count the rows that go to each shard, [shards] int32, by sums of flags: scatter-adds to so few numbers are slow."""
    return jnp.sum(goes[None] == lax.iota(jnp.int32, shards)[:, None], axis=1, dtype=jnp.int32)


def _move(rows: Tree, goes: Array, particles: Particles) -> Tree:
    """Send rows to the shards given by `goes`, into free rows there; the value `shards` marks unused rows."""
    mesh, room = particles.mesh, particles.sizes.particles
    shards, here = mesh.devices.size, lax.axis_index(mesh.axis_names)
    bucket = max(math.ceil(room / (_BUCKETS * shards)), 1)
    positions, ids, values = rows
    leaves = jnp.where(goes == here, shards, goes)
    rounds = -(-lax.pmax(jnp.max(_counts(leaves, shards)), mesh.axis_names) // bucket)
    # Rows that leave are read from `rows`, so a shard only needs room for the particles that it has in the end.
    kept = positions, jnp.where(goes == here, ids, -1), values

    def send(carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
        number, leaves, kept = carry
        places = lax.map(lambda shard: set_places(leaves == shard, bucket), lax.iota(jnp.int32, shards)).reshape(-1)
        sent = [leaf.at[places].get(mode="clip") for leaf in jax.tree.leaves((positions, values))]
        sent = [*sent, ids.at[places].get(mode="fill", fill_value=-1)]
        *came, new = [lax.all_to_all(leaf, mesh.axis_names, 0, 0, tiled=True) for leaf in sent]
        free, real = set_places(kept[1] < 0, min(shards * bucket, room)), new >= 0
        slot = jnp.where(real, free.at[jnp.cumsum(real, dtype=jnp.int32) - 1].get(mode="clip"), room)
        came = jax.tree.unflatten(jax.tree.structure((positions, values)), came)
        kept = jax.tree.map(lambda leaf, new: leaf.at[slot].set(new, mode="drop"), kept, (came[0], new, came[1]))
        return number + 1, leaves.at[places].set(shards, mode="drop"), kept

    return lax.while_loop(lambda carry: carry[0] < rounds, send, (jnp.int32(0), leaves, kept))[2]


def _balance(particles: Particles, counted: Array) -> tuple[tuple[Array, ...], Array]:
    """Return bounds that divide the particles evenly, and the shard in whose region each particle lies, [rows] int32.

    The first axis of the mesh divides space into slabs, and the next axis divides each slab separately (recursive coordinate
    bisection with as many parts as there are devices, Berger & Bokhari 1987, doi:10.1109/TC.1987.1676942). Particles at a bound
    belong above it.
    """
    x, mesh = lax.stop_gradient(particles.positions), particles.mesh
    part, bounds, groups = jnp.zeros(len(x), jnp.int32), [], 1
    for axis, shards in zip(particles.along, mesh.devices.shape, strict=True):
        coordinate = _in_box(x[:, axis], axis, particles)
        bits = ordered_bits(coordinate)
        found = _bounds(bits, jnp.where(counted, part, groups), groups, shards, particles)
        above = bits[:, None] >= found[part]
        part = part * shards + jnp.sum(above, axis=1, dtype=jnp.int32)
        inner = _floats(found, coordinate.dtype).reshape(*mesh.devices.shape[: len(bounds)], shards - 1)
        bounds, groups = [*bounds, inner], groups * shards
    return tuple(bounds), part


def _in_box(x: Array, axis: int, particles: Particles) -> Array:
    """Wrap a coordinate into a periodic box, up to rounding."""
    box = particles.box
    if box is None or not box.periodic[axis]:
        return x
    t = x - box.origin[axis]
    return box.origin[axis] + (t - box.vectors[axis] * jnp.floor(t / box.vectors[axis]))


def _bounds(bits: Array, group: Array, groups: int, shards: int, particles: Particles) -> Array:
    """Return the largest keys below which at most 1/shards, 2/shards ... of a group's particles lie: [groups, shards - 1]."""
    total = lax.psum(_counts(group, groups), particles.mesh.axis_names)[:, None]
    share = np.arange(1, shards, dtype=np.int32)
    wanted = total // shards * share + total % shards * share // shards
    digits = np.arange(1, 2**_DIGIT).astype(bits.dtype)
    number = np.broadcast_to(np.arange(groups, dtype=np.int32)[:, None, None], (groups, shards - 1, len(digits)))

    def find(k: Array, low: Array) -> Array:
        shift = (bits.dtype.itemsize * 8 - _DIGIT * (k + 1)).astype(bits.dtype)
        tried = low[..., None] + (digits << shift)
        less = (group[None] == number.reshape(-1, 1)) & (bits[None] < tried.reshape(-1, 1))
        below = lax.psum(jnp.sum(less, axis=1, dtype=jnp.int32), particles.mesh.axis_names)
        enough = jnp.sum(below.reshape(tried.shape) <= wanted[..., None], axis=-1)
        return low + (enough.astype(bits.dtype) << shift)

    return lax.fori_loop(0, bits.dtype.itemsize * 8 // _DIGIT, find, jnp.zeros((groups, shards - 1), bits.dtype))


def _floats(keys: Array, dtype: np.dtype) -> Array:
    """Return the coordinates of keys, inverting `ordered_bits`; infinite for keys beyond all floats."""
    top = keys.dtype.type(1 << (keys.dtype.itemsize * 8 - 1))
    x = lax.bitcast_convert_type(jnp.where(keys >= top, keys ^ top, ~keys), dtype)
    return jnp.where(jnp.isnan(x), jnp.inf, x)
