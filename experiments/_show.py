"""Pictures of a layout."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from cases import Scene
from experiments import _table

MILLI = 1e3
COLOR = "#0072B2"
RING_COLOR = "#D55E00"


def endings() -> list[str]:
    """Return the endings of pictures that can be drawn."""
    return sorted(f".{ending}" for ending in Figure().canvas.get_supported_filetypes())


def draw(scene: Scene, path: Path) -> Path:
    """Draw a scene from above, or in 3D with a slice through its fullest layer, lengths in mm, and return the path."""
    points = scene.positions.astype(np.float64) * MILLI
    flat = scene.dim == 2
    figure = Figure(figsize=(6.0, 7.5) if flat else (11.5, 7.0), layout=ConstrainedLayoutEngine(wspace=0.0 if flat else 0.12))
    figure.suptitle(f"{scene.name}: {_table.count(scene.n)} points, {100 * scene.fill:.1f} % of the full domain", fontsize=12)
    if flat:
        _draw_plane(figure.add_subplot(), scene, points, "")
    else:
        space, plane = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
        assert isinstance(space, Axes3D)
        _draw_space(space, scene, points)
        layer, height = fullest_layer(points[:, 2], MILLI * scene.spacing)
        _draw_plane(plane, scene, points[layer], f"layer z = {height:.4g} mm, {_table.count(int(layer.sum()))} points")
    figure.savefig(path, dpi=150)
    return path


def fullest_layer(heights: np.ndarray, thickness: float) -> tuple[np.ndarray, float]:
    """Return which points lie in the layer that holds most of them, and the middle of that layer."""
    layers = np.round(heights / thickness).astype(np.int64)
    values, counts = np.unique(layers, return_counts=True)
    fullest = values[counts.argmax()]
    return layers == fullest, float(fullest * thickness)


def _draw_plane(axes: Axes, scene: Scene, points: np.ndarray, title: str) -> None:
    """Draw points in the x-y plane as discs nearly one spacing wide, the domain, and the cutoff around one of them."""
    lower, upper = _bounds(scene)
    margin = 0.03 * float((upper - lower).max())
    axes.set(xlim=(lower[0] - margin, upper[0] + margin), ylim=(lower[1] - margin, upper[1] + margin), aspect="equal")
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.add_patch(Rectangle((lower[0], lower[1]), *(upper - lower)[:2], fill=False, color="0.6", linewidth=0.8))
    width = np.full(len(points), 0.9 * MILLI * scene.spacing)
    shape = {"offsets": points[:, :2], "offset_transform": axes.transData, "units": "xy"}
    axes.add_collection(EllipseCollection(width, width, np.zeros(len(points)), color=COLOR, linewidth=0, **shape), autolim=False)
    x, y = points[np.abs(points[:, :2] - points[:, :2].mean(axis=0)).sum(axis=1).argmin(), :2]
    axes.add_patch(Circle((x, y), MILLI * scene.cutoff, fill=False, color=RING_COLOR, linewidth=1.5, zorder=3))
    ring = f"ring: cutoff {MILLI * scene.cutoff:.4g} mm"
    axes.set_title(f"{title}, {ring}" if title else ring, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_space(axes: Axes3D, scene: Scene, points: np.ndarray) -> None:
    """Draw points in space, the nearer ones darker, and the edges of the domain. The y axis points away from the reader."""
    lower, upper = _bounds(scene)
    nearness = points @ np.array([1.0, -1.0, 0.6])
    low = nearness.min() - 0.6 * max(np.ptp(nearness), 1e-9)  # keeps the palest color from being white
    shades = {"c": nearness, "cmap": "Blues", "vmin": float(low), "depthshade": False}
    axes.scatter(points[:, 0], points[:, 1], zs=points[:, 2], s=3, linewidths=0, **shades)  # pyright: ignore[reportArgumentType]
    for axis in range(3):
        for corner in np.ndindex(2, 2):
            line = np.empty((2, 3))
            line[:, axis] = lower[axis], upper[axis]
            others = [other for other in range(3) if other != axis]
            for other, end in zip(others, corner, strict=True):
                line[:, other] = (lower, upper)[end][other]
            axes.plot(*line.T, color="0.6", linewidth=0.6)
    axes.set_box_aspect(upper - lower)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))  # pyright: ignore[reportAttributeAccessIssue]
        axis.set_major_locator(MaxNLocator(4))
    axes.view_init(elev=22, azim=-50)


def _bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the domain [mm]."""
    lower = MILLI * np.array(scene.origin)
    return lower, lower + MILLI * np.array(scene.lengths)
