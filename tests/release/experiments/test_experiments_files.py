import numpy as np
import pytest
import pyvista
import reference
from commanded import told
from matplotlib.image import imread

from experiments import _show
from jfrnn import cases

SPACING = 5e-4


@pytest.fixture
def scene(dim, dtype):
    return cases.scene("clusters2", fill=0.3, spacing=SPACING, dim=dim, dtype=dtype)


def export(path, scene, *options):
    common = ("--fill", 0.3, "--spacing", SPACING, "--dim", scene.dim, "--dtype", scene.positions.dtype)
    assert told("export", "clusters2", "--out", path, *common, *options) == f"{path}\n"


def test_csv_reads_back_the_same_floats(tmp_path, scene):
    path = tmp_path / "new" / "points.csv"
    export(path, scene)
    assert path.read_text().splitlines()[0] == "x,y,z"[: 2 * scene.dim - 1]
    read = np.loadtxt(path, delimiter=",", skiprows=1, dtype=scene.positions.dtype)
    np.testing.assert_array_equal(read, scene.positions)


@pytest.mark.parametrize("ending", ["vtp", "vtk"])
def test_vtk_files_read_back_the_same_floats_and_a_vertex_each(tmp_path, scene, ending):
    path = tmp_path / f"points.{ending}"
    export(path, scene)
    cloud = pyvista.read(path)
    assert isinstance(cloud, pyvista.PolyData)
    assert cloud.points.dtype == scene.positions.dtype
    np.testing.assert_array_equal(cloud.points[:, : scene.dim], scene.positions)
    assert not cloud.points[:, scene.dim :].any()
    assert cloud.n_verts == cloud.n_cells == scene.n
    np.testing.assert_array_equal(cloud.verts.reshape(-1, 2), np.stack([np.ones(scene.n), np.arange(scene.n)], axis=1))
    assert (cloud.field_data["spacing"][0], cloud.field_data["cutoff"][0]) == (scene.spacing, scene.cutoff)


def test_counts_are_stored_on_demand(tmp_path, scene):
    export(tmp_path / "points.csv", scene, "--counts")
    export(tmp_path / "points.vtp", scene, "--counts")
    expected = np.bincount([i for i, _ in reference.reference_pairs(scene.positions, scene.cutoff)], minlength=scene.n)
    assert (tmp_path / "points.csv").read_text().splitlines()[0].endswith(",neighbors")
    table = np.loadtxt(tmp_path / "points.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, scene.dim], expected)
    np.testing.assert_array_equal(pyvista.read(tmp_path / "points.vtp").point_data["neighbors"], expected)


@pytest.mark.parametrize("options", [("--dim", 2), ("--dim", 3), ("--fill", 0.02)], ids=["2d", "3d", "fill"])
def test_show_draws_the_points(tmp_path, options):
    path = tmp_path / "new" / "corners.png"
    assert told("show", "corners", "--spacing", SPACING, "--out", path, *options) == f"{path}\n"
    picture = (255 * imread(path)[..., :3]).round().astype(int)
    assert min(picture.shape[:2]) >= 900
    for color in (_show.COLOR, _show.RING_COLOR):
        wanted = [int(color[place : place + 2], 16) for place in (1, 3, 5)]
        assert (picture == wanted).all(axis=2).sum() > 20, color


def test_the_fullest_layer():
    layer, height = _show.fullest_layer(np.array([0.0, 1.0, 0.98, 2.0]) / 10, 0.1)
    assert layer.tolist() == [False, True, True, False]
    assert height == pytest.approx(0.1)
