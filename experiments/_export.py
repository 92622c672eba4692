"""Points of a layout as a file: .csv for spreadsheets, .vtp and .vtk for ParaView."""

from pathlib import Path

import numpy as np
import pandas as pd

from cases import Scene
from experiments import _oracle

ENDINGS = (".csv", ".vtp", ".vtk")
NEIGHBORS = "neighbors"
DIGITS = {np.dtype(np.float32): 9, np.dtype(np.float64): 17}  # enough to read the same float back


def write(scene: Scene, path: Path, counts: bool = False) -> Path:
    """Write the points of a scene to a file whose ending names the format, and with `counts` the neighbors of each, exactly.

    Coordinates are written such that they read back as the same floats. In .vtp and .vtk, 2D points get z = 0, each point is a
    vertex cell, and spacing and cutoff [m] are field data.
    """
    neighbors = None
    if counts:
        neighbors = _oracle.count_neighbors(_oracle.find_pairs(scene.positions, scene.cutoff), scene.n)
    (_write_csv if path.suffix == ".csv" else _write_vtk)(scene, path, neighbors)
    return path


def _write_csv(scene: Scene, path: Path, neighbors: np.ndarray | None) -> None:
    frame = pd.DataFrame(scene.positions, columns=list("xyz"[: scene.dim]))
    frame = frame if neighbors is None else frame.assign(**{NEIGHBORS: neighbors})
    frame.to_csv(path, index=False, float_format=f"%.{DIGITS[scene.positions.dtype]}g")


def _write_vtk(scene: Scene, path: Path, neighbors: np.ndarray | None) -> None:
    import pyvista

    cloud = pyvista.PolyData(np.pad(scene.positions, ((0, 0), (0, 3 - scene.dim))))
    cloud.field_data["spacing"], cloud.field_data["cutoff"] = [scene.spacing], [scene.cutoff]
    if neighbors is not None:
        cloud.point_data[NEIGHBORS] = neighbors
    cloud.save(path)
