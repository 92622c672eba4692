"""Particles spread over a mesh of devices: what each shard holds, how it is laid out, and how much room it has.

A shard is one device's part. All arrays are global ones of JAX, rows of one shard after those of another, sharded along their
first axis over all axes of the mesh; whatever works row by row on such arrays needs to know nothing of shards. Which particle lies
on which shard decides how much is sent and how even the load is, never who is a neighbor (`_shards_halo`).
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
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jfrnn._geometry import Box, Status, check_again, names_of_bits, shape_of
from jfrnn._tracing import Given, Tree

_STEP = 8  # sizes are rounded up to multiples, so that similar scenes share a compiled program
OVERFLOWS = Status.ROW_OVERFLOW | Status.SHARD_OVERFLOW | Status.HALO_OVERFLOW | Status.HALO_TOO_FAR


class Sizes(NamedTuple):
    """How much room there is; static.

    Attributes:
        particles: Rows of a shard.
        halo: Particles per message, for each axis of the mesh.
        hops: Over how many shards messages go to either side, for each axis of the mesh.
    """

    particles: int
    halo: tuple[int, ...]
    hops: tuple[int, ...]


class Required(NamedTuple):
    """How much room would have been enough, over all that was met; int32, the same on every device.

    Attributes:
        particles: Rows of the fullest shard, shape [].
        halo: Particles of the largest message along each axis of the mesh, shape [axes].
        hops: Shards to the farthest one that a message had to go to, shape [axes].
        row: Neighbors of the longest row of a list, shape [].
    """

    particles: Array
    halo: Array
    hops: Array
    row: Array

    def joined(self, other: "Required") -> "Required":
        """Return what is enough for both."""
        return Required(*(jnp.maximum(a, b) for a, b in zip(self, other, strict=True)))


class Met(Protocol):
    """Whatever knows how much room would have been enough: particles, halos, lists."""

    @property
    def status(self) -> Array:
        """Bits of `Status`, shape [], int32."""
        ...

    @property
    def required(self) -> Required:
        """How much room would have been enough."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Particles:
    """Hold particles spread over a mesh of devices. A pytree; made by `scatter`, kept on the right shards by `migrate`.

    Rows of all shards stand one after the other, N = shards · capacity of them, sharded over the mesh; unused rows have id -1.

    Attributes:
        positions: Positions [length], shape [N, d]; `scatter` and `migrate` leave 0 in unused rows, of which nobody reads.
        ids: Row of the plain array that each particle came from, shape [N], int32; -1 where there is none.
        values: A pytree of arrays of shape [N, ...] that travel along; likewise.
        bounds: For each axis of the mesh, where it is cut [length], shape [*mesh.shape[:k], mesh.shape[k] - 1]: each part of an
            axis is cut on its own along the next.
        box: The periodic box, or None.
        status: Bits of `Status`, shape [], int32; kept until `grow`.
        required: How much room would have been enough (`Required`).
        mesh: The devices. Static.
        along: Which axis of space each axis of the mesh cuts. Static.
        total: Number of particles n. Static.
        reach: Up to which distance pairs are found [length]: cutoff + skin, rounded up to the dtype of positions. Static.
        sizes: How much room there is (`Sizes`). Static.
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
        """Say in a line what they are; waits for the devices."""
        shards, dim = self.mesh.devices.size, shape_of(self.positions)[-1]
        room, status = self.sizes.particles, names_of_bits(self.status)
        return f"Particles({self.total} in {dim}D on {shards} shards of {room}, reach {self.reach:.6g}, status {status})"

    @property
    def active(self) -> Array:
        """Which rows hold a particle, shape [N], bool."""
        return self.ids >= 0

    @property
    def overflow(self) -> Array:
        """Whether room was missing anywhere, shape [], bool: results are not to be used, `grow` and run again."""
        return (self.status & OVERFLOWS.value) != 0

    @property
    def dim(self) -> int:
        """Axes of space, 2 or 3."""
        return self.positions.shape[1]

    def replace(self, positions: Array | None = None, values: Tree = None) -> "Particles":
        """Return the same particles with other positions [N, d], or other values (leaves [N, ...]). Jit: yes.

        Raises:
            ValueError, TypeError: Positions are of another kind or number than before, or values have other rows.
        """
        rows, dim = self.positions.shape
        if positions is not None:
            positions = check_again("positions", positions, np.dtype(self.positions.dtype), dim, rows, "this")
        for path, leaf in jax.tree_util.tree_leaves_with_path(values):
            if tuple(np.shape(leaf)[:1]) != (rows,):
                name = f"values{jax.tree_util.keystr(path)}"
                raise ValueError(f"{name} must have shape [{rows}, ...], a row per row of particles, got {list(np.shape(leaf))}.")
        changed = {name: value for name, value in (("positions", positions), ("values", values)) if value is not None}
        return dataclasses.replace(self, **changed)

    def check(self) -> None:
        """Raise what the status bits report; wait for the devices. Not inside jit: there, read `overflow`.

        Raises:
            RuntimeError: Room was missing; the message says how much is needed, `grow` makes it.
            ValueError: Positions hold NaN or infinity, or do not fit the box.
        """
        check(self, ", ".join(f"{name} {size}" for name, size in self.sizes._asdict().items()))

    def grow(self, *seen: Met, slack: float = 1.25) -> "Particles":
        """Return the same particles with the room that was missing in `seen`. Not inside jit: sizes are shapes.

        Args:
            *seen: What came of a run that began with these particles: particles, lists or halos.
            slack: Factor >= 1 on what was needed.

        Returns:
            These particles, as they are, with sizes not smaller than before and no bits from the past.

        Raises:
            TypeError: Called inside jit.
        """
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(self)):
            raise TypeError("grow() changes shapes and cannot run inside jax.jit: call it on what jit returns.")
        required = functools.reduce(Required.joined, (met.required for met in seen), self.required)
        return resize(self, _enough(self.sizes, required, self.mesh, slack))

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how to make them anew, on devices of the same numbers: a mesh itself cannot be pickled."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "mesh"}
        mesh = self.mesh
        return _spread_again, (fields, [d.id for d in mesh.devices.flat], mesh.devices.shape, mesh.axis_names, mesh.axis_types)


def _spread_again(
    fields: dict[str, Any], ids: list[int], shape: tuple[int, ...], names: tuple[str, ...], kinds: tuple[AxisType, ...]
) -> Particles:
    """Make particles of the fields of others, on devices of the same numbers.

    Raises:
        RuntimeError: This process has no such devices.
    """
    devices = {device.id: device for device in jax.devices()}
    if missing := [k for k in ids if k not in devices]:
        raise RuntimeError(
            f"particles were spread over devices {ids}, of which this process lacks {missing}: collect() them before they travel, "
            "and scatter() them anew."
        )
    mesh = Mesh(np.array([devices[k] for k in ids]).reshape(shape), names, axis_types=kinds)
    particles = Particles(**fields, mesh=mesh)
    places = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec), spec_of(particles), is_leaf=lambda x: isinstance(x, PartitionSpec)
    )
    return jax.device_put(particles, places)


def spec_of(particles: Particles) -> Particles:
    """Return how the arrays of particles are spread, in their structure."""
    rows, same = of_shards(particles.mesh), PartitionSpec()
    return dataclasses.replace(
        jax.tree.map(lambda _: same, particles),
        positions=rows,
        ids=rows,
        values=jax.tree.map(lambda _: rows, particles.values),
    )


def room(size: int) -> int:
    """Round a size up, so that similar scenes share one compiled program."""
    return max(-(-size // _STEP) * _STEP, _STEP)


def _enough(sizes: Sizes, required: Required, mesh: Mesh, slack: float) -> Sizes:
    """Return sizes that hold slack times what was required, and those that sufficed."""

    def grown(had: int, needs: int) -> int:
        return had if needs <= had else room(math.ceil(slack * needs))

    halo = tuple(grown(had, int(needs)) for had, needs in zip(sizes.halo, np.asarray(required.halo), strict=True))
    hops = tuple(max(had, int(needs)) for had, needs in zip(sizes.hops, np.asarray(required.hops), strict=True))
    most = tuple(size - 1 for size in mesh.devices.shape)
    return Sizes(grown(sizes.particles, int(required.particles)), halo, tuple(map(min, hops, most)))


def no_requirements(axes: int) -> Required:
    """Return what nothing needs."""
    none: Any = np.zeros((), np.int32)
    each: Any = np.zeros(axes, np.int32)
    return Required(none, each, each, none)


def of_shards(mesh: Mesh) -> PartitionSpec:
    """Return how arrays with rows of all shards are spread."""
    return PartitionSpec(mesh.axis_names)


def place_rows(mesh: Mesh, rows: np.ndarray, source: np.ndarray) -> Array:
    """Put rows of a host array, the same in every process, on their devices: those that `source` names, 0 where it is negative."""

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
    """Return particles with other sizes, no smaller ones, and no bits from the past."""
    mesh, old, new = particles.mesh, particles.sizes.particles, sizes.particles
    none = no_requirements(mesh.devices.ndim)
    status, required = jax.tree.map(functools.partial(replicate, mesh), (np.zeros((), np.int32), none))
    kept = particles.positions, particles.ids, particles.values

    def wider(rows: Tree) -> Tree:
        def padded(x: Array, fill: int) -> Array:
            return jnp.concatenate([x, jnp.full((new - old, *x.shape[1:]), fill, x.dtype)])

        positions, ids, values = rows
        return padded(positions, 0), padded(ids, -1), jax.tree.map(lambda x: padded(x, 0), values)

    # also where nothing is wider: results of a program share no memory with what it is given
    kept = jax.jit(jax.shard_map(wider, mesh=mesh, in_specs=of_shards(mesh), out_specs=of_shards(mesh), check_vma=False))(kept)
    bounds, box = jax.jit(lambda same: same)((particles.bounds, particles.box))
    changed = {"positions": kept[0], "ids": kept[1], "values": kept[2], "bounds": bounds, "box": box}
    return dataclasses.replace(particles, **changed, status=status, required=required, sizes=sizes)


def share_bits(status: Array, mesh: Mesh) -> Array:
    """Return the bits that are set on any shard, inside `shard_map`."""
    each = np.arange(Status(max(Status)).value.bit_length(), dtype=np.int32)
    return jnp.sum(lax.pmax((status >> each) & 1, mesh.axis_names) << each, dtype=jnp.int32)


def check(met: Met, room: str) -> None:
    """Raise what status bits report; `room` says how much there is.

    Raises:
        RuntimeError: Room was missing.
        ValueError: Data are not what they should be.
        TypeError: Called inside jit.
    """
    if isinstance(met.status, Tracer):
        raise TypeError("check() reads values and cannot run inside jax.jit: call it on what jit returns.")
    status, required = Status(int(met.status)), met.required
    if status & OVERFLOWS:
        needed = ", ".join(f"{name} {np.asarray(size).tolist()}" for name, size in required._asdict().items())
        raise RuntimeError(f"{status.message} Needed so far: {needed}; there is room for {room}: grow() makes what is missing.")
    if status:
        raise ValueError(status.message)
