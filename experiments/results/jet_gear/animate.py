"""Draw the snapshots of a jet on a gear as one GIF: python experiments/results/jet_gear/animate.py RUN PICTURE [RUN's --set ...].

Each frame is drawn at twice its size and averaged; all share one palette, so that what stays the same takes no bytes.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from jfrnn.cases.fluids import Scene
from jfrnn.sph import settings, view

HIGH, SHOWN, TOP_SPEED, COLORS, MILLISECONDS = 600, 0.84, 16.0, 56, 60
SLOW, FAST = np.array([0.20, 0.07, 0.02]), np.array([1.0, 0.68, 0.10])  # oil


def draw(scene: Scene, x: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
    """Return a frame, shape [h, w, 3], bytes."""
    there = np.zeros(scene.n) <= time if scene.enters is None else scene.enters <= time
    share = np.clip(np.linalg.norm(v[there], axis=1) / TOP_SPEED, 0, 1)[:, None]
    large = view.render(scene, x[there], SLOW + (FAST - SLOW) * share, time)
    large = large[: int(SHOWN * HIGH) * 2, : large.shape[1] // 2 * 2]  # below, nothing happens
    small = large.reshape(large.shape[0] // 2, 2, large.shape[1] // 2, 2, 3).mean(axis=(1, 3))
    return (255 * np.clip(small, 0, 1)).astype(np.uint8)


def main(run: str, picture: str, *sets: str) -> None:
    """Draw all snapshots of a run."""
    view.PIXELS = 2 * HIGH
    scene = settings.make_scene("jet-gear", list(sets))
    frames = []
    for path in sorted((Path(run) / "snapshots").glob("*.npz")):
        with np.load(path) as snapshot:
            names = {name.split("/")[-1]: name for name in snapshot.files}
            frames.append(draw(scene, *(snapshot[names[name]] for name in ("x", "v", "time"))))
    palette = Image.fromarray(np.concatenate(frames[:: max(len(frames) // 8, 1)])).quantize(COLORS)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    images[0].save(picture, save_all=True, append_images=images[1:], duration=[MILLISECONDS] * (len(images) - 1) + [1500], loop=0)


main(*sys.argv[1:])
