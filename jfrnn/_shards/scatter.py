"""Distribute plain arrays over devices, and collect them again."""

import math
from collections.abc import Sequence
from typing import Any, cast

import jax
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import Mesh

from jfrnn._geometry import Box, check_box, check_cutoff, check_positions, check_skin, check_slack, check_values, images_of
from jfrnn._search import list_radius
from jfrnn._shards.migrate import migrate
from jfrnn._shards.particles import Particles, Sizes, check_particles, no_requirements, place_rows, replicate, resize, room
from jfrnn._tracing import Number, Points, Real, Tree, as_array

_MOST = 2**31 - 1
_SMALL = 1024  # particles per message for which the first guess leaves room: a wrong guess costs a compilation


def scatter(
    positions: Points,
    cutoff: Number,
    values: Tree = None,
    *,
    mesh: Mesh,
    skin: Real = 0.0,
    box: Box | None = None,
    along: Sequence[int] | None = None,
    slack: Real = 1.25,
) -> Particles:
    """Distribute particles evenly over a mesh of devices, each device getting a region of space.

    Args:
        positions: Positions [length], shape [n, 2] or [n, 3], float32 or float64; all of them in every process.
        cutoff: Largest interaction radius of later calls [length], a number > 0.
        values: A pytree of arrays of shape [n, ...] that travel with the particles.
        mesh: Devices, with one axis per axis of space to divide, at most d: `jax.make_mesh((8,), ("x",))` makes slabs,
            `jax.make_mesh((4, 2), ("x", "y"))` divides each slab once more.
        skin: Largest Verlet skin of later calls [length].
        box: Periodic box given by lengths; skewed lattices are refused.
        along: The axis of space that each axis of the mesh divides; default: the longest ones first.
        slack: Factor >= 1 on the present sizes of shards and messages, room for motion.

    Returns:
        `Particles` with room for `slack` times the present sizes.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or is traced.

    Memory: the given arrays in each process, its share on each device. Differentiable: no. Jit: no.
    """
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((positions, values, box))):
        raise TypeError("scatter() chooses shapes from data and cannot run inside jax.jit: call it before, on arrays.")
    positions = as_array("positions", positions, float)
    if (shape := np.shape(positions))[1:] not in ((2,), (3,)):
        raise ValueError(f"positions must have shape [n, 2] or [n, 3], got {list(shape)}.")
    check_positions("positions", positions[:0])
    x = np.asarray(positions)
    if len(x) > _MOST:
        raise ValueError(f"positions hold {len(x)} particles, but ids are int32: at most {_MOST}.")
    values = jax.tree.map(np.asarray, check_values("values", values, len(x), "particle"))
    slack, radius = check_slack(slack), check_cutoff(cutoff, x.dtype)
    reach = list_radius(radius, check_skin(skin, radius, x.dtype), x.dtype)
    mesh, cut = _check_mesh(mesh, x.shape[1]), _check_along(along, x, mesh)
    fixed = None if box is None else _check_box(box, x, reach, mesh)
    return _settle(_in_blocks(x, values, fixed, mesh, cut, reach), slack)


def _in_blocks(x: np.ndarray, values: Tree, box: Box | None, mesh: Mesh, along: tuple[int, ...], reach: float) -> Particles:
    """Put equally many rows on each device in the given order; `migrate` moves them to their regions."""
    shape, shards = mesh.devices.shape, mesh.devices.size
    share = -(-len(x) // shards)
    guess = room(max(share // 4, min(share, _SMALL)))
    sizes = Sizes(room(share), (guess,) * len(along), tuple(min(1, size - 1) for size in shape))
    place = np.arange(sizes.particles)
    source = np.where(place < share, share * np.arange(shards)[:, None] + place, len(x)).reshape(-1)
    source = np.where(source < len(x), source, -1).astype(np.int32)
    bounds = tuple(np.zeros((*shape[:k], size - 1), x.dtype) for k, size in enumerate(shape))
    same = (bounds, np.zeros((), np.int32), no_requirements(len(along)))
    bounds, status, required = jax.tree.map(lambda leaf: replicate(mesh, leaf), same)
    rows = jax.tree.map(lambda leaf: place_rows(mesh, leaf, source), (x, values))
    ids = place_rows(mesh, source, np.arange(len(source)))
    return Particles(rows[0], ids, rows[1], bounds, box, status, required, mesh, along, len(x), reach, sizes)


def _settle(particles: Particles, slack: float) -> Particles:
    """Migrate particles, growing buffers until they suffice: later mesh axes report their needs only after earlier ones fit."""
    while True:
        moved = migrate(particles)
        if not bool(moved.overflow):
            break
        particles = particles.grow(moved, slack=1.0)
    needed = (int(moved.required.particles), *np.asarray(moved.required.halo).tolist())
    fullest, *halo = (room(math.ceil(slack * size)) for size in needed)
    return resize(moved, Sizes(max(fullest, moved.sizes.particles), tuple(halo), moved.sizes.hops))


def collect(particles: Particles) -> tuple[np.ndarray, Any]:
    """Return positions [n, d] and values (leaves [n, ...]) as plain host arrays, in the order of ids, in every process.

    Raises:
        TypeError: called inside jit.

    Communication: every process gets everything; meant for checks and pictures. Differentiable: no. Jit: no.
    """
    check_particles(particles)
    if isinstance(particles.ids, Tracer):
        raise TypeError("collect() makes host arrays and cannot run inside jax.jit: call it on what jit returns.")
    ids = fetch(particles.ids)
    rows = np.flatnonzero(ids >= 0)
    order = rows[np.argsort(ids[rows], kind="stable")]
    return jax.tree.map(lambda leaf: fetch(leaf)[order], (particles.positions, particles.values))


def fetch(array: Array) -> np.ndarray:
    """Return a whole global array on the host, in every process."""
    if array.is_fully_addressable or array.is_fully_replicated:
        return np.asarray(array)
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(array, tiled=True))


def _check_mesh(mesh: object, dim: int) -> Mesh:
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh must be a jax.sharding.Mesh, got {type(mesh).__name__}: write e.g. jax.make_mesh((8,), ('x',)).")
    if not 1 <= mesh.devices.ndim <= dim:
        raise ValueError(f"mesh must have 1 to {dim} axes, as many as space is cut along, got {mesh.devices.ndim}.")
    return Mesh(mesh.devices, mesh.axis_names)  # default axis types: array types must not name the axes


def _check_along(along: Sequence[int] | None, x: np.ndarray, mesh: Mesh) -> tuple[int, ...]:
    dim, axes = x.shape[1], mesh.devices.ndim
    if along is None:
        finite = x[np.isfinite(x).all(axis=1)]
        extent = np.ptp(finite, axis=0) if len(finite) else np.zeros(dim)
        return tuple(np.argsort(-extent, kind="stable")[:axes].tolist())
    given = tuple(along) if np.iterable(along) else (along,)
    known = {int(axis) for axis in given if isinstance(axis, int | np.integer) and not isinstance(axis, bool)}
    if not len(given) == len(known) == axes or not known <= set(range(dim)):
        raise ValueError(
            f"along must name {axes} different axes of space, of 0 to {dim - 1}, one per axis of the mesh, got {given}."
        )
    return tuple(map(int, given))


def _check_box(box: object, x: np.ndarray, reach: float, mesh: Mesh) -> Box | None:
    """Return the box in the dtype of the positions, with images chosen as on one device, on every device."""
    checked = check_box(box, cast(Any, x))
    if checked is None:
        return None
    if checked.per_system:
        raise ValueError(
            "box must be one for all particles: systems with boxes of their own cannot be spread; search on one device."
        )
    if checked.fractional:
        raise ValueError("box must be one of positions that are lengths: spread positions @ vectors, not fractional coordinates.")
    if not checked.orthogonal:
        raise ValueError("box must be given by lengths: particles in a skewed lattice cannot be spread yet; run it on one device.")
    kind = images_of(checked, reach, x.dtype, len(x))
    arrays = (replicate(mesh, np.asarray(a).astype(x.dtype)) for a in (checked.vectors, checked.origin))
    images = (0,) * checked.dim if kind.nearest else kind.reach
    return Box.tree_unflatten((checked.periodic, images, False, False, None), (*arrays, None, None))
