"""Layouts of cubes that are turned, cut and drawn apart: counts, shapes, and that only what is meant to differ does."""

import math

import numpy as np
import pytest
from scipy.spatial import KDTree

from jfrnn import cases

DOMAIN = cases.Domain()


def pairs_at(positions, radius):
    return len(KDTree(positions).query_pairs(radius, output_type="ndarray"))


@pytest.mark.parametrize("name", ["turned", "tumbled", "cut", "grown"])
@pytest.mark.parametrize(("tiles", "points"), [(2, 16 * 12**3), (4, 128 * 6**3), (6, 432 * 4**3)])
def test_points_are_those_of_the_clusters_of_the_thesis(name, tiles, points):
    scene = cases.scene(f"{name}{tiles}", fill=0.11)
    assert scene.n == points == 27_648
    assert scene.fill == points / 250_000
    assert scene.lengths == (0.005, 0.01, 0.005)
    assert len(np.unique(scene.positions, axis=0)) == points


@pytest.mark.parametrize("angle", [0.0, 10.0, 45.0, 90.0])
def test_turned_cubes_keep_their_pairs(angle):
    straight, turned = cases.turned(DOMAIN, 4, angle=0.0), cases.turned(DOMAIN, 4, angle=angle)
    radius = 3.05 * DOMAIN.spacing  # between the distances of lattice sites: no ties
    assert pairs_at(turned, radius) == pairs_at(straight, radius)
    assert (turned >= 0).all()
    assert (turned <= DOMAIN.lengths).all()
    middle = turned.reshape(128, 216, 3).mean(axis=1)
    assert np.allclose(middle, straight.reshape(128, 216, 3).mean(axis=1), atol=1e-12)
    edges = np.linalg.norm(np.diff(turned.reshape(128, 6, 6, 6, 3), axis=1), axis=-1)
    assert np.allclose(edges, DOMAIN.spacing)
    direction = np.diff(turned.reshape(128, 6, 6, 6, 3), axis=1)[0, 0, 0, 0] / DOMAIN.spacing
    assert np.allclose(direction, [math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0], atol=1e-9)


def test_tumbled_cubes_are_each_turned_their_own_way():
    tumbled = cases.tumbled(DOMAIN, 4, seed=3)
    assert pairs_at(tumbled, 3.05e-4) == pairs_at(cases.turned(DOMAIN, 4, angle=0.0), 3.05e-4)
    cubes = tumbled.reshape(128, 6, 6, 6, 3) / DOMAIN.spacing
    frames = np.stack([cubes[:, 1, 0, 0], cubes[:, 0, 1, 0], cubes[:, 0, 0, 1]], axis=2) - cubes[:, 0, 0, 0][:, :, None]
    assert np.allclose(frames.transpose(0, 2, 1) @ frames, np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(frames), 1.0)
    assert np.abs(frames.mean(axis=0)).max() < 0.25  # no direction is preferred
    assert np.array_equal(tumbled, cases.tumbled(DOMAIN, 4, seed=3))
    assert not np.array_equal(tumbled, cases.tumbled(DOMAIN, 4, seed=4))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0])
def test_cut_keeps_the_lattice_and_the_number(dim, angle):
    domain = cases.Domain(dim=dim)
    cut = cases.cut(domain, 2, angle=angle)
    sites = np.rint(cut / domain.spacing).astype(int)
    assert np.array_equal(cut, sites * domain.spacing)
    assert (sites >= 0).all()
    assert (sites < domain.sites).all()
    assert len(np.unique(sites, axis=0)) == len(cut) == len(cases.turned(domain, 2))
    clusters = sites.reshape(2 * 4 * 2 ** (dim - 2), -1, dim)
    assert np.array_equal(clusters[0] - clusters[0].min(axis=0), clusters[-1] - clusters[-1].min(axis=0))
    extent = np.ptp(clusters[0], axis=0) + 1
    side = round(clusters.shape[1] ** (1 / dim))
    assert (extent[:2] == side).all() if angle == 0 else (extent[:2] > side).all()


@pytest.mark.parametrize("growth", [1.0, 10.0, 1e6])
def test_grown_draws_the_cubes_apart(growth):
    scene = cases.scene("grown4", growth=growth, dtype="float64")
    assert scene.n == 27_648
    assert scene.fill == pytest.approx(27_648 / 250_000 / growth)
    assert pairs_at(scene.positions, 3.05e-4) == pairs_at(cases.turned(DOMAIN, 4, angle=0.0), 3.05e-4)
    middle = scene.positions.reshape(128, 216, 3).mean(axis=1)
    assert np.ptp(middle, axis=0) == pytest.approx(growth ** (1 / 3) * np.array([3 / 4, 7 / 8, 3 / 4]) * DOMAIN.lengths)
