"""A look at fluid and solid in space, aslant from above: a depth buffer that holds triangles and balls."""

from typing import NamedTuple

import numpy as np

from jfrnn.cases.fluids import Scene, Turning

PIXELS = 640  # of the wider side
_AZIMUTH, _ELEVATION = np.radians(35.0), np.radians(25.0)
_AHEAD = np.array([np.sin(_AZIMUTH) * np.cos(_ELEVATION), np.cos(_AZIMUTH) * np.cos(_ELEVATION), -np.sin(_ELEVATION)])
_RIGHT = np.array([np.cos(_AZIMUTH), -np.sin(_AZIMUTH), 0.0])
_UP = np.cross(_RIGHT, _AHEAD)
_LIGHT = np.array([-0.5, -0.6, 0.62])
_STEEL = np.array([0.72, 0.74, 0.78])


class _Canvas(NamedTuple):
    """Colors [h, w, 3] and depths [h, w] of pixels; a place on it is (p - low)·scale."""

    colors: np.ndarray
    depth: np.ndarray
    low: np.ndarray
    scale: float

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns and rows, shape [..., 2], and depths [...] of points [..., 3]."""
        flat = (points @ np.stack([_RIGHT, _UP], axis=1) - self.low) * self.scale
        return flat, points @ _AHEAD


def render(scene: Scene, x: np.ndarray, colors: np.ndarray, time: float) -> np.ndarray:
    """Return a picture of the solid of a scene in 3D and of particles [m], shape [n, 3], as balls of their volume.

    Colors are numbers from 0 to 1, shape [n, 3] of particles, and [h, w, 3] of the picture, the uppermost row first.
    """
    canvas = _canvas(scene)
    if scene.solid is not None:
        vertices = turn_vertices(scene.solid.vertices, scene.solid.turning, time)
        _add_triangles(canvas, vertices[scene.solid.faces])
    _add_balls(canvas, x, colors, 0.62 * scene.spacing)
    return canvas.colors[::-1]


def wrap_positions(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Return positions [n, d] inside the periodic box, where there is one; those that are in it stay as they are."""
    if scene.periodic is None:
        return x
    lower, lengths = np.array(scene.periodic.lower), np.array(scene.periodic.lengths)
    return np.where(scene.periodic.axes, x - np.floor((x - lower) / lengths) * lengths, x)


def picture_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner of what is shown: where a scene does not say, of its particles, which have a width."""
    if scene.bounds is None:
        return scene.positions.min(axis=0) - scene.spacing / 2, scene.positions.max(axis=0) + scene.spacing / 2
    return np.array(scene.bounds.lower), np.array(scene.bounds.upper)


def turn_vertices(vertices: np.ndarray, turning: Turning[float, tuple[float, ...]] | None, time: float) -> np.ndarray:
    """Return the corners of a solid [v, d] at a time [s]."""
    if turning is None:
        return vertices
    angle, r = turning.rate * time, vertices - np.array(turning.center)
    if turning.axis is None:
        across, along = np.stack([-r[:, 1], r[:, 0]], axis=1), 0.0
    else:
        axis = np.array(turning.axis) / np.linalg.norm(turning.axis)
        across, along = np.cross(axis, r), (r @ axis)[:, None] * axis
    return np.array(turning.center) + along + (r - along) * np.cos(angle) + across * np.sin(angle)


def _canvas(scene: Scene) -> _Canvas:
    corners = np.stack(np.meshgrid(*np.transpose(picture_bounds(scene)), indexing="ij"), axis=-1).reshape(-1, 3) @ np.stack(
        [_RIGHT, _UP], axis=1
    )
    low, extent = corners.min(axis=0), np.ptp(corners, axis=0)
    scale = PIXELS / extent.max()
    wide, high = np.ceil(extent * scale).astype(int)
    return _Canvas(np.ones((high, wide, 3)), np.full((high, wide), np.inf), low, scale)


def _add_triangles(canvas: _Canvas, corners: np.ndarray) -> None:
    """Draw triangles [f, 3, 3] that look this way."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    flat, depth = canvas.place(corners)
    size = np.array(canvas.depth.shape[::-1])
    first = np.clip(np.floor(flat.min(axis=1)).astype(int), 0, size)
    last = np.clip(np.ceil(flat.max(axis=1)).astype(int) + 1, 0, size)
    light = 0.35 + 0.65 * np.maximum(normal @ _LIGHT, 0)
    for t in np.flatnonzero((normal @ _AHEAD < 0) & (last > first).all(axis=1)):
        columns, rows = np.meshgrid(np.arange(first[t, 0], last[t, 0]), np.arange(first[t, 1], last[t, 1]))
        a, b, c = flat[t]
        whole = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if whole == 0:
            continue
        u = ((columns - a[0]) * (c[1] - a[1]) - (rows - a[1]) * (c[0] - a[0])) / whole
        w = ((b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (columns - a[0])) / whole
        far = depth[t, 0] + u * (depth[t, 1] - depth[t, 0]) + w * (depth[t, 2] - depth[t, 0])
        part = np.s_[first[t, 1] : last[t, 1], first[t, 0] : last[t, 0]]
        seen = (u >= 0) & (w >= 0) & (u + w <= 1) & (far < canvas.depth[part])
        canvas.depth[part] = np.where(seen, far, canvas.depth[part])
        canvas.colors[part] = np.where(seen[..., None], light[t] * _STEEL, canvas.colors[part])


def _add_balls(canvas: _Canvas, x: np.ndarray, colors: np.ndarray, radius: float) -> None:
    """Draw balls at x [n, 3], the farthest first, pixel by pixel of a ball."""
    order = np.argsort(-(x @ _AHEAD), kind="stable")
    flat, depth = canvas.place(x[order])
    center, colors = np.round(flat).astype(int), colors[order]
    pixels = radius * canvas.scale
    high, wide = canvas.depth.shape
    for column in range(-int(pixels), int(pixels) + 1):
        for row in range(-int(pixels), int(pixels) + 1):
            toward = 1 - (column**2 + row**2) / max(pixels, 1) ** 2
            if toward < 0:
                continue
            at = center + np.array([column, row])
            far = depth - radius * np.sqrt(toward)
            inside = ((at >= 0) & (at < (wide, high))).all(axis=1)
            place = np.where(inside, at[:, 1] * wide + at[:, 0], 0)
            seen = inside & (far < canvas.depth.reshape(-1)[place])
            canvas.depth.reshape(-1)[place[seen]] = far[seen]
            canvas.colors.reshape(-1, 3)[place[seen]] = (0.45 + 0.55 * np.sqrt(toward)) * colors[seen]
