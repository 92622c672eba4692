"""The perfect fluid that dam breaks are compared with, against closed forms and what it must keep."""

import numpy as np
import pytest

from experiments.sph import potential


def test_a_wide_column_begins_to_move_as_pohle_says():
    """Compare with Stoker (1957), Water Waves, sec. 12.1: 2g/π ln cot(πy/4H), for a column that never ends."""
    height, width = 2.0, 10.0
    top = np.stack([np.linspace(0, width, 80), np.full(80, height)], axis=1)
    face = np.stack([np.full(80, width), np.linspace(height, 0, 81)[1:]], axis=1)
    nodes = np.concatenate([top, face])
    single, double = potential.influences(nodes)
    rate = -potential.GRAVITY * nodes[:, 1]  # of the potential, at rest
    found = np.linalg.solve(single, double @ rate - double.sum(axis=1) * rate)[100:150]
    y = nodes[100:150, 1]
    np.testing.assert_allclose(found, 2 * potential.GRAVITY / np.pi * np.log(1 / np.tan(np.pi * y / (4 * height))), rtol=2e-3)


def test_it_keeps_its_volume_and_falls_first_as_gravity_says():
    z, phi = potential.column(2.0, 0.04)
    for _ in range(20):
        z, phi = potential.spread(*potential.advance(z, phi, 0.02), 0.04)
    assert np.trapezoid(z[:, 1], z[:, 0]) == pytest.approx(2.0, rel=5e-3)
    assert 2.0 - z[0, 1] < 0.5 * potential.GRAVITY * 0.4**2  # the wall side falls more slowly than freely
    assert potential.fronts(np.array([0.4]), 0.04, 0.02)[0] == pytest.approx(z[-1, 0], rel=1e-6)
    assert z[-1, 0] == pytest.approx(1.12, abs=0.01)
