"""Halos: which particles of other shards a shard needs, and how they get there.

Each shard tells the others along an axis of the mesh the smallest box, its extent, that holds its own particles. Whoever has a
particle within reach of that extent sends it. So ownership is never a matter of correctness: a particle that left the region of its
shard only makes extents overlap. Axes of the mesh are served one after the other; what came along one is sent on along the next, so
that diagonal neighbors are reached without messages of their own (Plimpton 1995, section 3.3, doi:10.1006/jcph.1995.1039).

No pair is lost to rounding. On an open axis, particle j is sent where fl(low - x_j) <= w and fl(x_j - high) <= w. If
|x_j - x_i| < w (or <=) for a particle i of the extent, low <= x_i, then low - x_j <= x_i - x_j <= w exactly, and rounding, which
is monotonic, leaves it at most w, a float. On a periodic axis of length L, distances are taken from an arbitrary point c:
t = x - c, u = t - L·round(t/L). Three roundings make u wrong, but for a multiple of L, by at most eps/2·(|t| + |t| + L/2 + |u|);
with |u| <= L/2 (and a little, where round() took the other integer) that is less than eps·(|t| + L). Extents are widened by 4
times that bound of their own particles, and w by 4 times that of the particle that is asked about. The images u + S·L with S = -1,
0, 1 are all that there can be: extents reach L/2 to either side of c, so that an image with another S is at least L away, and
another one, with one of these S, at most L/2.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Status
from jfrnn._search import MOST_PAIRS, saturating_add
from jfrnn._shards.particles import Particles, Required, of_shards, share_bits
from jfrnn._tracing import set_places


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Halo:
    """Say which particles are sent where, so that each shard sees all neighbors of its own. A pytree; made by `halo`.

    It serves for the positions for which it was made, and while no particle has moved more than half of what the reach of the
    particles exceeds the cutoff in use: half the skin.

    Attributes:
        sends: For each axis of the mesh, rows that each message takes, shape [shards · messages, size], int32.
        ids: Of a shard's own particles and those of its halo, shape [shards · rows], int32; -1 where there is none.
        status: Bits of `Status`, shape [], int32.
        required: How much room would have been enough (`Required`).
        sent: Particles that were sent, over all shards and messages, shape [], int32; at most the largest int32.
    """

    sends: tuple[Array, ...]
    ids: Array
    status: Array
    required: Required
    sent: Array


class _Stage(NamedTuple):
    """One axis of the mesh: its number and name, shards along it, the axis of space, whether that is periodic."""

    number: int
    name: Any
    shards: int
    periodic: bool

    def offsets(self, hops: int) -> list[int]:
        """Return to which shards messages go, each once: relative numbers, not 0."""
        if self.periodic:
            return sorted({k % self.shards for k in range(-hops, hops + 1)} - {0})
        return [k for k in range(-hops, hops + 1) if k and abs(k) < self.shards]

    def hops_to(self, offset: Array) -> Array:
        """Return over how many shards a message goes."""
        there = jnp.abs(offset)
        return jnp.minimum(there, self.shards - there) if self.periodic else there

    def moves(self, offset: int) -> list[tuple[int, int]]:
        """Return sender and receiver of each message."""
        if self.periodic:
            return [(k, (k + offset) % self.shards) for k in range(self.shards)]
        return [(k, k + offset) for k in range(self.shards) if 0 <= k + offset < self.shards]


def stages(particles: Particles) -> list[_Stage]:
    """Return the axes of the mesh in the order in which they are served."""
    mesh, flags = particles.mesh, (False,) * particles.dim if particles.box is None else particles.box.periodic
    axes = enumerate(zip(mesh.axis_names, mesh.devices.shape, particles.along, strict=True))
    return [_Stage(k, name, size, flags[axis]) for k, (name, size, axis) in axes]


def halo_spec(particles: Particles) -> Halo:
    """Return how the arrays of a halo are spread."""
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
    x, numbers = lax.stop_gradient(particles.positions), particles.ids + 1  # where nothing is received are zeros
    sends, sizes, hops = [], [], []
    status, sent = jnp.int32(0), jnp.int32(0)
    for stage in stages(particles):
        extents = _extents(particles, stage)
        members, farthest = _members(x, numbers > 0, extents, particles, stage)
        room = particles.sizes.halo[stage.number]
        counts = [jnp.sum(member, dtype=jnp.int32) for member in members]
        rows = [set_places(member, room) for member in members]
        sends.append(jnp.stack(rows) if rows else jnp.zeros((0, room), jnp.int32))
        largest = functools.reduce(jnp.maximum, counts, jnp.int32(0))
        status = status | jnp.where(largest > room, Status.HALO_OVERFLOW.value, 0)
        status = status | jnp.where(farthest > particles.sizes.hops[stage.number], Status.HALO_TOO_FAR.value, 0)
        sizes, hops, sent = [*sizes, largest], [*hops, farthest], functools.reduce(saturating_add, counts, sent)
        x, numbers = (_append_received(leaf, sends[-1], particles, stage) for leaf in (x, numbers))
    names, none = particles.mesh.axis_names, jnp.int32(0)
    required = Required(none, lax.pmax(jnp.stack(sizes), names), lax.pmax(jnp.stack(hops), names), none)
    return Halo(tuple(sends), numbers - 1, share_bits(status, particles.mesh), required, _psum(sent, names))


def _psum(x: Array, names: str | tuple[str, ...]) -> Array:
    """Add up int32 of all shards that are not negative; a sum that int32 cannot hold is the largest int32."""
    high, low = lax.psum((x >> 15, x & 0x7FFF), names)  # of up to 32 768 shards, neither overflows
    high = high + (low >> 15)
    return jnp.where(high > 0xFFFF, MOST_PAIRS, (high << 15) | (low & 0x7FFF))


def exchange(leaf: Array, halo: Halo, particles: Particles) -> Array:
    """Return a shard's own rows of an array and those of its halo, inside `shard_map`; unused ones are 0. Linear.

    Arrays travel one by one, so that the compiler sends what several sums read once, and what none reads not at all. Packed into
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
    """Boxes around the own particles of all shards along an axis, shape [shards, d] each; periodic axes count from `center`."""

    low: Array
    high: Array
    center: Array


def _extents(particles: Particles, stage: _Stage) -> _Extents:
    """Share the extents along an axis; of shards that differ in later axes, which will be served from there, the union."""
    x = lax.stop_gradient(particles.positions)
    there = (particles.ids >= 0) & jnp.isfinite(x).all(axis=1)
    center = _center(particles, stage)
    u, error = _from_center(x, center, particles)
    # one column after the other: all at once take 4 to 7 times as long on a GPU, more than the rest of a halo
    low = jnp.stack([jnp.min((u - error)[:, k], initial=jnp.inf, where=there) for k in range(particles.dim)])
    high = jnp.stack([jnp.max((u + error)[:, k], initial=-jnp.inf, where=there) for k in range(particles.dim)])
    later = particles.mesh.axis_names[stage.number + 1 :]
    if later:
        low, high = lax.pmin(low, later), lax.pmax(high, later)
    return _Extents(*(lax.all_gather(x, stage.name) for x in (low, high, center)))


def _center(particles: Particles, stage: _Stage) -> Array:
    """Return the middle of the region of the shards that differ in later axes alone, [d], and of the box along other axes."""
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
    """Return coordinates from the center, brought near it along periodic axes, and 4 times the bound of their error."""
    box = particles.box
    if box is None:
        return x, jnp.zeros_like(x)
    lengths, periodic = jnp.where(np.array(box.periodic), box.vectors, 1), np.array(box.periodic)
    t = x - center
    u = t - lengths * jnp.round(t / lengths)
    error = 4 * jnp.finfo(x.dtype).eps * (jnp.abs(t) + lengths)
    return jnp.where(periodic, u, x), jnp.where(periodic, error, 0)


def _members(x: Array, there: Array, extents: _Extents, particles: Particles, stage: _Stage) -> tuple[list[Array], Array]:
    """Say for each message which rows belong into it, [rows] bool each; and to how many shards away any should have gone."""
    here, served = lax.axis_index(stage.name), stage.offsets(particles.sizes.hops[stage.number])

    def needed(offset: Array | int) -> Array:
        place = here + offset
        within = (place >= 0) & (place < stage.shards) | stage.periodic
        return there & within & _is_near(x, jax.tree.map(lambda each: each[place % stage.shards], extents), particles)

    members = [needed(offset) for offset in served]
    if stage.periodic:
        others = sorted(set(range(1, stage.shards)) - set(served))
    else:
        others = [k for k in range(1 - stage.shards, stage.shards) if k and k not in served]
    met = [jnp.where(member.any(), stage.hops_to(jnp.int32(k)), 0) for member, k in zip(members, served, strict=True)]
    farthest = functools.reduce(jnp.maximum, met, jnp.int32(0))
    if others:
        offsets = jnp.asarray(others, jnp.int32)

        def look(k: Array, farthest: Array) -> Array:
            return jnp.maximum(farthest, jnp.where(needed(offsets[k]).any(), stage.hops_to(offsets[k]), 0))

        farthest = lax.fori_loop(0, len(others), look, farthest)
    return members, farthest


def _is_near(x: Array, extent: _Extents, particles: Particles) -> Array:
    """Say which points are within reach of an extent along every axis, [rows] bool; see the head of this file for rounding."""
    u, error = _from_center(x, extent.center, particles)

    def distance(u: Array) -> Array:
        return jnp.maximum(extent.low - u, u - extent.high)

    apart = distance(u)
    if particles.box is not None:
        lengths = jnp.where(np.array(particles.box.periodic), particles.box.vectors, 0)
        apart = jnp.minimum(apart, jnp.minimum(distance(u + lengths), distance(u - lengths)))
    return (apart <= np.asarray(particles.reach, x.dtype) + error).all(axis=1)
