"""Lines of sight: pairs of particles that a thin solid parts are no pairs of the fluid.

Through a sheet that is thinner than the kernel reaches, water on one side would push and hold water on the other. So, beside a
solid that is thin anywhere, each step lists the pairs of particles whose line of sight meets a triangle, exactly, and sums leave
them out. Both particles of such a pair are within the cutoff of that triangle, so the search is among those alone.
"""

import math
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn

_OPPOSITE = -0.5  # cosine of the angle between normals, from which on two faces look away from each other
_ROUNDING = 64
_BLOCK = 1 << 20
_MANY = 1 << 15  # points on faces from which on not all of them are asked
_LEAST, _ROOM = 1024, 1.5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sight:
    """Which pairs a thin solid parts, with room for so many.

    Attributes:
        parted: Pairs of particles, shape [p, 2], int32, -1 where there are fewer.
        required: How many particles near the solid, pairs of them and parted pairs there were, at most, shape [3], int32.
        near: Particles near the solid that there is room for. Static.
        pairs: Pairs of them that there is room for. Static.
    """

    parted: Array
    required: Array
    near: int = field(metadata={"static": True})
    pairs: int = field(metadata={"static": True})

    @property
    def overflow(self) -> Array:
        """Whether pairs may be missing because room was, shape [], bool."""
        return jnp.any(self.required > np.array([self.near, self.pairs, len(self.parted)], np.int32))


def make_room(required: np.ndarray, neighbors: float, most: int) -> Sight:
    """Return a sight without pairs, with room for half as many again as `required`, as in `Sight`, of at most so many particles.

    `neighbors` is how many a particle in the fluid has.
    """
    near = min(max(_LEAST, round(required[0] * _ROOM)), most)
    pairs = max(near * neighbors / 3, required[1] * _ROOM)
    parted = max(near * neighbors / 16, required[2] * _ROOM)
    return Sight(jnp.full((math.ceil(parted), 2), -1, jnp.int32), jnp.zeros(3, jnp.int32), near, math.ceil(pairs))


def points_on(corners: np.ndarray) -> np.ndarray:
    """Return points of each face [f, d, d], shape [f · (1 + d), d]: its middle, and near its corners."""
    middle = corners.mean(axis=1, keepdims=True)
    return np.concatenate([middle, corners + (middle - corners) / 16], axis=1).reshape(-1, corners.shape[2])


def points_to_ask(corners: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points on faces, shape [p, d], and the face of each, shape [p]: all `points_on`, of fine meshes some.

    Of a fine mesh, points in one cell of an eighth of the reach whose faces look the same way count once.
    """
    points = points_on(corners)
    faces = np.arange(len(points)) // (len(points) // len(corners))
    if len(points) <= _MANY:
        return points, faces
    cells = np.floor(points / (reach / 8)).astype(np.int64)
    ways = np.round(normals_of(corners)).astype(np.int64)[faces]
    first = np.unique(np.concatenate([cells, ways], axis=1), axis=0, return_index=True)[1]
    return points[first], faces[first]


def normals_of(corners: np.ndarray) -> np.ndarray:
    """Return unit normals of faces, shape [f, d]; 0 where a face has none."""
    along = corners[:, 1:] - corners[:, :1]
    normals = np.cross(along[:, 0], along[:, 1]) if along.shape[2] == len("xyz") else along[:, 0, ::-1] * (1, -1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)


def is_thin(corners: np.ndarray, asked: tuple[np.ndarray, np.ndarray], tri: jfrnn.TriangleList) -> bool:
    """Say whether faces that look away from each other, with the solid between them, are closer than the cutoff.

    Faces are given by their corners [length], shape [f, d, d]; points from `points_to_ask` are asked, near which `tri` lists them.
    """
    points, faces = asked
    normals = normals_of(corners)
    idx, used = np.asarray(tri.idx), np.arange(tri.capacity) < np.asarray(tri.count)[:, None]
    for block in np.array_split(np.arange(len(points)), -(-idx.size // _BLOCK)):
        rows, slots = np.nonzero(used[block])
        own, other = faces[block[rows]], idx[block[rows], slots]
        away = np.sum(normals[own] * normals[other], axis=1) < _OPPOSITE
        point, own, other = points[block[rows[away]]], own[away], other[away]
        seen = corners[other] - point[:, None]
        behind = np.min(np.einsum("kcd,kd->kc", seen, normals[own]), axis=1) < 0
        if np.any(behind & (np.einsum("kd,kd->k", seen[:, 0], normals[other]) > 0)):
            return True
    return False


@jax.jit
def look(room: Sight, tri: jfrnn.TriangleList, x: Array, normal: Array, there: Array | None) -> Sight:
    """Find the pairs of particles that the solid parts, at positions in its frame [m], shape [n, d], of those that are there.

    The triangles are those near these positions, within the cutoff of the pairs. Normals point about away from the solid, shape
    [n, d]: with them most pairs on one side are told from others at once.
    """
    x, normal = jax.lax.stop_gradient((x, normal))
    close = tri.count > 0 if there is None else (tri.count > 0) & there
    near = _places(close, room.near)
    points, ways = (part.at[near].get(mode="fill", fill_value=0) for part in (x, normal))
    edges = jfrnn.search_edges(points, tri.cutoff, half=True, active=near < len(x), total=room.pairs)
    i, j = edges.receivers, edges.senders
    r = points.at[j].get(mode="clip") - points.at[i].get(mode="clip")
    ground = _ground(tri, near, points, ways)
    over = [jnp.sum(ways.at[k].get(mode="clip") * way, axis=1) > ground.at[k].get(mode="clip") for k, way in ((i, r), (j, -r))]
    asked = jnp.stack([near.at[k].get(mode="fill", fill_value=-1) for k in (i, j)], axis=1)
    asked = jnp.where((over[0] | over[1])[:, None], -1, asked)
    parted = tri.between(x, asked)
    found = _places(parted, len(room.parted))
    required = jnp.stack([jnp.sum(close, dtype=jnp.int32), edges.required, jnp.sum(parted, dtype=jnp.int32)])
    pairs = asked.at[found].get(mode="fill", fill_value=-1)
    return replace(room, parted=pairs, required=jnp.maximum(room.required, required))


def _places(flags: Array, most: int) -> Array:
    """Return the indices of the first flags that are set, shape [most], int32, padded with their number."""
    return jnp.nonzero(flags, size=most, fill_value=len(flags))[0].astype(jnp.int32)


def _ground(tri: jfrnn.TriangleList, near: Array, points: Array, ways: Array) -> Array:
    """Return the height of the highest corner of the triangles near each point along its way, shape [m]; infinity if not below it.

    A particle above the ground is on the same side of all triangles of the row: none is between the two.
    """
    rows = tri.idx.at[near].get(mode="clip")
    used = jnp.arange(tri.capacity, dtype=jnp.int32) < tri.count.at[near].get(mode="fill", fill_value=0)[:, None]
    seen = tri.vertices[tri.faces.at[rows].get(mode="clip")] - points[:, None, None]
    high = jnp.max(jnp.where(used[..., None], jnp.sum(seen * ways[:, None, None], axis=-1), -jnp.inf), axis=(1, 2))
    largest = jnp.max(jnp.where(used[..., None, None], jnp.abs(seen), 0), axis=(1, 2, 3)) + tri.cutoff
    ground = high + _ROUNDING * jnp.finfo(points.dtype).eps * largest
    return jnp.where(ground < 0, ground, jnp.inf)
