"""The comparison with libraries that find nearest triangles runs, and agrees; meshes are read from files."""

import numpy as np
import pandas as pd
import pytest

from experiments._errors import UsageError
from experiments.bench import triangles
from experiments.sph.settings import _read_mesh
from jfrnn.cases import meshes


def test_a_small_comparison(tmp_path):
    text = triangles.command(tmp_path, 500, [500], [0.5], 2, "warp")
    rows = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert list(rows["method"])[:3] == ["jfrnn warp update", "jfrnn warp rebuild", "jfrnn warp count"]
    assert "trimesh" in set(rows["method"])
    assert {"jfrnn warp update, hilbert order", "jfrnn bvh update, hilbert order"} < set(rows["method"])
    assert (rows["processor_s"] > 0).all()
    peers = rows[rows["method"].isin(["trimesh", "libigl", "wp.Mesh nearest"])]
    assert not peers[["missing", "extra"]].to_numpy().any()
    assert "us_per_particle" in text


@pytest.mark.parametrize("kind", ["stl", "obj", "ply"])
def test_meshes_are_read(tmp_path, kind):
    import trimesh

    vertices, faces = meshes.sphere(2.0, 3)
    path = tmp_path / f"sphere.{kind}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    points, named = _read_mesh(path)
    assert (points.shape, named.shape, named.dtype) == (vertices.shape, faces.shape, np.int32)
    assert np.allclose(
        np.sort(points[named].reshape(len(faces), -1), axis=0), np.sort(vertices[faces].reshape(len(faces), -1), axis=0), atol=1e-6
    )


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(UsageError, match="is no file"):
        _read_mesh(tmp_path / "none.stl")
    (tmp_path / "text.txt").write_text("no mesh")
    with pytest.raises(UsageError, match=r"is no mesh|holds no triangles"):
        _read_mesh(tmp_path / "text.txt")
