"""Thin solids: water does not feel water through them, and which pairs they part is what exact arithmetic says."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from poured import scene_of

import jfrnn
from jfrnn import sph
from jfrnn.cases import meshes
from jfrnn.sph import solids

DX = 0.02


def sheet(thickness, size=0.6):
    """Return a sheet across x, by its corners and faces."""
    vertices, faces = meshes.cube(1.0, 1)
    return vertices / np.ptp(vertices, axis=0) * (thickness, size, size), faces


def between_blocks(thickness, thin, far=False, n=6):
    """Return a scene of two blocks of n³ particles on two sides of a sheet, the right one far away if asked."""
    left = sph.lattice((-thickness / 2 - n * DX, -n * DX / 2, -n * DX / 2), (n, n, n), DX)
    x = np.concatenate([left, left * [-1, 1, 1] + [far, 0, 0]])
    sides = np.where(np.arange(len(x)) < len(left), 1.0, -1.0)
    physics = sph.Physics(1000.0, 20.0, smoothing=1.5 * DX, pressure="mean", viscosity=1e-3, artificial=0.05)
    given = {"velocities": np.stack([0.1 * sides, 0 * sides, 0 * sides], axis=1), "solid": sph.Solid(*sheet(thickness), thin=thin)}
    return scene_of(x, DX, physics, densities=1002.0 + sides + np.cos(50 * x[:, 2]), **given)


def test_water_does_not_feel_water_through_a_sheet():
    n = 6**3

    @jax.jit
    def look(model, s, v):
        def left(v):
            a = sph.begin(model, s._replace(v=v)).a[:n]
            return jnp.sum(a * a), a

        (_, a), slope = jax.value_and_grad(left, has_aux=True)(v)
        return a, slope

    def felt(thickness, thin):
        found = []
        for far in (False, True):
            scene = between_blocks(thickness * DX, thin, far)
            model, s = sph.make_model(scene), sph.make_state(scene)
            found.append([np.asarray(part) for part in look(model, s, s.v)] + [s.solid.sight])
        (near, slope, sight), (alone, _, _) = found
        return np.linalg.norm(near - alone) / np.linalg.norm(alone), slope, sight

    change, slope, sight = felt(0.5, None)
    assert change == 0.0
    assert np.all(slope[n:] == 0)
    assert np.abs(slope[:n]).max() > 0
    x = between_blocks(0.5 * DX, None).positions
    apart = np.linalg.norm(x[:n, None] - x[None, n:], axis=2) < 2 * 1.5 * DX
    parted = np.asarray(sight.parted)
    expected = set(zip(*np.nonzero(apart) + np.array([[0], [n]])))
    assert {tuple(sorted(pair)) for pair in parted[parted[:, 0] >= 0].tolist()} == expected
    model, s = sph.make_model(between_blocks(0.5 * DX, None)), sph.make_state(between_blocks(0.5 * DX, None))
    assert sph.list_neighbors(model, s, 0.01) is None
    with pytest.raises(sph.SceneError, match=r"nbrs must be None beside a thin solid.*Leave it out, so that sums search"):
        sph.begin(model, s, jfrnn.NeighborList)
    change, slope, sight = felt(0.5, False)
    assert change > 0.1
    assert np.abs(slope[n:]).max() > 0
    assert sight is None
    assert felt(4.0, None)[2] is None


def test_a_probe_of_pressure_does_not_see_through_a_sheet():
    scene = replace(between_blocks(0.5 * DX, None), densities=np.where(np.arange(2 * 6**3) < 6**3, 1001.0, 1004.0))
    points = [(-DX, 0.0, 0.0), (DX, 0.0, 0.0), (0.0, 0.0, 0.0)]
    model, s = sph.make_model(scene), sph.make_state(scene)
    look = jax.jit(sph.pressure_at(points))
    expected = [1000 * 20.0**2 / 7 * (ratio**7 - 1) for ratio in (1.001, 1.004)]
    np.testing.assert_allclose(look(model, s), [*expected, 0.0], rtol=2e-4)  # the last one is in the sheet
    crowded = s._replace(x=s.x * 0.3 + jnp.asarray([-DX, 0.0, 0.0]))  # more near a point than there is room for
    assert np.isnan(look(model, crowded)).all()


@pytest.mark.slow
def test_pairs_that_a_turning_blade_parts():
    """A blade thinner than the spacing in a square of water: after some steps, those that rational arithmetic finds."""
    corners = np.array([[-0.5, -0.004], [0.5, -0.004], [0.5, 0.004], [-0.5, 0.004]])
    faces = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    water = sph.lattice((-0.4, -0.4), (40, 40), DX)
    water = water[np.abs(water[:, 1]) > 0.9 * DX / 2][: 1600 - 40]
    scene = replace(
        between_blocks(DX, None),
        positions=water,
        velocities=np.zeros_like(water),
        masses=np.full(len(water), 1000.0 * DX**2),
        densities=None,
        solid=sph.Solid(corners, faces, sph.Turning((0.0, 0.0), None, 2.0)),
    )
    model, s = sph.make_model(scene), jax.jit(sph.begin)(sph.make_model(scene), sph.make_state(scene))
    s, _ = sph.advance(model, s, None, 20)
    assert not s.solid.overflow
    x = np.asarray(solids.into_frame(s.x, model.turning, s.solid.angle))
    i, j = np.nonzero(np.triu(np.linalg.norm(x[:, None] - x[None], axis=2) < model.cutoff, 1))
    close = np.flatnonzero(x[i, 1] * x[j, 1] < 0)  # no other segment can meet the blade
    sides = np.asarray(corners)[np.asarray(faces)]
    expected = {(i[k], j[k]) for k in close if any(reference.is_parted(x[i[k]], x[j[k]], side) for side in sides)}
    parted = np.asarray(s.solid.sight.parted)
    assert {tuple(sorted(pair)) for pair in parted[parted[:, 0] >= 0].tolist()} == expected
    assert len(expected) > 200
