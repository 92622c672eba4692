"""Meshes from files: STL, OBJ, PLY and what else trimesh reads."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from experiments._errors import UsageError


def read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Read the triangles of a file as `jfrnn.search_triangles` takes them.

    Vertices that coincide are one, so that meshes whose format has no vertices in common (STL) are closed where they look so.

    Returns:
        Vertices [length of the file], shape [v, 3], and faces, shape [f, 3].

    Raises:
        UsageError: there is no such file, its format is unknown, or it holds no triangles.
    """
    import trimesh

    if not path.is_file():
        raise UsageError(f"{path} is no file: name an STL, OBJ or PLY.")
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:  # readers of trimesh raise of any kind
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UsageError(f"{path} is no mesh that trimesh reads ({reason}): name an STL, OBJ or PLY.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise UsageError(f"{path} holds no triangles.")
    mesh.merge_vertices()
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
