"""The result of a triangle search, and the geometry that it computes at the positions of particles."""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn import _geometry as geometry
from jfrnn._search import norms, round_capacity
from jfrnn._tracing import IndexRows, Points, Real, as_array, call_apart, compile_program, own_transfers, portable
from jfrnn._triangles.cells import TriangleCells, gather_corners
from jfrnn._triangles.closest import are_contacts, nearest_of, pseudonormals
from jfrnn._triangles.crossings import are_crossed
from jfrnn._triangles.engines import TRIANGLE_ENGINES, TriangleEngine, count_slots, find_fields
from jfrnn._triangles.rows import are_near, nearest_slots
from jfrnn._triangles.tree import TriangleTree, grow_tree
from jfrnn._triangles.winding import is_closed, least_winding, ray_ways


@portable
class SignedDistance(NamedTuple):
    """Distances to a closed wall, negative inside.

    Attributes:
        distance: Distance to the nearest triangle of the row [length], shape [n]: negative inside, 0 if none is within the cutoff.
        mask: Whether there is a triangle within the cutoff, shape [n], bool.
        normal: Unit vector along which the distance grows fastest, shape [n, d]: away from the wall outside, toward it inside; at
            contact the pseudonormal; 0 if there is no triangle.
        watertight: Whether each side is run through equally often in both directions (in 2D, equally many segments start and end at
            each vertex), shape [], bool. If False, the wall encloses nothing, and signs only tell the sides of faces.
    """

    distance: Array
    mask: Array
    normal: Array
    watertight: Array


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TriangleList:
    """The triangles (in 2D: segments) near n particles, one row of `capacity` slots per particle. A pytree.

    Attributes:
        idx: Triangle indices, shape [n, capacity], int32; the first min(count, capacity) slots are used, the others hold f.
        count: True number of triangles per row, shape [n], int32; it may exceed the capacity.
        status: Bits of `Status`, shape [], int32.
        required: The capacity that holds every row, shape [], int32; like the status, over all updates.
        vertices: Corners of the wall [length], shape [v, d].
        faces: Vertex indices of each triangle, shape [f, d], int32.
        cells: The wall, sorted into cells (`TriangleCells`) or, by "bvh", into a tree (`TriangleTree`); None without triangles.
        cutoff: Distance [length], rounded to the dtype of the positions. Static.
        backend: The engine that made the list. Static.
        closed: Whether the faces bound a solid, shape [], bool, for `signed_distance`. None if faces were traced; each call then
            determines it.
    """

    idx: Array
    count: Array
    status: Array
    required: Array
    vertices: Array
    faces: Array
    cells: TriangleCells | TriangleTree | None
    cutoff: float = dataclasses.field(metadata={"static": True})
    backend: str = dataclasses.field(metadata={"static": True})
    closed: Array | None = None

    def __repr__(self) -> str:
        """Summarize the list in a line; waits for the device."""
        *batch, n, capacity = geometry.shape_of(self.idx)
        rows = f"batch of {batch}, {n} particles" if batch else f"{n} particles"
        faces = geometry.shape_of(self.faces)[-2]
        rest = f"engine {self.backend!r}, {geometry.pairs_and_status(self.count, self.status)}"
        return f"TriangleList({rows}, {faces} triangles, capacity {capacity}, cutoff {self.cutoff:.6g}, {rest})"

    @property
    def capacity(self) -> int:
        """Slots per row."""
        return self.idx.shape[-1]

    @property
    def _engine(self) -> TriangleEngine:
        return TRIANGLE_ENGINES[self.backend]

    @property
    def overflow(self) -> Array:
        """Whether a row lost triangles, shape [], bool."""
        with own_transfers():
            return (self.status & geometry.Status.ROW_OVERFLOW.value) != 0

    def update(self, positions: Points, vertices: Points | None = None) -> "TriangleList":
        """Rebuild the list at these positions, in the same shapes: a simulation step inside `jax.jit` or `lax.scan`.

        Status bits and `required` are kept over all updates; read `overflow` after a chunk of steps, `grow` and run it again.

        Args:
            positions: Particles [length], shape [n, d], where they are now; for a wall that moves as a whole, in the wall's frame.
            vertices: Corners [length], shape [v, d], of a deformed wall, which is then sorted again. Default: the vertices of the
                list, whose cells or tree are reused.

        Returns:
            A `TriangleList` of the same shapes and options.

        Raises:
            ValueError, TypeError: an argument does not fit the list.

        Differentiable: no gradient flows through. Jit: yes. vmap: yes.
        """
        points, corners = self._check_points(positions, vertices)
        cells = self.cells if vertices is None else None
        found = find_fields(points, corners, self.faces, cells, self.cutoff, self._engine, self.capacity)
        found |= {"status": found["status"] | self.status, "required": jnp.maximum(found["required"], self.required)}
        return dataclasses.replace(self, **found, closed=self._copy_closed())

    def grow(self, positions: Points, vertices: Points | None = None, *, slack: Real = 1.25) -> "TriangleList":
        """Make a list with a capacity that suffices at these positions. Not inside jit: the capacity is a shape.

        Args:
            positions: As in `update`.
            vertices: As in `update`.
            slack: Factor >= 1 on the longest row so far, including updates of this list.

        Returns:
            A `TriangleList` with the same options, a capacity not smaller than before, and status bits cleared.

        Raises:
            TypeError: positions, vertices or the list are traced.
            ValueError, TypeError: an argument does not fit the list.
        """
        points, corners = self._check_points(positions, vertices)
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((points, corners, self.required))):
            raise TypeError("grow() changes the shape of the list and cannot run inside jax.jit: call it on what jit returns.")
        with own_transfers():
            slack = geometry.check_slack(slack)
            met = round_capacity(math.ceil(slack * int(np.max(np.asarray(self.required)))))
        counted = count_slots(points, corners, self.faces, self.cutoff, self._engine, slack)
        capacity, cells = max(self.capacity, met, counted), self.cells if vertices is None else None
        found = find_fields(points, corners, self.faces, cells, self.cutoff, self._engine, capacity)
        return dataclasses.replace(self, **found, closed=self._copy_closed())

    def _copy_closed(self) -> Array | None:
        """Return a copy of `closed` for a new list: no two lists share memory, so either may be donated."""
        return None if self.closed is None else jnp.array(self.closed, copy=True)

    def check(self) -> None:
        """Raise what the status bits report; wait for the device. Not inside jit: there, read `status` and `overflow`.

        Raises:
            NeighborOverflowError: a row holds more triangles than `capacity`; `.required` is the capacity needed.
            ValueError: positions or vertices hold NaN or infinity, or faces have indices that no vertex has.
            TypeError: called on a list that is being traced.
        """
        if isinstance(self.status, Tracer):
            raise TypeError("check() reads values and cannot run inside jax.jit: call it on the list that jit returns.")
        self._check_rows()
        status = geometry.known_status(self.status)
        if status:
            raise ValueError(status.message)

    def _check_rows(self) -> None:
        """Raise if rows are known to lack triangles; a traced list is not checked."""
        if geometry.Status.ROW_OVERFLOW in (geometry.known_status(self.status) or geometry.Status.OK):
            raise geometry.NeighborOverflowError(int(np.max(jax.device_get(self.required))), self.capacity)

    def _mark(self, x: Array) -> Array:
        """Return what was computed of the rows; where the list is traced, NaN if triangles may be missing."""
        if not isinstance(self.status, Tracer):
            return x  # `_check_rows` has raised
        return geometry.mark_rows(x, geometry.are_whole(self.status, ~geometry.Status.ROW_OVERFLOW))

    def closest(self, positions: Points, vertices: Points | None = None) -> tuple[Array, Array, Array]:
        """Compute the nearest point of every triangle in a row.

        Distances, also to slivers, are accurate to 4 eps of the dtype times the largest coordinate of a corner relative to the
        particle: rounding has the effect of moving a triangle's corners by that much. The mask is exact.

        Args:
            positions: Particles [length], shape [n, d], where they are now.
            vertices: Corners [length], shape [v, d]; default: those of the list, as constants in derivatives.

        Returns:
            Points [length], shape [n, capacity, d], the particle's own position in masked slots; distances [length], shape [n,
            capacity], 0 there; and the mask, shape [n, capacity], bool: the slot is used and its triangle is closer than the cutoff
            at these positions, exactly.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError: outside jit, a row lacks triangles; inside, points and distances are NaN then.

        Differentiable: to any order in positions and vertices, where the nearest point does not jump; the gradient of a distance of
        0 is 0. Jit: yes. vmap: yes. Source: Ericson (2005), sect. 5.1.
        """
        return self._nearest_points(positions, vertices, one_per_wall=False)

    def contacts(self, positions: Points, vertices: Points | None = None) -> tuple[Array, Array, Array]:
        """Compute the contacts of spheres with walls: the nearest points of `closest`, one per wall instead of one per triangle.

        A triangle yields to another one of its row that has the corner or side on which its nearest point lies and that is nearer,
        or equally near with a lower index; so does one of two triangles whose nearest points are equal within rounding. A sphere
        has one contact on a flat wall of many triangles, over a convex edge and over a corner, and one per wall in a concave edge
        or corner. On a surface that curves around it, such as the inside of a pipe, it has one with each triangle whose face it is
        over. The nearest triangle of a row is always a contact.

        Triangles are adjacent if they share vertex indices: `jfrnn.merge_vertices` joins vertices that are stored separately, as in
        STL files. A vertex in the middle of another triangle's side joins nothing; contacts may double there.

        Args:
            positions: As in `closest`.
            vertices: As in `closest`.

        Returns:
            Points [n, capacity, d], distances [n, capacity] and the mask [n, capacity], as `closest` returns them; slots that are
            no contacts are masked.

        Raises:
            ValueError, TypeError, NeighborOverflowError: as `closest`.

        Cost: n times the longest row, squared; memory as `closest`. Differentiable: as `closest`; the mask is constant. Jit: yes.
        vmap: yes.

        Example:
        >>> import jax.numpy as jnp
        >>> import jfrnn
        >>> plate = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        >>> x = jnp.array([[0.5, 0.4, 0.1]])
        >>> tri = jfrnn.search_triangles(x, plate, jnp.array([[0, 1, 2], [0, 2, 3]]), 0.3, capacity=2)
        >>> tri.count, tri.contacts(x)[2].sum()
        (Array([2], dtype=int32), Array(1, dtype=int32))
        """
        return self._nearest_points(positions, vertices, one_per_wall=True)

    def _nearest_points(self, positions: Points, vertices: Points | None, one_per_wall: bool) -> tuple[Array, Array, Array]:
        points, corners = self._check_points(positions, vertices)
        self._check_rows()
        if 0 in (*self.idx.shape, self.faces.shape[0]):
            none = jnp.zeros(self.idx.shape, points.dtype)
            return jnp.broadcast_to(points[:, None], (*self.idx.shape, points.shape[1])), none, none > 0
        vectors, feature, mask = _nearest_in_rows(self, points, corners)
        if one_per_wall:
            vectors, mask = _contacts_in_rows(self, points, corners, vectors, feature, mask)
        vectors = self._mark(vectors)
        return points[:, None] + vectors, norms(vectors), mask

    def signed_distance(self, positions: Points, vertices: Points | None = None) -> SignedDistance:
        """Compute the distance to the nearest triangle of each row, negative inside the solid that the triangles enclose.

        A point is inside if the winding number of the triangles is 1 or more, so closed parts that overlap, touch, nest or are
        doubled form one solid. For a wall that encloses a negative volume, such as a container whose faces look at its fluid,
        inside is where the number is 0 or more. Faces run counterclockwise as seen from outside the solid (in 2D, segments
        counterclockwise around it). The distance is to the nearest triangle, even if that lies inside the solid, within another
        part. Within rounding of a triangle, about 100 eps of the dtype times its largest coordinate relative to the particle, and
        for a wall that is not watertight, the sign is that of the angle-weighted pseudonormal of the nearest face, side or vertex.

        Args:
            positions: As in `closest`.
            vertices: As in `closest`.

        Returns:
            A `SignedDistance`: distance [n], mask [n], normal [n, d], and whether the mesh is watertight.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError: as `closest`.

        Cost: that of the rows, and a ray through a tree of boxes for each particle that has a triangle. The tree is that of the
        list if "bvh" made it; otherwise, and with `vertices`, each call makes one. Compilation takes seconds for each new number of
        particles, slots or faces, as for `closest`, however few faces there are. Differentiable: to any order in positions and
        vertices, where the nearest point does not jump; at contact the derivative is that of the plane of the normal. Jit: yes.
        vmap: yes. Source: Baerentzen & Aanaes (2005), doi:10.1109/TVCG.2005.49.
        """
        points, corners = self._check_points(positions, vertices)
        self._check_rows()
        if 0 in (*self.idx.shape, self.faces.shape[0]):
            none = jnp.zeros(points.shape[0], points.dtype)
            return SignedDistance(none, none > 0, jnp.zeros_like(points), _watertight_alone(self, corners))
        tri = self if vertices is None else dataclasses.replace(self, cells=None)
        found = _signed_distance(tri, points, corners)
        return found._replace(distance=self._mark(found.distance), normal=self._mark(found.normal))

    def between(self, positions: Points, pairs: IndexRows, vertices: Points | None = None) -> Array:
        """Say between which particles there is a triangle: pairs that a thin wall parts, as `exclude` of `pair_sum` wants them.

        A pair is parted iff the segment from one particle to the other meets a closed triangle (face, sides and corners) at one
        point, in exact arithmetic on the given floats; a segment in the plane of a triangle is not parted by it. Triangles are
        those of the row of the first particle: all that there are, where the particles are closer than the cutoff of the list.

        Args:
            positions: As in `closest`.
            pairs: Numbers of two particles each, shape [e, 2], integers. A pair with a number that no particle has is padding.
            vertices: As in `closest`.

        Returns:
            Whether a triangle is between them, shape [e], bool; False for padding.

        Raises:
            ValueError, TypeError: an argument does not fit the list.
            NeighborOverflowError: outside jit, a row lacks triangles; inside, triangles may then be missed: see `overflow`.

        Cost: pairs whose first particle has triangles, times the longest row among them. Differentiable: no. Jit: yes. vmap: yes.
        Source: Möller & Trumbore (1997), doi:10.1080/10867651.1997.10487468, decided by signs in exact arithmetic.

        Example:
        >>> import jax.numpy as jnp
        >>> import jfrnn
        >>> plate = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        >>> x = jnp.array([[0.5, 0.4, 0.1], [0.6, 0.4, -0.1], [0.7, 0.4, 0.1]])
        >>> tri = jfrnn.search_triangles(x, plate, jnp.array([[0, 1, 2], [0, 2, 3]]), 0.3, capacity=2)
        >>> tri.between(x, jnp.array([[0, 1], [0, 2], [1, 2], [-1, -1]])).tolist()
        [True, False, True, False]
        """
        points, corners = self._check_points(positions, vertices)
        asked = as_array("pairs", pairs)
        if not hasattr(asked, "dtype") or not np.issubdtype(asked.dtype, np.integer) or asked.shape[1:] != (2,):
            told = f"{asked.dtype} of shape {list(asked.shape)}" if hasattr(asked, "dtype") else type(asked).__name__
            raise TypeError(f"pairs must be integers of shape [e, 2], the numbers of two particles in each row, got {told}.")
        self._check_rows()
        if 0 in (*self.idx.shape, self.faces.shape[0], len(asked)):
            return jnp.zeros(len(asked), bool)
        return _are_parted(self, points, corners, jnp.asarray(asked))

    def _check_points(self, positions: Points, vertices: Points | None) -> tuple[Array, Array]:
        dtype, (count, dim) = np.dtype(self.vertices.dtype), self.vertices.shape[-2:]  # of several walls, which vmap made, too
        points = geometry.check_again("positions", positions, dtype, dim, self.idx.shape[-2], self.idx)
        if self.idx.ndim != 2:
            raise ValueError(f"a list at a time is asked, got idx of shape {list(self.idx.shape)}: take jax.vmap, as made it.")
        if vertices is None:
            return points, self.vertices
        return points, geometry.check_again("vertices", vertices, dtype, dim, count, self.idx)


@compile_program
def _nearest_in_rows(tri: TriangleList, points: Array, vertices: Array) -> tuple[Array, Array, Array]:
    """Return vectors to nearest points [n, capacity, d], their features, and which slots hold a pair."""
    used = lax.broadcasted_iota(jnp.int32, tri.idx.shape, 1) < tri.count[:, None]
    corners, finite, there = gather_corners(vertices, tri.faces)
    triangle = jnp.where(used, tri.idx, 0)
    cutoff = geometry.make_cutoff(tri.cutoff, np.dtype(points.dtype), closed=False)
    are_pairs = functools.partial(are_near, decide=tri._engine.decide)
    near = call_apart(are_pairs, *lax.stop_gradient((points, corners)), triangle, cutoff, used & (finite & there)[triangle])
    mask = near & jnp.all(jnp.isfinite(points), axis=1)[:, None]
    shapes = jnp.where(mask[..., None, None], corners[triangle], 0)
    vectors, feature = nearest_of(jnp.where(mask[..., None], points[:, None], 0), shapes)
    return jnp.where(mask[..., None], vectors, 0), feature, mask


@compile_program
def _contacts_in_rows(
    tri: TriangleList, points: Array, vertices: Array, vectors: Array, feature: Array, mask: Array
) -> tuple[Array, Array]:
    """Return the vectors to nearest points [n, capacity, d] of contacts, 0 elsewhere, and which slots are contacts."""
    points, vertices, fixed = lax.stop_gradient((points, vertices, vectors))
    triangle = jnp.where(mask, tri.idx, 0)
    seen = jnp.where(mask[..., None, None], vertices[tri.faces[triangle]] - points[:, None, None], 0)
    kept = are_contacts(mask, triangle, tri.faces, seen, fixed, norms(fixed), feature)
    return jnp.where(kept[..., None], vectors, 0), kept


@compile_program
def _are_parted(tri: TriangleList, points: Array, vertices: Array, pairs: Array) -> Array:
    corners, finite, there = gather_corners(vertices, tri.faces)
    wide = pairs if pairs.dtype.itemsize > 2 else pairs.astype(jnp.int32)  # which holds how many particles there are
    known = jnp.where((wide >= 0) & (wide < tri.idx.shape[0]), wide, -1).astype(jnp.int32)
    used = jnp.minimum(tri.count, tri.capacity)
    return call_apart(are_crossed, *lax.stop_gradient((points, corners)), finite & there, tri.idx, used, known)


def _is_watertight(tri: TriangleList, good: Array) -> Array:
    """Say whether a wall whose faces are all `good` [f] bool encloses something, or has none: [] bool."""
    return (is_closed(tri.faces) if tri.closed is None else tri.closed) & jnp.all(good)


@compile_program
def _watertight_alone(tri: TriangleList, vertices: Array) -> Array:
    """Say whether a wall with these vertices [v, d] is watertight, where there is nothing else to say."""
    _, finite, there = gather_corners(vertices, tri.faces)
    return _is_watertight(tri, finite & there)


@compile_program
def _signed_distance(tri: TriangleList, points: Array, vertices: Array) -> SignedDistance:
    corners, finite, there = gather_corners(vertices, tri.faces)
    fixed, at, good = *lax.stop_gradient((corners, points)), finite & there
    cutoff, used = geometry.make_cutoff(tri.cutoff, np.dtype(points.dtype), closed=False), jnp.minimum(tri.count, tri.capacity)
    slot, some = call_apart(functools.partial(nearest_slots, decide=tri._engine.decide), at, fixed, tri.idx, used, good, cutoff)
    triangle = jnp.where(some, jnp.take_along_axis(tri.idx, slot[:, None], axis=1)[:, 0], 0)
    shapes = jnp.where(some[:, None, None], corners[triangle], 0)
    vectors, feature = nearest_of(jnp.where(some[:, None], points, 0), shapes)
    away, distance = -vectors, norms(vectors)
    apart = some & (distance > 0)
    watertight = _is_watertight(tri, good)
    tree = tri.cells if isinstance(tri.cells, TriangleTree) else None

    def sides(tree: TriangleTree | None, corners: Array, points: Array, good: Array, asked: Array) -> tuple[Array, Array]:
        """Say which of the points asked for are inside, and which of them no ray decides: [n] bool each."""
        tree = grow_tree(corners, good, cutoff) if tree is None else tree
        rays, least = ray_ways(points.shape[1], np.dtype(points.dtype)), least_winding(corners, good)
        return tri._engine.cast(tree, corners, points, rays, asked, least, cutoff)

    inside, unknown = call_apart(sides, tree, fixed, at, good, apart & watertight)
    by_normal = some & (unknown | ~(apart & watertight))
    normal = call_apart(pseudonormals, tri.idx, used, triangle, feature, tri.faces, fixed, good, by_normal)
    height = jnp.sum(normal * away, axis=1)
    signed = jnp.where(jnp.where(by_normal, height < 0, inside), -distance, distance)
    signed = jnp.where(distance > 0, signed, height)
    grows = jnp.where(apart[:, None], away / jnp.where(apart, signed, 1)[:, None], jnp.where(some[:, None], normal, 0))
    return SignedDistance(jnp.where(some, signed, 0), some, grows, watertight)
