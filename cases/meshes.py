"""Meshes of walls: vertices and faces that run counterclockwise as seen from outside. All but `plate` are watertight.

>>> vertices, faces = gear(teeth=12, faces=2000)
>>> vertices.shape, faces.shape
((960, 3), (1920, 3))
"""

import math

import numpy as np
from numpy.typing import NDArray

from ._check import positive, whole

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]  # vertices [v, d], faces [f, d]


def cube(edge: float = 1.0, divisions: int = 1) -> Mesh:
    """Make a cube around the origin; each side is cut into `divisions` squares along either edge: 12 divisions² faces."""
    sites = np.linspace(-0.5, 0.5, whole("divisions", divisions, 1) + 1)
    u, v = (grid.reshape(-1) for grid in np.meshgrid(sites, sites, indexing="ij"))
    parts, corners = [], []
    for axis in range(3):
        for sign in (-1, 1):
            side = np.empty((u.size, 3))
            side[:, axis], side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = sign / 2, u, v
            parts.append(_grid_faces(divisions, divisions, len(corners) * u.size, sign > 0))
            corners.append(side)
    vertices, place = np.unique(np.concatenate(corners), axis=0, return_inverse=True)
    return vertices * positive("edge", edge), place.reshape(-1)[np.concatenate(parts)].astype(np.int32)


def sphere(radius: float = 1.0, divisions: int = 4) -> Mesh:
    """Make a sphere around the origin: a cube of 12 divisions² faces, blown up."""
    vertices, faces = cube(2.0, divisions)
    return positive("radius", radius) * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def plate(lengths: tuple[float, float] = (1.0, 1.0), divisions: tuple[int, int] = (1, 1)) -> Mesh:
    """Make a sheet without thickness in the plane z = 0 around the origin, its outside above: 2 faces per rectangle. Not closed."""
    across = [
        np.linspace(-0.5, 0.5, whole("divisions", n, 1) + 1) * positive("lengths", x)
        for x, n in zip(lengths, divisions, strict=True)
    ]
    x, y = (grid.reshape(-1) for grid in np.meshgrid(*across, indexing="ij"))
    return np.stack([x, y, 0 * x], axis=1), _grid_faces(*divisions, 0, True)


def pipe(inner: float = 0.8, outer: float = 1.0, length: float = 2.0, around: int = 32, along: int = 8) -> Mesh:
    """Make a pipe along z around the origin, with a wall between two radii: 4 around (along + 1) faces."""
    angle = 2 * np.pi * np.arange(whole("around", around, 3)) / around
    if not positive("inner", inner) < positive("outer", outer):
        raise ValueError(f"inner must be below outer, got {inner} and {outer}.")
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _extruded(outer * circle, inner * circle, positive("length", length), whole("along", along, 1))


def circle(radius: float = 1.0, segments: int = 32) -> Mesh:
    """Make a closed line of segments in 2D, counterclockwise around the origin: vertices [segments, 2], faces [segments, 2]."""
    angle = 2 * np.pi * np.arange(whole("segments", segments, 3)) / segments
    return positive("radius", radius) * np.stack([np.cos(angle), np.sin(angle)], axis=1), _closed_line(segments)


def gear_outline(teeth: int = 20, module: float = 1.0, points: int = 12, pressure_angle: float = 20.0) -> Mesh:
    """Make the outline of an involute spur gear in 2D, counterclockwise around the origin, a tooth at angle 0.

    Flanks are involutes of the base circle from there, or from the root circle where that is larger, to the tip circle; below,
    they go straight to the root. Tip and root are those of ISO 53: one module above, and 1.25 below the pitch circle.

    Args:
        teeth: From 5 on.
        module: Diameter of the pitch circle per tooth [length].
        points: Vertices per tooth, from 8 on.
        pressure_angle: At the pitch circle [degrees], from 10 to 30.

    Returns:
        Vertices [teeth·points, 2], faces [teeth·points, 2].

    Source: involute functions as in Radzevich (2012), Dudley's Handbook of Practical Gear Design, 2nd ed., ch. 2.
    """
    radius, half = _tooth(whole("teeth", teeth, 5), positive("module", module), whole("points", points, 8), pressure_angle)
    tooth = 2 * np.pi * np.arange(teeth)[:, None] / teeth
    angle = (tooth + half).reshape(-1)
    return np.tile(radius, teeth)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1), _closed_line(angle.size)


def gear(
    teeth: int = 20,
    faces: int = 12_000,
    module: float = 1.0,
    width: float = 10.0,
    bore: float = 5.0,
    pressure_angle: float = 20.0,
) -> Mesh:
    """Make a spur gear with a bore, its axis along z through the origin, of about as many faces as are asked for.

    Args:
        teeth: From 5 on.
        faces: About as many; at least 32 per tooth·2 are made.
        module: Diameter of the pitch circle per tooth [length].
        width: Along z [length].
        bore: Diameter [length], below that of the root circle.
        pressure_angle: As in `gear_outline`.

    Returns:
        Vertices [v, 3], faces [f, 3].
    """
    girth = 4.4 * whole("teeth", teeth, 5) * positive("module", module)  # of the outline, about
    ideal = math.sqrt(whole("faces", faces, 1) * girth / (4 * positive("width", width)))  # vertices of an outline, for squares
    points = max(8, round(ideal / teeth))
    along = max(1, round(faces / (4 * teeth * points)) - 1)
    outline = gear_outline(teeth, module, points, pressure_angle)[0]
    if positive("bore", bore) / 2 >= np.linalg.norm(outline, axis=1).min():
        raise ValueError(f"bore must be below the diameter of the root circle, {teeth * module - 2.5 * module}, got {bore}.")
    hole = bore / 2 * outline / np.linalg.norm(outline, axis=1, keepdims=True)
    return _extruded(outline, hole, width, along)


def gear_pair(
    teeth: tuple[int, int] = (20, 30), faces: int = 12_000, module: float = 1.0, width: float = 10.0, bore: float = 5.0
) -> tuple[Mesh, Mesh]:
    """Make two gears in mesh, of about `faces` together: the first around the origin, the second beside it along x.

    They turn against each other, the second by -teeth[0] / teeth[1] of the first.
    """
    first, second = (gear(z, round(faces * z / sum(teeth)), module, width, bore) for z in teeth)
    turn = np.pi - np.pi / teeth[1]  # a space faces the tooth
    rotation = np.array([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    return first, (second[0] @ rotation + np.array([module * sum(teeth) / 2, 0, 0]), second[1])


def _tooth(teeth: int, module: float, points: int, pressure_angle: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return radii and angles [points] of a tooth around angle 0, from the middle of a space on; angles grow: no tip is pointed."""
    if not 10 <= pressure_angle <= 30:
        raise ValueError(f"pressure_angle must lie in [10, 30] degrees, got {pressure_angle}.")
    pitch, alpha = module * teeth / 2, math.radians(pressure_angle)
    base, tip, root = pitch * math.cos(alpha), pitch + module, pitch - 1.25 * module

    def half_angle(radius: NDArray[np.float64]) -> NDArray[np.float64]:
        phi = np.arccos(np.minimum(base / radius, 1))
        return np.pi / (2 * teeth) + (math.tan(alpha) - alpha) - (np.tan(phi) - phi)

    on_flank = (points - 3) // 2  # beside the root's corner; what is left over lies on the tip
    flank = np.linspace(max(base, root), tip, on_flank)
    half = half_angle(flank)
    corner = half[0] + 0.2 * (np.pi / teeth - half[0])
    on_tip = points - 3 - 2 * on_flank
    above = np.linspace(-half[-1], half[-1], on_tip + 2)[1:-1]
    angle = np.concatenate([[-np.pi / teeth, -corner], -half, above, half[::-1], [corner]])
    return np.concatenate([[root, root], flank, np.full(on_tip, tip), flank[::-1], [root]]), angle


def _closed_line(count: int) -> NDArray[np.int32]:
    start = np.arange(count, dtype=np.int32)
    return np.stack([start, np.roll(start, -1)], axis=1)


def _grid_faces(rows: int, columns: int, first: int, outward: bool) -> NDArray[np.int32]:
    """Cut a grid of (rows + 1) × (columns + 1) vertices, numbered from `first` on, into triangles."""
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1) + first
    right, above = corner + columns + 1, corner + 1
    faces = np.concatenate([np.stack([corner, right, right + 1], axis=1), np.stack([corner, right + 1, above], axis=1)])
    return (faces if outward else faces[:, ::-1]).astype(np.int32)


def _extruded(outer: NDArray[np.float64], inner: NDArray[np.float64], length: float, along: int) -> Mesh:
    """Make a solid along z between two outlines of as many vertices each: [around, 2]."""
    around = len(outer)
    heights = np.linspace(-length / 2, length / 2, along + 1)
    # once around in the profile: up the outside, down the inside
    profile = [(outer, z) for z in heights] + [(inner, z) for z in heights[::-1]]
    vertices = np.concatenate([np.column_stack([line, np.full(around, z)]) for line, z in profile])
    start = np.arange(around)
    after = (start + 1) % around
    faces = []
    for k in range(len(profile)):
        low, high = k * around, (k + 1) % len(profile) * around
        faces += [
            np.stack([low + start, low + after, high + after], axis=1),
            np.stack([low + start, high + after, high + start], axis=1),
        ]
    return vertices, np.concatenate(faces).astype(np.int32)
