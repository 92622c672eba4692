"""Pictures of a run: a frame per snapshot, and all of them as a GIF."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from jfrnn.cases.fluids import Scene
from jfrnn.sph import view

WALL = "0.75"


def draw(scene: Scene, there: np.ndarray, x: np.ndarray, v: np.ndarray, time: float, top_speed: float, path: Path) -> None:
    """Draw particles from the side, colored by speed: the first axis to the right, the last one upwards; a solid in 3D aslant.

    `there` says which particles take part, shape [n], bool, of positions x [m] and velocities v [m/s], shape [n, d], at a time [s].
    The frame is the bounds of the scene, and the color scale ends at `top_speed` [m/s].
    """
    x, aslant = view.wrap_positions(scene, x), scene.solid is not None and scene.dim == 3
    lower, upper = view.picture_bounds(scene)
    wide, high = (upper - lower)[[0, -1]]
    tall = 6.0 if aslant else min(max(7.0 * high / wide, 2.5) + 0.8, 9.0)
    figure = Figure(figsize=(7.0, tall), layout="constrained")
    axes, scale = figure.add_subplot(), ScalarMappable(Normalize(0, top_speed or 1.0), "viridis")
    if aslant:
        axes.imshow(view.render(scene, x[there], scale.to_rgba(np.linalg.norm(v[there], axis=1))[:, :3], time))
        axes.set_axis_off()
    else:
        _draw_from_side(axes, scene, there, x, v, time, scale)
        margin = 2 * scene.spacing
        axes.set(xlim=(lower[0] - margin, upper[0] + margin), ylim=(lower[-1] - margin, upper[-1] + margin), aspect="equal")
    axes.set_title(f"{scene.name}, t = {time:.4g} s")
    figure.colorbar(scale, ax=axes, label="speed [m/s]", shrink=0.8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _draw_from_side(
    axes: Axes, scene: Scene, there: np.ndarray, x: np.ndarray, v: np.ndarray, time: float, scale: ScalarMappable
) -> None:
    wall = np.zeros(scene.n, bool) if scene.wall is None else scene.wall
    depth = np.argsort(x[:, 1]) if scene.dim == 3 else np.arange(scene.n)
    seen = depth[(there & ~wall)[depth]]
    lower, upper = view.picture_bounds(scene)
    pixels = 72 * 6.0 * scene.spacing / (upper[0] - lower[0])
    shape = {"s": max(0.8 * pixels, 0.6) ** 2, "linewidths": 0}
    axes.scatter(*x[wall][:, [0, -1]].T, color=WALL, **shape)
    if scene.solid is not None:
        vertices = view.turn_vertices(scene.solid.vertices, scene.solid.turning, time)
        axes.add_collection(LineCollection(list(vertices[scene.solid.faces])))
    axes.scatter(*x[seen][:, [0, -1]].T, color=scale.to_rgba(np.linalg.norm(v[seen], axis=1)), **shape)
    axes.set(xlabel="x [m]", ylabel=f"{'xyz'[scene.dim - 1]} [m]")


def animate(folder: Path, path: Path, seconds: float = 0.08) -> Path | None:
    """Put the frames of a folder, in the order of their names, into one GIF; None where there are none."""
    pictures = [Image.open(frame).convert("P", palette=Image.Palette.ADAPTIVE) for frame in sorted(folder.glob("*.png"))]
    if not pictures:
        return None
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=int(1000 * seconds), loop=0)
    return path
