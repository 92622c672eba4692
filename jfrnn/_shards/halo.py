"""Halos: the ghost particles that each shard needs from other shards, and their exchange.

Each shard publishes its extent, the bounding box of its own particles, to the others along an axis of the mesh. Every shard sends
the particles that are within reach of another's extent. Correctness therefore never depends on which shard owns a particle: a
particle that left its shard's region only makes extents overlap. Mesh axes are served one after the other, and ghosts received
along one axis are forwarded along the next, which reaches diagonal neighbors without extra messages (Plimpton 1995, section 3.3,
doi:10.1006/jcph.1995.1039).

No pair is lost to rounding. On an open axis, particle j is sent if fl(low - x_j) <= w and fl(x_j - high) <= w. If |x_j - x_i| < w
(or <=) for a particle i of the extent, then low <= x_i and low - x_j <= x_i - x_j <= w exactly; rounding is monotonic and w is a
float, so the test holds. On a periodic axis of length L, coordinates are taken from a point c: t = x - c, u = t - L·round(t/L). Up
to a multiple of L, three roundings change u by at most eps/2·(|t| + |t| + L/2 + |u|); with |u| <= L/2 (slightly more if round()
chose the other integer) that is less than eps·(|t| + L). Extents are widened by 4 times that bound for their own particles, and w
by 4 times that of the particle tested. The images u + S·L with S = -1, 0, 1 suffice: extents reach L/2 to either side of c, so an
image with another S is at least L away, while one with these S is at most L/2 away.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh

from jfrnn._geometry import Status, are_finite
from jfrnn._search import MOST_PAIRS, saturating_add
from jfrnn._shards.particles import Particles, Required, of_all_shards, of_shards, share_bits, share_largest
from jfrnn._tracing import Packed, pack_parts, packed_places, portable

_SIDE_BY_SIDE = 32  # rows of particles that a GPU reduces beside each other; shards have room for a multiple of as many


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Halo:
    """Which particles are sent to which shards, so that each shard sees all neighbors of its own. A pytree; made by `halo`.

    It is valid at the positions for which it was made, and until a particle has moved more than half of the difference between the
    reach of the particles and the cutoff in use: half the skin.

    Attributes:
        sends: For each axis of the mesh, the rows that each message takes, shape [shards · messages, size], int32.
        ids: Ids of a shard's own particles and those of its halo, shape [shards · rows], int32; -1 in unused rows.
        status: Bits of `Status`, shape [], int32.
        required: The buffer sizes that would have sufficed (`Required`).
        sent: Particles sent, over all shards and messages, shape [], int32; saturates at the largest int32.
    """

    sends: tuple[Array, ...]
    ids: Array
    status: Array
    required: Required
    sent: Array


class _Stage(NamedTuple):
    """One axis of the mesh: its number and name, its shards, and whether messages go around.

    They do along a periodic axis of space, and between two shards, each of which sends and receives one then.
    """

    number: int
    name: Any
    shards: int
    around: bool

    def offsets(self, hops: int) -> list[int]:
        """Return the relative numbers, not 0, of the shards that get messages, each once."""
        if self.around:
            return sorted({k % self.shards for k in range(-hops, hops + 1)} - {0})
        return [k for k in range(-hops, hops + 1) if k and abs(k) < self.shards]

    def hops_to(self, offset: Array) -> Array:
        """Return how many shards away the receiver of a message is."""
        there = jnp.abs(offset)
        return jnp.minimum(there, self.shards - there) if self.around else there

    def moves(self, offset: int) -> list[tuple[int, int]]:
        """Return sender and receiver of each message."""
        if self.around:
            return [(k, (k + offset) % self.shards) for k in range(self.shards)]
        return [(k, k + offset) for k in range(self.shards) if 0 <= k + offset < self.shards]


def stages(particles: Particles) -> list[_Stage]:
    """Return the axes of the mesh in the order in which they are served."""
    mesh, flags = particles.mesh, (False,) * particles.dim if particles.box is None else particles.box.periodic
    axes = enumerate(zip(mesh.axis_names, mesh.devices.shape, particles.along, strict=True))
    return [_Stage(k, name, size, flags[axis] or size == 2) for k, (name, size, axis) in axes]


def halo_spec(particles: Particles) -> Halo:
    """Return the partition specs of a halo's arrays."""
    rows: Any = of_shards(particles.mesh)
    same: Any = jax.sharding.PartitionSpec()
    return Halo((rows,) * len(particles.along), rows, same, Required(same, same, same, same), same)


def rows_seen(particles: Particles) -> int:
    """Return how many rows a shard sees: its own and those that it may receive."""
    sizes = particles.sizes
    messages = (len(stage.offsets(sizes.hops[stage.number])) * sizes.halo[stage.number] for stage in stages(particles))
    return sizes.particles + sum(messages)


def halo_in_shard(particles: Particles) -> Halo:
    """Make a halo, inside `shard_map`."""
    x, numbers = lax.stop_gradient(particles.positions), particles.ids + 1  # ids from 1 on: rows that receive nothing are 0
    sends, sizes, hops = [], [], []
    status, sent = jnp.int32(0), jnp.int32(0)
    for stage in stages(particles):
        extents = _extents(particles, stage)
        members, farthest = _members(x, numbers, extents, particles, stage)
        room = particles.sizes.halo[stage.number]
        counts = [member.total() for member in members]
        rows = [packed_places(member, room) for member in members]
        sends.append(jnp.stack(rows) if rows else jnp.zeros((0, room), jnp.int32))
        largest = functools.reduce(jnp.maximum, counts, jnp.int32(0))
        status = status | jnp.where(largest > room, Status.HALO_OVERFLOW.value, 0)
        status = status | jnp.where(farthest > particles.sizes.hops[stage.number], Status.HALO_TOO_FAR.value, 0)
        sizes, hops, sent = [*sizes, largest], [*hops, farthest], functools.reduce(saturating_add, counts, sent)
        x, numbers = (_append_received(leaf, sends[-1], particles, stage) for leaf in (x, numbers))
    mesh, none = particles.mesh, jnp.int32(0)
    required = Required(none, share_largest(jnp.stack(sizes), mesh), share_largest(jnp.stack(hops), mesh), none)
    return Halo(tuple(sends), numbers - 1, share_bits(status, mesh), required, _sum_shards(sent, mesh))


def _sum_shards(x: Array, mesh: Mesh) -> Array:
    """Sum nonnegative int32 over all shards, saturating at the largest int32."""
    each = of_all_shards(x, mesh)
    # neither overflows for up to 32 768 shards
    high, low = jnp.sum(each >> 15, dtype=jnp.int32), jnp.sum(each & 0x7FFF, dtype=jnp.int32)
    high = high + (low >> 15)
    return jnp.where(high > 0xFFFF, MOST_PAIRS, (high << 15) | (low & 0x7FFF))


def exchange(leaf: Array, halo: Halo, particles: Particles) -> Array:
    """Return an array's rows of the shard's own and halo particles, inside `shard_map`; unused rows are 0. Linear.

    Each array travels separately, so the compiler sends arrays that several sums read once, and unused ones not at all. Packed into
    one message per sum, a step of the solver took longer on two GPUs.
    """
    for stage in stages(particles):
        leaf = _append_received(leaf, halo.sends[stage.number], particles, stage)
    return leaf


def _append_received(leaf: Array, sends: Array, particles: Particles, stage: _Stage) -> Array:
    received = [
        lax.ppermute(leaf.at[rows].get(mode="fill", fill_value=0), stage.name, stage.moves(offset))
        for rows, offset in zip(sends, stage.offsets(particles.sizes.hops[stage.number]), strict=True)
    ]
    return jnp.concatenate([leaf, *received])


class _Extents(NamedTuple):
    """Bounding boxes of all shards' own particles along an axis, shape [shards, d] each; periodic axes count from `center`."""

    low: Array
    high: Array
    center: Array


def _extents(particles: Particles, stage: _Stage) -> _Extents:
    """Share the extents along an axis; shards that differ only in later axes form a union, as those axes are served from there."""
    x = lax.stop_gradient(particles.positions)
    center, there = _center(particles, stage), (particles.ids >= 0) & are_finite(x)
    u, error = _from_center(x, center, particles)
    # Rows stand side by side: a GPU reads them once then. Three columns take 4 to 7 times as long at once, 3 times one by one.
    wide = -1, math.gcd(len(x), _SIDE_BY_SIDE) * particles.dim
    ends = jnp.where(there[:, None], u - error, jnp.inf), jnp.where(there[:, None], u + error, -jnp.inf)
    low = jnp.min(ends[0].reshape(wide), axis=0, initial=jnp.inf).reshape(-1, particles.dim).min(axis=0)
    high = jnp.max(ends[1].reshape(wide), axis=0, initial=-jnp.inf).reshape(-1, particles.dim).max(axis=0)
    later = particles.mesh.axis_names[stage.number + 1 :]
    if later:
        low, high = lax.pmin(low, later), lax.pmax(high, later)
    return _Extents(*(lax.all_gather(x, stage.name) for x in (low, high, center)))


def _center(particles: Particles, stage: _Stage) -> Array:
    """Return the middle [d] of the region of shards that differ only in later axes; along other axes, of the box."""
    box, dtype = particles.box, particles.positions.dtype
    if box is None:
        return jnp.zeros(particles.dim, dtype)
    center = box.origin + box.vectors / 2
    prefix: tuple[Array, ...] = ()
    for name, axis, bounds in zip(particles.mesh.axis_names[: stage.number + 1], particles.along, particles.bounds, strict=False):
        place = lax.axis_index(name)
        ends = box.origin[axis] + jnp.stack([jnp.zeros((), dtype), box.vectors[axis]])
        inner = bounds[prefix]
        edges = jnp.clip(jnp.concatenate([ends[:1], jnp.where(jnp.isfinite(inner), inner, ends[1]), ends[1:]]), *ends)
        center = center.at[axis].set((edges[place] + edges[place + 1]) / 2)
        prefix = (*prefix, place)
    return jnp.where(np.array(box.periodic), center, 0)


def _from_center(x: Array, center: Array, particles: Particles) -> tuple[Array, Array]:
    """Return coordinates [n, d] from the center, wrapped along periodic axes, and 4 times their error bounds [n, d] or []."""
    box = particles.box
    if box is None:
        return x, jnp.zeros((), x.dtype)
    periodic = np.array(box.periodic)
    length, t = jnp.where(periodic, box.vectors, 1), x - center
    error = 4 * jnp.finfo(x.dtype).eps * (jnp.abs(t) + length)
    return jnp.where(periodic, t - length * jnp.round(t / length), x), jnp.where(periodic, error, 0)


def _members(x: Array, numbers: Array, extents: _Extents, particles: Particles, stage: _Stage) -> tuple[list[Packed], Array]:
    """Say which rows belong into each message, and return the number of hops that the farthest should have gone."""
    here, served = lax.axis_index(stage.name), stage.offsets(particles.sizes.hops[stage.number])

    def needed(offset: Array | int, rows: slice) -> Array:
        place = here + offset
        within = (place >= 0) & (place < stage.shards) | stage.around
        extent = jax.tree.map(lambda each: each[place % stage.shards], extents)
        return (numbers[rows] > 0) & within & _is_near(x[rows], extent, particles)

    members = [pack_parts(functools.partial(needed, offset), len(x)) for offset in served]
    if stage.around:
        others = sorted(set(range(1, stage.shards)) - set(served))
    else:
        others = [k for k in range(1 - stage.shards, stage.shards) if k and k not in served]
    met = [jnp.where(member.words.any(), stage.hops_to(jnp.int32(k)), 0) for member, k in zip(members, served, strict=True)]
    farthest = functools.reduce(jnp.maximum, met, jnp.int32(0))
    if others:
        offsets = jnp.asarray(others, jnp.int32)

        def look(k: Array, farthest: Array) -> Array:
            return jnp.maximum(farthest, jnp.where(needed(offsets[k], slice(None)).any(), stage.hops_to(offsets[k]), 0))

        farthest = lax.fori_loop(0, len(others), look, farthest)
    return members, farthest


def _is_near(x: Array, extent: _Extents, particles: Particles) -> Array:
    """Say which points are within reach of an extent along every axis, [rows] bool; the module docstring covers rounding."""
    box, reach = particles.box, np.asarray(particles.reach, x.dtype)
    u, error = _from_center(x, extent.center, particles)
    images = [u]
    if box is not None:
        lengths = jnp.where(np.array(box.periodic), box.vectors, 0)
        images += [u + lengths, u - lengths]
    apart = functools.reduce(jnp.minimum, [jnp.maximum(extent.low - image, image - extent.high) for image in images])
    near = apart <= reach + error
    return functools.reduce(jnp.logical_and, [near[:, axis] for axis in range(particles.dim)])
