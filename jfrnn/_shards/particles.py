"""Particles distributed over a mesh of devices: the contents, layout and buffer sizes of a shard.

A shard is the part of one device. All arrays are global JAX arrays: the rows of all shards one after the other, sharded along their
first axis over all axes of the mesh. Row-wise functions of such arrays need not know about shards. Which shard holds a particle
affects communication and load balance, never which particles are neighbors (`jfrnn._shards.halo`).
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jfrnn._geometry import Box, Status, check_again, check_slack, check_values, names_of_bits, shape_of
from jfrnn._tracing import Given, Tree, mesh_of_parts, parts_of_mesh, portable

OVERFLOWS = Status.ROW_OVERFLOW | Status.SHARD_OVERFLOW | Status.HALO_OVERFLOW | Status.HALO_TOO_FAR


class Sizes(NamedTuple):
    """Buffer sizes; static.

    Attributes:
        particles: Rows of a shard.
        halo: Particles per message, for each axis of the mesh.
        hops: Number of shards to either side that get messages, for each axis of the mesh.
    """

    particles: int
    halo: tuple[int, ...]
    hops: tuple[int, ...]


@portable
class Required(NamedTuple):
    """The buffer sizes that would have sufficed for everything so far; int32, equal on all devices.

    Attributes:
        particles: Rows of the fullest shard, shape [].
        halo: Particles of the largest message along each axis of the mesh, shape [axes].
        hops: Shards to the farthest receiver of a message, shape [axes].
        row: Neighbors in the longest row of a list, shape [].
    """

    particles: Array
    halo: Array
    hops: Array
    row: Array

    def join(self, other: "Required") -> "Required":
        """Return the sizes that suffice for both."""
        return Required(*(jnp.maximum(a, b) for a, b in zip(self, other, strict=True)))


class Met(Protocol):
    """Anything that records which buffer sizes would have sufficed: particles, halos, lists."""

    @property
    def status(self) -> Array:
        """Bits of `Status`, shape [], int32."""
        ...

    @property
    def required(self) -> Required:
        """The buffer sizes that would have sufficed."""
        ...


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Particles:
    """Particles distributed over a mesh of devices. A pytree; made by `scatter` and kept on the right shards by `migrate`.

    The rows of all shards stand one after the other, N = shards · capacity of them, sharded over the mesh; unused rows have id -1.

    Attributes:
        positions: Positions [length], shape [N, d]; 0 in unused rows after `scatter` and `migrate`.
        ids: Row of each particle in the arrays given to `scatter`, shape [N], int32; -1 in unused rows.
        values: A pytree of arrays of shape [N, ...] that travel along; 0 in unused rows likewise.
        bounds: For each axis of the mesh, where it is cut [length], shape [*mesh.shape[:k], mesh.shape[k] - 1]: each part of an
            axis is cut separately along the next.
        box: The periodic box, or None.
        status: Bits of `Status`, shape [], int32; kept until `grow`.
        required: The buffer sizes that would have sufficed (`Required`).
        mesh: The devices. Static.
        along: The axis of space that each axis of the mesh divides. Static.
        total: Number of particles n. Static.
        reach: Largest distance at which pairs are found [length]: cutoff + skin, rounded up to the dtype of the positions. Static.
        sizes: The buffer sizes (`Sizes`). Static.
    """

    positions: Array
    ids: Array
    values: Any
    bounds: tuple[Array, ...]
    box: Box | None
    status: Array
    required: Required
    mesh: Mesh = dataclasses.field(metadata={"static": True})
    along: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    total: int = dataclasses.field(metadata={"static": True})
    reach: float = dataclasses.field(metadata={"static": True})
    sizes: Sizes = dataclasses.field(metadata={"static": True})

    def __repr__(self) -> str:
        """Summarize the particles in a line; waits for the devices."""
        shards, dim = self.mesh.devices.size, shape_of(self.positions)[-1]
        room, status = self.sizes.particles, names_of_bits(self.status)
        return f"Particles({self.total} in {dim}D on {shards} shards of {room}, reach {self.reach:.6g}, status {status})"

    @property
    def active(self) -> Array:
        """Which rows hold a particle, shape [N], bool."""
        return self.ids >= 0

    @property
    def overflow(self) -> Array:
        """Whether a buffer overflowed, shape [], bool: discard the results, `grow` and run again."""
        return (self.status & OVERFLOWS.value) != 0

    @property
    def dim(self) -> int:
        """Axes of space, 2 or 3."""
        return self.positions.shape[1]

    def replace(self, positions: Array | None = None, values: Tree = None) -> "Particles":
        """Return the same particles with other positions [N, d], or other values (leaves [N, ...]). Jit: yes.

        Raises:
            ValueError, TypeError: positions are of another dtype or number than before, or values have other rows.
        """
        rows, dim = self.positions.shape
        if positions is not None:
            positions = check_again("positions", positions, np.dtype(self.positions.dtype), dim, rows, None, "this")
        check_values("values", values, rows, "row of particles")
        changed = {name: value for name, value in (("positions", positions), ("values", values)) if value is not None}
        return dataclasses.replace(self, **changed)

    def check(self) -> None:
        """Raise what the status bits report; wait for the devices. Not inside jit: there, read `overflow`.

        What positions hold is not looked at: `check()` of a list tells whether they are finite and fit the box.

        Raises:
            RuntimeError: a buffer overflowed; the message gives the size needed, and `grow` provides it.
        """
        check(self, ", ".join(f"{name} {np.asarray(size).tolist()}" for name, size in self.sizes._asdict().items()))

    def grow(self, *seen: Met, slack: float = 1.25) -> "Particles":
        """Return the same particles with the buffer sizes that `seen` requires. Not inside jit: sizes are shapes.

        Args:
            *seen: Results of a run that began with these particles: particles, lists or halos.
            slack: Factor >= 1 on the required sizes.

        Returns:
            These particles, with sizes not smaller than before and status bits cleared.

        Raises:
            TypeError: called inside jit.
        """
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(self)):
            raise TypeError("grow() changes shapes and cannot run inside jax.jit: call it on what jit returns.")
        for met in seen:
            if not isinstance(getattr(met, "required", None), Required):
                raise TypeError(f"seen must be particles, lists or halos of jfrnn.distributed, got {type(met).__name__}.")
        required = functools.reduce(Required.join, (met.required for met in seen), self.required)
        return resize(self, _enough(self.sizes, required, self.mesh, check_slack(slack)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to unpickle the particles on devices of the same numbers; a mesh itself cannot be pickled."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "mesh"}
        return _spread_again, (fields, parts_of_mesh(self.mesh))


def _spread_again(fields: dict[str, Any], parts: tuple[Any, ...]) -> Particles:
    """Make particles from the fields of others, on devices of the same numbers.

    Raises:
        RuntimeError: this process has no such devices.
    """
    mesh = mesh_of_parts(*parts)
    particles = Particles(**fields, mesh=mesh)
    places = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec), spec_of(particles), is_leaf=lambda x: isinstance(x, PartitionSpec)
    )
    return jax.device_put(particles, places)


def spec_of(particles: Particles) -> Particles:
    """Return the partition specs of the particles' arrays, in the same structure."""
    rows, same = of_shards(particles.mesh), PartitionSpec()
    return dataclasses.replace(
        jax.tree.map(lambda _: same, particles), positions=rows, ids=rows, values=jax.tree.map(lambda _: rows, particles.values)
    )


def room(size: int) -> int:
    """Round a size up, so that similar scenes share one compiled program, and flags of many rows fill words (`pack_parts`)."""
    step = 8 if size < 1024 else 32
    return max(-(-size // step) * step, step)


def _enough(sizes: Sizes, required: Required, mesh: Mesh, slack: float) -> Sizes:
    """Return the present sizes if they hold the requirement, else sizes that hold slack times it."""

    def grow_size(had: int, needs: int) -> int:
        return had if needs <= had else room(math.ceil(slack * needs))

    halo = tuple(grow_size(had, int(needs)) for had, needs in zip(sizes.halo, np.asarray(required.halo), strict=True))
    hops = tuple(max(had, int(needs)) for had, needs in zip(sizes.hops, np.asarray(required.hops), strict=True))
    most = tuple(size - 1 for size in mesh.devices.shape)
    return Sizes(grow_size(sizes.particles, int(required.particles)), halo, tuple(map(min, hops, most)))


def no_requirements(axes: int) -> Required:
    """Return a requirement that any sizes satisfy."""
    none: Any = np.zeros((), np.int32)
    each: Any = np.zeros(axes, np.int32)
    return Required(none, each, each, none)


def check_particles(particles: object) -> None:
    """Refuse what are no particles of this module."""
    if not isinstance(particles, Particles):
        came = "an array" if isinstance(particles, Array | np.ndarray) else type(particles).__name__
        raise TypeError(f"particles must be what jfrnn.distributed.scatter returns, got {came}.")


def of_shards(mesh: Mesh) -> PartitionSpec:
    """Return the partition spec of arrays with rows of all shards."""
    return PartitionSpec(mesh.axis_names)


def place_rows(mesh: Mesh, rows: np.ndarray, source: np.ndarray) -> Array:
    """Put the rows `source` of a host array, equal in all processes, on their devices; 0 for a negative source."""

    def part(index: Given) -> np.ndarray:
        wanted = source[index[0]]
        taken = np.zeros((len(wanted), *rows.shape[1:]), rows.dtype)
        taken[wanted >= 0] = rows[wanted[wanted >= 0]]
        return taken

    return jax.make_array_from_callback((len(source), *rows.shape[1:]), NamedSharding(mesh, of_shards(mesh)), part)


def replicate(mesh: Mesh, value: Given) -> Array:
    """Put a host array on every device."""
    array = np.asarray(value)
    return jax.make_array_from_callback(array.shape, NamedSharding(mesh, PartitionSpec()), lambda index: array[index])


def resize(particles: Particles, sizes: Sizes) -> Particles:
    """Return particles with these sizes, none smaller than before, and status bits cleared."""
    mesh, old, new = particles.mesh, particles.sizes.particles, sizes.particles
    none = no_requirements(mesh.devices.ndim)
    status, required = jax.tree.map(functools.partial(replicate, mesh), (np.zeros((), np.int32), none))
    kept = particles.positions, particles.ids, particles.values

    def wider(rows: Tree) -> Tree:
        def pad(x: Array, fill: int) -> Array:
            return jnp.concatenate([x, jnp.full((new - old, *x.shape[1:]), fill, x.dtype)])

        positions, ids, values = rows
        return pad(positions, 0), pad(ids, -1), jax.tree.map(lambda x: pad(x, 0), values)

    # The programs run even if nothing grows: their results share no memory with the arrays of `particles`.
    kept = jax.jit(jax.shard_map(wider, mesh=mesh, in_specs=of_shards(mesh), out_specs=of_shards(mesh), check_vma=False))(kept)
    bounds, box = jax.jit(lambda same: same)((particles.bounds, particles.box))
    changed = {"positions": kept[0], "ids": kept[1], "values": kept[2], "bounds": bounds, "box": box}
    return dataclasses.replace(particles, **changed, status=status, required=required, sizes=sizes)


def of_all_shards(mine: Array, mesh: Mesh) -> Array:
    """Return an array of every shard, [shards, ...], inside `shard_map`.

    What is told to all is gathered rather than reduced: a compiler joins gatherings, whatever they are for, into one message.
    """
    return lax.all_gather(mine, mesh.axis_names)


def share_bits(status: Array, mesh: Mesh) -> Array:
    """Return the bits that are set on any shard, inside `shard_map`."""
    return lax.reduce(of_all_shards(status, mesh), np.int32(0), lax.bitwise_or, (0,))


def share_largest(size: Array, mesh: Mesh) -> Array:
    """Return the largest value of any shard, entry by entry, inside `shard_map`."""
    return jnp.max(of_all_shards(size, mesh), axis=0)


def check(met: Met, room: str) -> None:
    """Raise what status bits report, outside of jit; `room` describes the present sizes.

    A RuntimeError tells of a buffer that overflowed, a ValueError of invalid data.
    """
    if isinstance(met.status, Tracer):
        raise TypeError("check() reads values and cannot run inside jax.jit: call it on what jit returns.")
    status, required = Status(int(met.status)), met.required
    if status & OVERFLOWS:
        needed = ", ".join(f"{name} {np.asarray(size).tolist()}" for name, size in required._asdict().items())
        raise RuntimeError(f"{status.message} Needed so far: {needed}; there is room for {room}: grow() makes what is missing.")
    if status:
        raise ValueError(status.message)
