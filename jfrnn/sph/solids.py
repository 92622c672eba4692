"""A wall of triangles that stands or turns: what it does to the fluid, and that nothing passes it.

What acts is that of a half-space of fluid at rest in the wall, behind the plane of the nearest point, integrated in closed form
instead of summed over dummies: right at a plane, and at edges and corners as far as they are like one. It takes one signed distance
per particle and no particles of its own, whatever the size of triangles.

Nothing passes, whatever the forces do: `keep_out` begins at a place outside, in the frame of the wall, by more than half a gap, and
ends at one. The step is shorter than half the cutoff, or is not taken. So where no triangle is within the cutoff of its end, none
is between its ends; and where one is, the signed distance of the end tells its side, by a theorem for closed meshes. A particle
that ends nearer than a gap is put one gap away; one that after that is not outside by half a gap stays where it was, and moves with
the wall. Rounding is many orders smaller than the gap.

In a periodic box the wall has images, of which no particle sees two, or sees them as one that goes on: `check_images` refuses
others. Triangles are where the scene has them, and particles are looked at as their images nearest to the wall.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene, Scene, Solid, Turning
from jfrnn.sph import sight
from jfrnn.sph.errors import SceneError
from jfrnn.sph.inside import find_inside
from jfrnn.sph.kernels import KERNELS, Kernel
from jfrnn.sph.pairs import reach
from jfrnn.sph.particles import Beside, Model, State, active, box_of, periods_from
from jfrnn.sph.viscosity import kinematic

_STRAIGHT = 1e-6  # component of a unit vector along an axis, up to which it stands across
GAP = 0.2  # particle spacings: on a lattice, particles at a wall are half a spacing away
_ROOM_AROUND = 2  # times the particles that are near a point in a fluid on a lattice
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_PLACES, _SHARES = (_NODES + 1) / 2, _WEIGHTS / 2
_Mesh = Solid | jfrnn.TriangleList


def begin(scene: FluidScene, x: Array, angle: Array | None = None) -> Beside | None:
    """Look at the solid of a scene from positions x [m], shape [n, d], the wall having turned by an angle [rad]; None without one.

    Raises:
        SceneError: The mesh is not closed, or a particle of the fluid is in it.
    """
    solid = scene.solid
    if solid is None:
        return None
    vertices, faces, cutoff = jnp.asarray(solid.vertices, x.dtype), jnp.asarray(solid.faces), _reach(scene)
    turning, goes_on = turning_of(scene, x.dtype), angle is not None
    angle = jnp.zeros((), x.dtype) if turning is not None and angle is None else angle
    placed = replace(solid, vertices=vertices, faces=faces)
    at = into_frame(_images(box_of(scene, x.dtype), x, placed, turning), turning, angle)
    tri = jfrnn.search_triangles(at, vertices, faces, cutoff)
    signed = tri.signed_distance(at)
    if not signed.watertight:
        raise SceneError(
            "solid must be a closed mesh whose faces run counterclockwise as seen from the fluid: they run through one side more "
            "often one way than the other. If corners are written once per triangle, as in STL files, join them first."
        )
    if not goes_on:  # of a run that goes on, who is in the way of a turning wall has left or is not there yet
        _refuse(scene, np.asarray(signed.mask & (signed.distance < GAP / 2 * scene.spacing)))
    corners = np.asarray(vertices)[solid.faces]
    asked = sight.points_to_ask(corners, cutoff)
    on_wall = jfrnn.search_triangles(asked[0], vertices, faces, cutoff)
    thin = sight.is_thin(corners, asked, on_wall) if solid.thin is None else solid.thin
    capacity = -(-int(on_wall.required) * 3 // 16) * 8  # half as many again; a run that needs more is told by `overflow`
    if tri.capacity < capacity:
        tri = jfrnn.search_triangles(at, vertices, faces, cutoff, capacity=capacity)
    seen = Beside(tri, angle, signed.mask, signed.distance, signed.normal)
    if not thin:
        return seen
    if _narrow_axes(scene):
        raise SceneError(
            "solid is thinner than the kernel reaches, and may not run through a periodic box then: lines of sight end at its "
            "borders. Take a thicker solid, or walls of dummies."
        )
    neighbors = _neighbors(scene.spacing, cutoff, scene.dim)
    return _look_through(seen, at, sight.make_room(np.array([int(jnp.sum(tri.count > 0)), 0, 0]), neighbors, scene.n), neighbors)


def _refuse(scene: FluidScene, inside: np.ndarray) -> None:
    if scene.wall is not None:
        inside = inside & ~scene.wall
    if inside.any():
        raise SceneError(
            f"positions of the fluid must be outside the solid by {GAP / 2} spacings: particle {inside.argmax()} is not. If it "
            "seems to be, the faces of the solid are inside out."
        )


def check_far(scene: FluidScene, x: Array, seen: Beside | None) -> None:
    """Refuse a fluid that begins inside the solid, so deep that it sees no face: `begin` knows of those that do."""
    if seen is None or scene.solid is None:
        return
    far, corners = ~np.asarray(seen.mask), np.asarray(scene.solid.vertices, np.float64)[scene.solid.faces]
    inside, turning = np.zeros(scene.n, bool), turning_of(scene, x.dtype)
    at = _images(box_of(scene, x.dtype), x, seen.tri, turning)
    inside[far] = find_inside(np.asarray(at, np.float64)[far], _reach(scene), corners)
    _refuse(scene, inside)


def _neighbors(spacing: float, cutoff: float, dim: int) -> float:
    """Return how many neighbors a particle in the fluid has."""
    return (math.pi if dim == len("xy") else 4 / 3 * math.pi) * (cutoff / spacing) ** dim


def _look_through(seen: Beside, at: Array, room: sight.Sight, neighbors: float) -> Beside:
    """Return what is seen with the pairs that the wall parts, in room enough."""
    while True:
        found = sight.look(room, seen.tri, at, seen.normal, None)
        if not found.overflow:
            return seen._replace(sight=found)
        room = sight.make_room(np.asarray(found.required), neighbors, len(at))


def hidden(model: Model, s: State, beside: Beside, points: Array) -> tuple[Array, Array]:
    """Find the particles that cannot be seen from points [m], shape [k, d], because a triangle is between.

    Returns pairs of a point and a particle within the cutoff that the wall parts, shape [e, 2], int32, -1 where there are fewer;
    and whether there was room for all of them, shape [].
    """
    count, (n, dim) = len(points), s.x.shape
    room = math.ceil(_ROOM_AROUND * count * _neighbors(model.spacing, model.cutoff, dim))
    x, points = (_images(model.box, each, beside.tri, model.turning) for each in (s.x, points))
    edges = jfrnn.search_edges(x, model.cutoff, queries=points, active=active(model, s), total=min(room, count * n))
    at, seen = (into_frame(each, model.turning, beside.angle) for each in (x, points))
    tri, rows = beside.tri, jnp.concatenate([at, jnp.broadcast_to(at[:1], seen.shape)])
    around = jfrnn.search_triangles(rows, tri.vertices, tri.faces, tri.cutoff, capacity=tri.capacity)  # rows of particles are read
    asked = jnp.stack([edges.senders, n + edges.receivers], axis=1)
    parted = around.between(jnp.concatenate([at, seen]), asked)
    pairs = jnp.stack([edges.receivers, edges.senders], axis=1)
    return jnp.where(parted[:, None], pairs, -1), ~(edges.overflow | around.overflow)


def grow(model: Model, s: State, after: Beside) -> State:
    """Return a state that sees the wall with more room: with what turned out to be needed until `after`."""
    assert s.solid is not None, "there is a wall"
    x = _images(model.box, s.x, s.solid.tri, model.turning)
    at = into_frame(x, model.turning, s.solid.angle)
    seen = s.solid._replace(tri=after.tri.grow(at) if after.tri.overflow else s.solid.tri)
    if after.sight is not None and after.sight.overflow:
        neighbors = _neighbors(model.spacing, model.cutoff, s.x.shape[1])
        seen = _look_through(seen, at, sight.make_room(np.asarray(after.sight.required), neighbors, len(at)), neighbors)
    return s._replace(solid=seen)


def _reach(scene: FluidScene) -> float:
    return reach(KERNELS[scene.physics.kernel], scene.physics.smoothing)


def turning_of(scene: Scene, dtype: np.dtype | type) -> Turning[Array, Array] | None:
    """Return how the solid of a scene turns, numbers of a dtype; None where it stands, or is none."""
    turning = scene.solid and scene.solid.turning
    if turning is None:
        return None
    axis = None if turning.axis is None else jnp.asarray(turning.axis, dtype) / np.linalg.norm(turning.axis)
    return fluids.Turning(jnp.asarray(turning.center, dtype), axis, jnp.asarray(turning.rate, dtype))


def check_images(scene: FluidScene) -> None:
    """Refuse a periodic box in which a particle might be within reach of two images of the solid, however that has turned.

    Of a solid that runs straight through the box, and beyond it farther than a particle sees, each image goes on in the next.
    """
    for k, least in _narrow_axes(scene).items():
        if not _runs_through(scene, k):
            assert scene.periodic is not None, "axes of a box are narrow"
            raise SceneError(
                f"periodic box must be {least:.6g} m wide along {'xyz'[k]} beside this solid, so that no particle is within reach "
                f"of two images of it, got {scene.periodic.lengths[k]:.6g} m: take a larger box, walls of dummies, or a solid that "
                f"runs straight through the box, at both ends at least {_reach(scene):.6g} m beyond it."
            )


def _narrow_axes(scene: FluidScene) -> dict[int, float]:
    """Return the periodic axes along which there may be two images of the solid within reach, and the width [m] that parts them."""
    solid, box, reach_of = scene.solid, scene.periodic, _reach(scene)
    if solid is None or box is None:
        return {}
    r, axis = _from_middle(solid)
    r = r.reshape(-1, scene.dim)
    if solid.turning is None:
        farthest = np.abs(r).max(axis=0)
    else:
        along = r @ axis
        around = np.linalg.norm(r - along[:, None] * axis, axis=1)
        farthest = (np.abs(along[:, None] * axis) + around[:, None] * np.sqrt(np.maximum(1 - axis**2, 0))).max(axis=0)
    least = 2 * (farthest + reach_of)
    return {k: float(least[k]) for k in range(scene.dim) if box.axes[k] and box.lengths[k] < least[k]}


def _runs_through(scene: FluidScene, k: int) -> bool:
    """Say whether the solid is the same all along an axis of the periodic box, as far as a particle sees, and stays so."""
    assert scene.solid is not None and scene.periodic is not None, "an axis is narrow"
    r, axis = _from_middle(scene.solid)
    far = scene.periodic.lengths[k] / 2 + _reach(scene)
    low, high = r[..., k].min(axis=1), r[..., k].max(axis=1)
    across = sight.normals_of(r[(low < far) & (high > -far)])[:, k]
    turns_along = scene.solid.turning is None or abs(axis[k]) > 1 - _STRAIGHT
    return turns_along and low.min() <= -far and high.max() >= far and bool(np.all(np.abs(across) < _STRAIGHT))


def _from_middle(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of faces [m], shape [f, d, d], as seen from the middle of the solid, and the axis about which it turns."""
    corners, turning = np.asarray(solid.vertices, np.float64)[solid.faces], solid.turning
    axis = np.zeros(corners.shape[2])
    if turning is not None:
        axis = axis if turning.axis is None else np.asarray(turning.axis, np.float64) / np.linalg.norm(turning.axis)
        turning = replace(turning, center=np.asarray(turning.center, np.float64), axis=None if turning.axis is None else axis)
    return corners - _middle(corners, turning), axis


def _middle(corners: Any, turning: Turning[Any, Any] | None) -> Any:  # noqa: ANN401
    """Return the point about which a solid lies, shape [d]: the middle of its faces; of one that turns, that of its axis in it."""
    corners = corners.reshape(-1, corners.shape[-1])
    if turning is None:
        return (corners.min(axis=0) + corners.max(axis=0)) / 2
    if turning.axis is None:
        return turning.center
    along = ((corners - turning.center) * turning.axis).sum(axis=1)
    return turning.center + (along.min() + along.max()) / 2 * turning.axis


def _periods(box: jfrnn.Box | None, x: Array, mesh: _Mesh, turning: Turning[Array, Array] | None) -> Array | None:
    """Return how far positions [n, d] are from their images nearest to a solid [m], shape [n, d]; None in open space."""
    return None if box is None else periods_from(box, x, _middle(mesh.vertices[mesh.faces], turning))


def _images(box: jfrnn.Box | None, x: Array, mesh: _Mesh, turning: Turning[Array, Array] | None) -> Array:
    """Return of positions [n, d] in a periodic box the images nearest to a solid [m]; in open space the positions."""
    return _less(x, _periods(box, x, mesh, turning))


def _less(x: Array, periods: Array | None) -> Array:
    return x if periods is None else x - periods


def into_frame(x: Array, turning: Turning[Array, Array] | None, angle: Array | None) -> Array:
    """Return positions [n, d] as the wall sees them that has turned by an angle [rad]: it stands, they have turned back."""
    return x if turning is None or angle is None else turning.center + _turn(x - turning.center, turning, -angle)


def _leave_frame(x: Array, turning: Turning[Array, Array] | None, angle: Array | None) -> Array:
    return x if turning is None or angle is None else turning.center + _turn(x - turning.center, turning, angle)


def _turn(r: Array, turning: Turning[Array, Array] | None, angle: Array | None) -> Array:
    """Turn vectors [n, d]. Source: Rodrigues (1840)."""
    if turning is None or angle is None:
        return r
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    if turning.axis is None:
        return r * cosine + _across(r, turning) * sine
    along = jnp.sum(r * turning.axis, axis=1, keepdims=True) * turning.axis
    return along + (r - along) * cosine + _across(r, turning) * sine


def _across(r: Array, turning: Turning[Array, Array]) -> Array:
    """Return axis × r, shape [n, d]."""
    return jnp.stack([-r[:, 1], r[:, 0]], axis=1) if turning.axis is None else jnp.cross(turning.axis, r)


def keep_out(model: Model, s: State, x: Array, v: Array, dt: Array, rests: Array | None) -> State:
    """Return the state after a step, at positions near x that are outside of the wall; see the head of this file.

    A particle that meets the wall loses the velocity toward it, one that stays with it takes its velocity. Steps would end at x [m]
    with velocities v [m/s], shape [n, d] each; particles that rest, shape [n], bool, do not move.
    """
    if s.solid is None:
        return s._replace(x=x, v=v)
    old, gap, turning = s.solid, GAP * model.spacing, model.turning
    angle = None if turning is None or old.angle is None else old.angle + dt * turning.rate
    periods = _periods(model.box, x, old.tri, turning)
    before, ends = into_frame(_less(s.x, periods), turning, old.angle), into_frame(_less(x, periods), turning, angle)
    tri = old.tri.update(ends)

    def look(points: Array, _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        there = tri.signed_distance(points)
        lacks = jnp.where(there.mask & (there.distance < gap), gap - there.distance, 0)
        return points + lacks[:, None] * there.normal, (there.mask, there.distance, there.normal)

    _, looks = jax.lax.scan(look, ends, None, length=2)  # where steps end, and where they end once they are put right
    (mask, distance, normal), after = (tuple(both[k] for both in looks) for k in range(2))
    meets = mask & (distance < gap)
    placed = ends + jnp.where(meets, gap - distance, 0)[:, None] * normal
    far = jnp.sum((placed - before) ** 2, axis=1) > (model.cutoff / 2) ** 2
    stays = far | (after[0] & (after[1] < gap / 2))
    if rests is not None:
        meets, stays = meets & ~rests, stays & ~rests
    kept = _leave_frame(jnp.where(stays[:, None], before, placed), turning, angle)
    kept = kept if periods is None else kept + periods
    x = jnp.where((meets | stays)[:, None], kept, x)
    wall, normal = jnp.zeros_like(v), _turn(normal, turning, angle)
    if turning is not None:
        wall = turning.rate * _across(_less(x, periods) - turning.center, turning)
    toward = jnp.minimum(jnp.sum((v - wall) * normal, axis=1), 0)
    v = jnp.where(meets[:, None], v - toward[:, None] * normal, v)
    v = jnp.where(stays[:, None], wall, v)
    seen = [
        jnp.where(stays if was.ndim == 1 else stays[:, None], was, now)
        for was, now in zip((old.mask, old.distance, old.normal), after, strict=True)
    ]
    now = Beside(tri, angle, seen[0], seen[1], seen[2])
    if old.sight is not None:
        at = jnp.where(stays[:, None], before, placed)
        tri = tri.update(at)  # no triangle is missing in the row of a particle that was put right
        now = now._replace(tri=tri, sight=sight.look(old.sight, tri, at, now.normal, active(model, s)))
    return s._replace(x=x, v=v, solid=now)


def integrate_missing(kernel: Kernel, distance: Array, h: float, dim: int) -> tuple[Array, Array]:
    """Integrate a kernel behind a plane at distances d [m], shape [n], from 0 on; return A and Γ, shape [n] each.

    A(d) = ∫ W over the plane [1/m]: the gradient at the particle of what lies behind is -A n. Γ(d) = ∫_d A, the weight of what
    lies behind. By Gauss's rule with 8 nodes, exact for Wendland kernels in 3D. Source: Kulasegaram, Bonet, Lewis & Profit (2004),
    doi:10.1007/s00466-003-0524-0, for walls by integrals.
    """
    support = kernel.support * h
    near = jnp.minimum(distance, 0.999 * support)[:, None]  # beyond, both are below 1e-9, and roots have no slope
    r = near + (support - near) * _PLACES.astype(near.dtype)
    share = (support - near) * _SHARES.astype(near.dtype)
    if dim == 3:
        rings = 2 * jnp.pi * share * r * kernel.value(r, h, dim)
        return jnp.sum(rings, axis=1), jnp.sum(rings * (r - near), axis=1)
    return _line(kernel, near[:, 0], h), jnp.sum(share * _line(kernel, r, h), axis=1)


def _line(kernel: Kernel, distance: Array, h: float) -> Array:
    """Integrate a kernel in 2D along a line at distances below its support, any shape."""
    half = jnp.sqrt((kernel.support * h) ** 2 - distance**2)[..., None]
    r = jnp.sqrt(distance[..., None] ** 2 + (half * _PLACES.astype(half.dtype)) ** 2)
    return 2 * jnp.sum(half * _SHARES.astype(half.dtype) * kernel.value(r, h, 2), axis=-1)


class _Acting(NamedTuple):
    """What acts on a particle: A [1/m] and Γ, shape [n], 0 beyond reach; the normal, and the wall's velocity and acceleration."""

    area: Array
    weight: Array
    distance: Array
    normal: Array
    slip: Array
    acceleration: Array | None


def _find_acting(model: Model, s: State, beside: Beside) -> _Acting:
    there = active(model, s)
    mask = beside.mask if there is None else beside.mask & there
    distance = jnp.where(mask, jnp.maximum(beside.distance, 0), 0)
    sums = integrate_missing(model.kernel, distance, model.physics.smoothing, s.x.shape[1])
    area, weight = (jnp.where(mask, part, 0) for part in sums)
    normal, turning = _turn(beside.normal, model.turning, beside.angle), model.turning
    if turning is None:
        return _Acting(area, weight, distance, normal, s.v, None)
    x = _images(model.box, s.x, beside.tri, turning)
    velocity = turning.rate * _across(x - distance[:, None] * normal - turning.center, turning)
    return _Acting(area, weight, distance, normal, s.v - velocity, turning.rate * _across(velocity, turning))


def compression(model: Model, s: State, beside: Beside, rho: Array) -> Array:
    """Return what the wall adds to dρ/dt [kg/m³/s], shape [n]: -ρ A (v - v_wall)·n."""
    wall = _find_acting(model, s, beside)
    return -rho * wall.area * jnp.sum(wall.slip * wall.normal, axis=1)


def push(model: Model, s: State, beside: Beside, rho: Array, p: Array) -> Array:
    """Return what the wall adds to accelerations [m/s²], shape [n, d].

    Pressure: 2p/ρ A n - (g - a_wall)·n (d A + Γ) n, the wall's pressure being that of the particle, carried on by what acts on the
    fluid; none where that would pull: single particles, less dense than at rest, would run along the wall and around its edges.
    Viscosity, where the fluid is held: -2ν A/d (v - v_wall), that of a velocity which changes its sign at the wall.
    Source: Adami, Hu & Adams (2012), doi:10.1016/j.jcp.2012.05.005, eq. 23, for the pressure in the wall; Morris, Fox & Zhu (1997),
    doi:10.1006/jcph.1997.5776, eqs. 22 and 28; both integrated over a half-space.
    """
    physics, wall = model.physics, _find_acting(model, s, beside)
    along = 2 * p / rho * wall.area
    body = None if physics.gravity is None else jnp.broadcast_to(physics.gravity, s.x.shape)
    if wall.acceleration is not None:
        body = -wall.acceleration if body is None else body - wall.acceleration
    if body is not None:
        along = along - jnp.sum(body * wall.normal, axis=1) * (wall.distance * wall.area + wall.weight)
    a = jnp.maximum(along, 0)[:, None] * wall.normal
    if physics.viscosity is not None and not physics.slip:
        drag = 2 * kinematic(physics.viscosity_form, physics.viscosity, rho) * wall.area
        a = a - (drag / jnp.maximum(wall.distance, model.spacing / 2))[:, None] * wall.slip
    return a


def load(model: Model, s: State, beside: Beside, rho: Array, p: Array) -> tuple[Array, Array]:
    """Return what the fluid does to the wall, per mass of each particle [m/s²], and at which points [m]; shape [n, d] each.

    It is `push`, turned, and 2ν A n × ω on a wall that turns at ω: the viscous stress is that of the gradient and its transpose, of
    which a Laplacian needs the first only. The second changes neither the flow nor the force on a solid that is wet all around, but
    takes 2μω times its volume off the torque, as in a fluid that turns with it and does nothing to it.
    """
    physics, wall, onto = model.physics, _find_acting(model, s, beside), -push(model, s, beside, rho, p)
    if model.turning is not None and physics.viscosity is not None and not physics.slip:
        spin = model.turning.rate * _across(wall.normal, model.turning)
        onto = onto - (2 * kinematic(physics.viscosity_form, physics.viscosity, rho) * wall.area)[:, None] * spin
    x = _images(model.box, s.x, beside.tri, model.turning)
    return onto, x - wall.distance[:, None] * wall.normal


def rim_speed(model: Model, beside: Beside) -> Array:
    """Return the largest speed of the wall [m/s], shape []."""
    tri, turning = beside.tri, model.turning
    if turning is None:
        return jnp.zeros((), tri.vertices.dtype)
    r = tri.vertices[tri.faces].reshape(-1, tri.vertices.shape[1]) - turning.center
    across = r if turning.axis is None else _across(r, turning)
    return jnp.abs(turning.rate) * jnp.max(jnp.linalg.norm(across, axis=1))


def clearance(scene: Scene, s: State) -> np.ndarray | None:
    """Return the signed distances [m] of the fluid to the solid of its scene, shape [n], infinite where it is beyond reach.

    Triangles are searched and distances computed anew, at the positions of the state.
    """
    if s.solid is None:
        return None
    turning = turning_of(scene, s.x.dtype)
    x = _images(box_of(scene, s.x.dtype), s.x, s.solid.tri, turning)
    at = into_frame(x, turning, s.solid.angle)
    signed = s.solid.tri.update(at).signed_distance(at)
    free = np.asarray(signed.mask) if scene.wall is None else np.asarray(signed.mask) & ~scene.wall
    if s.gone is not None:
        free = free & ~np.asarray(s.gone)
    if scene.enters is not None:
        free = free & (np.asarray(s.time) >= scene.enters)
    return np.where(free, np.asarray(signed.distance), np.inf)
