"""`python -m experiments sph speed`: steps by ways to find pairs; and rows of walls that are not summed."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from checked import refuses
from commanded import told

from experiments import _config
from experiments._errors import UsageError
from experiments.sph import speed
from jfrnn.cases import fluids
from jfrnn.sph import forces
from jfrnn.sph.model import make_model, make_state


def run(folder):
    told("sph", "speed", folder / "tiny.toml", "--out", folder)
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


def test_ways_agree_before_their_time_counts_and_the_same_command_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "_SECONDS", 0.0)
    (tmp_path / "tiny.toml").write_text('scene = "dam-break-2d"\nnx = [4]\ndtype = "float64"\nsteps = 2\nrounds = 2\n')
    rows = run(tmp_path)
    assert [(row["way"], row["status"]) for row in rows] == [("pair_sum", "ok"), ("list", "ok")]
    n = len(fluids.fluid("dam-break-2d", nx=4).positions)
    for row in rows:
        assert (row["particles"], row["fluid"], row["steps"]) == (n, 32, 2)
        assert row["difference"] < 4
        assert row["particle_steps_per_s"] == pytest.approx(n * row["steps_per_s"])
        assert row["bytes"] > 0
    assert "pair_sum" in (tmp_path / "step.csv").read_text()
    assert run(tmp_path) == rows


def test_a_config_says_what_is_wrong(tmp_path):
    for text, words in (("ways = ['fast']", r"ways\[0\]: got 'fast'"), ("scene = 'sea'", "unknown fluid scene 'sea'")):
        (tmp_path / "bad.toml").write_text(text)
        refuses(UsageError, words, _config.load, tmp_path / "bad.toml", speed.Config)
    for name in ("sph_speed", "sph_speed_h200"):
        assert _config.load(Path("experiments/configs") / f"{name}.toml", speed.Config).ways


def test_states_that_differ_are_noticed():
    scene = fluids.fluid("dam-break-2d", nx=4)
    model, s = make_model(scene), make_state(scene)
    assert speed.difference(model, s, s) == 0
    eps = np.finfo(np.float64).eps
    assert speed.difference(model, s, s._replace(rho=s.rho * (1 + 8 * eps))) == pytest.approx(8, abs=1)
    assert np.isnan(speed.difference(model, s, s._replace(rho=s.rho * np.nan)))


def test_the_column_keeps_to_its_walls():
    scene = speed.set_in_motion(fluids.fluid("dam-break-3d", nx=4), 2.0)
    moving = scene.velocities[~scene.wall]
    np.testing.assert_array_equal(moving[:, 0], 2 * scene.positions[~scene.wall, 0])
    np.testing.assert_array_equal(moving[:, 1:], np.column_stack([np.zeros(len(moving)), -2 * scene.positions[~scene.wall, 2]]))
    assert not scene.velocities[scene.wall].any()


def rates(model, s):
    """Return what the sums of a step give of the fluid, and what walls show to it."""
    seen = forces.fields(model, s, s.rho, None, None)
    a, _ = forces.accelerations(model, s, seen, None)
    return forces.carried_rate(model, s, s.rho, None, None), a, seen.p, seen.rho


@pytest.mark.parametrize(("name", "settings"), [("jet", {"layers": 3, "duration": 5e-4}), ("dam-break-2d", {"nx": 4})])
@pytest.mark.slow
def test_rows_that_nobody_reads_may_be_left_out(name, settings):
    scene = fluids.fluid(name, **settings)
    near = scene.positions.copy()
    near[:, -1] = np.where(scene.wall, near[:, -1], 0.7 * near[:, -1])
    scene = replace(scene, positions=near, velocities=np.where(scene.wall[:, None], 0, near))
    model, s = make_model(scene, backend="brute"), make_state(scene)
    s = s._replace(time=s.time + 2e-4)  # of a jet, some have come
    rho = s.rho * (1 + 1e-3 * np.sin(np.arange(scene.n)))
    few, all_rows = (jax.jit(rates)(model, s._replace(rho=rho)) for model in (model, replace(model, fluid_count=None)))
    assert model.fluid_count == (~scene.wall).sum()
    for one, other in zip(few, all_rows, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-11 * np.abs(other).max())


def test_walls_among_the_fluid_leave_no_rows_out():
    assert make_model(fluids.fluid("cavity", nx=8)).fluid_count is None
