"""Neighbor lists of distributed particles."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.sharding import PartitionSpec

from jfrnn._geometry import check_devices, check_slack, pairs_and_status, shape_of
from jfrnn._search import NeighborList, has_moved_too_far, round_capacity, search
from jfrnn._shards.calls import Asked, check_halo, count_capacity, gather_seen, over_shards
from jfrnn._shards.halo import Halo, halo_in_shard, halo_spec
from jfrnn._shards.migrate import migrate
from jfrnn._shards.particles import OVERFLOWS, Particles, Required, check, check_particles, of_shards, share_bits, share_largest
from jfrnn._shards.scatter import fetch
from jfrnn._tracing import portable


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Neighbors:
    """The neighbors of distributed particles. A pytree; made by `search`.

    Attributes:
        local: The `jfrnn.NeighborList` of each shard, of its own and halo particles; all arrays have the shards as an additional
            first axis.
        halo: Which particles were sent to which shards when the list was made (`Halo`).
        count: True number of neighbors of each particle, shape [N], int32, as in `jfrnn.NeighborList`; 0 in unused rows.
        status: Bits of `Status`, shape [], int32.
        required: The buffer sizes that would have sufficed (`Required`).
        asked: The options of the list. Static.
    """

    local: NeighborList
    halo: Halo
    count: Array
    status: Array
    required: Required
    asked: Asked = dataclasses.field(metadata={"static": True})

    def __repr__(self) -> str:
        """Summarize the list in a line; waits for the devices."""
        shape, (cutoff, skin, *_) = shape_of(self.local.idx), self.asked
        kept = f", skin {skin:.6g}" if skin else ""
        rest = pairs_and_status(self.count, self.status)
        return (
            f"Neighbors({shape[0]} shards, capacity {shape[-1]}, cutoff {cutoff:.6g}{kept}, engine {self.asked.backend!r}, {rest})"
        )

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.local.capacity

    @property
    def overflow(self) -> Array:
        """Whether a buffer overflowed, so that pairs may be missing, shape [], bool."""
        return (self.status & OVERFLOWS.value) != 0

    @property
    def rebuild_count(self) -> Array:
        """How often updates rebuilt the list, shape [shards], int32, equal for all shards; only for a list with a skin."""
        return self.local.rebuild_count

    def update(self, particles: Particles) -> tuple[Particles, "Neighbors"]:
        """Rebuild the list if any particle has moved skin/2, or may have by rounding, or if rows changed; without a skin, always.

        Before a rebuild, particles move to the shards of their regions (`migrate`). Rows then change places, so continue with the
        particles that are returned.

        Args:
            particles: The particles at their present positions.

        Returns:
            The particles and the list, in the same shapes. Both keep status bits and requirements over all updates.

        Raises:
            ValueError: the particles have another layout than those for which the list was made.

        Cost: one pass over the positions and one number from each device; for a rebuild `migrate` and `search`. Differentiable: no
        gradient flows through. Jit: yes. vmap: no.
        """
        self._check_fits(particles)
        return _update(particles, self)

    def grow(self, particles: Particles, slack: float = 1.25) -> "Neighbors":
        """Make a list with larger buffers where they overflowed, for particles that have grown. Not inside jit.

        Args:
            particles: The particles at their present positions, after their own `grow`.
            slack: Factor >= 1 on the longest row so far.

        Returns:
            A list with the same options and status bits cleared.

        Raises:
            TypeError: called inside jit.
            ValueError: the particles are of another kind than those for which the list was made.
        """
        self._check_kind(particles)
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((particles, self.required))):
            raise TypeError("grow() changes shapes and cannot run inside jax.jit: call it on what jit returns.")
        counted = count_capacity(particles, self.asked, slack := check_slack(slack))
        met = round_capacity(math.ceil(slack * int(self.required.row))) if int(self.required.row) > self.capacity else 0
        return list_on_shards(particles, self.asked, max(self.capacity, counted, met))

    def check(self) -> None:
        """Raise what the status bits report; wait for the devices. Not inside jit: there, read `overflow`.

        Raises:
            RuntimeError: a buffer overflowed; the message gives the size needed.
            ValueError: positions hold NaN or infinity, or do not fit the box.
        """
        check(self, f"row {self.capacity}, halo {[sends.shape[1] for sends in self.halo.sends]}")

    def _check_kind(self, particles: Particles) -> None:
        """Raise for particles of another dtype or dimension, in another kind of box, or on other devices than those of the list."""
        check_particles(particles)
        check_devices("particles", particles.ids, self.count)
        made, came = (
            f"{dtype}, {dim}D, {'in open space' if box is None else f'box with periodic={box.periodic}'}"
            for dtype, dim, box in (
                (self.local.dtype, self.local.dim, self.local.box),
                (np.dtype(particles.positions.dtype), particles.dim, particles.box),
            )
        )
        if made != came:
            raise ValueError(f"particles must be of the kind for which the list was made ({made}), got {came}: search anew.")

    def _check_fits(self, particles: Particles) -> None:
        """Raise for particles of another kind or layout than those for which the list was made."""
        self._check_kind(particles)
        check_halo(self.halo, particles)

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids (i, j) of all pairs, for each direction and image, sorted, in every process.

        Returns:
            Two host arrays of equal length, int32: the pairs of `jfrnn.search` on one device, in another order.

        Raises:
            RuntimeError, ValueError: as `check`.
            TypeError: called inside jit.

        Communication: every process gets everything; meant for checks. Differentiable: no. Jit: no.
        """
        self.check()
        mine, theirs = (fetch(x) for x in _name_pairs(self))
        found = theirs >= 0
        i, j = np.broadcast_to(mine[:, None], theirs.shape)[found], theirs[found]
        order = np.lexsort((j, i))
        return i[order], j[order]


@functools.partial(jax.jit, static_argnames=("asked", "capacity"))
def list_on_shards(particles: Particles, asked: Asked, capacity: int) -> Neighbors:
    """Make the list of every shard from its own particles and its halo."""
    mesh, rows = particles.mesh, of_shards(particles.mesh)
    same: Any = PartitionSpec()

    def of_shard(particles: Particles) -> tuple[Any, ...]:
        halo = halo_in_shard(particles)
        x, active = gather_seen(particles, halo)
        made = search(x, asked.cutoff, skin=asked.skin, capacity=capacity, **asked.options(particles, active))
        status = share_bits(made.status | halo.status, mesh)
        required = halo.required._replace(row=share_largest(made.required, mesh))
        return jax.tree.map(lambda leaf: leaf[None], made), halo, made.count[: particles.sizes.particles], status, required

    out = rows, halo_spec(particles), rows, same, Required(same, same, same, same)
    made, halo, counts, status, required = over_shards(of_shard, particles, out, lax.stop_gradient(particles))
    return Neighbors(made, halo, counts, status, required, asked)


@jax.jit
def _update(particles: Particles, nbrs: Neighbors) -> tuple[Particles, Neighbors]:
    particles, asked = lax.stop_gradient(particles), nbrs.asked

    def remake(particles: Particles, nbrs: Neighbors) -> tuple[Particles, Neighbors]:
        moved = migrate(particles)
        made, local = list_on_shards(moved, asked, nbrs.capacity), nbrs.local
        if local.verlet is not None and made.local.verlet is not None:
            verlet = dataclasses.replace(made.local.verlet, rebuild_count=local.verlet.rebuild_count + 1)
            made = dataclasses.replace(made, local=dataclasses.replace(made.local, verlet=verlet))
        status, required = made.status | nbrs.status, made.required.join(nbrs.required)
        return moved, dataclasses.replace(made, status=status, required=required)

    if not asked.skin:
        return remake(particles, nbrs)
    stale: Array = over_shards(_is_stale, particles, PartitionSpec(), particles, nbrs.halo, nbrs.local)
    # a loop of at most one iteration, as in `NeighborList.update`
    carry = lax.while_loop(
        lambda carry: carry[0], lambda carry: (jnp.zeros_like(stale), *remake(*carry[1:])), (stale, particles, nbrs)
    )
    return carry[1:]


def _is_stale(particles: Particles, halo: Halo, local: NeighborList) -> Array:
    """Say on every shard whether particles of any shard moved too far, or are other ones; [] bool."""
    local, own = jax.tree.map(lambda leaf: leaf[0], local), particles.sizes.particles
    assert local.verlet is not None  # a list without a skin is always stale
    before = dataclasses.replace(local.verlet, positions=local.verlet.positions[:own])
    now = jnp.where((particles.ids >= 0)[:, None], particles.positions, jnp.inf)
    moved = has_moved_too_far(before, now, None, local.box, local.box_kind, None, local.skin)
    return lax.pmax(moved | jnp.any(halo.ids[:own] != particles.ids), particles.mesh.axis_names)


@jax.jit
def _name_pairs(nbrs: Neighbors) -> tuple[Array, Array]:
    """Return the ids of all rows [N], and of their neighbors [N, capacity], -1 in unused slots."""
    shards = nbrs.local.idx.shape[0]
    ids = nbrs.halo.ids.reshape(shards, -1)
    own = nbrs.count.shape[0] // shards
    idx, mine = nbrs.local.idx[:, :own], ids[:, :own]
    theirs = jax.vmap(lambda idx, ids: ids.at[idx].get(mode="fill", fill_value=-1))(idx, ids)
    return mine.reshape(-1), jnp.where((mine >= 0)[..., None], theirs, -1).reshape(-1, nbrs.capacity)
