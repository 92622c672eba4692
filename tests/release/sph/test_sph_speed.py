"""`python -m experiments sph speed`: steps by ways to find pairs, where their time goes, and error against seconds."""

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from experiments import _config
from experiments._cli import app
from experiments._errors import UsageError
from experiments.sph import edges, speed, speed_report, tradeoff
from jfrnn.cases import fluids
from jfrnn.sph import forces
from jfrnn.sph.model import make_model, make_state

TINY = """
scene = "dam-break-2d"
nx = [4]
ways = ["pair_sum", "edges of jfrnn", "jax-sph"]
most_particles = { "jax-sph" = 10 }
stages = ["pair_sum"]
dtype = "float64"
steps = 2
rounds = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Run the command once; its folder holds the config, too."""
    there = tmp_path_factory.mktemp("speed")
    (there / "tiny.toml").write_text(TINY)
    result = CliRunner().invoke(app, ["sph", "speed", str(there / "tiny.toml"), "--out", str(there)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return there


def read(folder):
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_ways_agree_before_their_time_counts(folder):
    rows = {row["way"]: row for row in read(folder) if row["kind"] == "step"}
    assert {way: row["status"] for way, row in rows.items()} == {
        **{"pair_sum": "ok", "edges of jfrnn": "ok"},
        **{"jax-sph": "skipped"},
    }
    n = len(fluids.fluid("dam-break-2d", nx=4).positions)
    for way in ("pair_sum", "edges of jfrnn"):
        row = rows[way]
        assert (row["particles"], row["fluid"], row["steps"]) == (n, 32, 2)
        assert row["difference"] < 4
        assert row["particle_steps_per_s"] == pytest.approx(n * row["steps_per_s"])
        assert row["bytes"] > 0


def test_the_stages_of_a_step_add_up(folder):
    (row,) = (row for row in read(folder) if row["kind"] == "stages")
    assert list(row["parts"]) == ["search", "density", "walls", "forces", "integration"]
    assert sum(row["parts"].values()) > 0
    assert (folder / "stages.png").stat().st_size > 1000
    assert (folder / "step.csv").read_text().startswith("particles,way,steps/s")


def test_the_same_command_goes_on(folder):
    before = read(folder)
    result = CliRunner().invoke(app, ["sph", "speed", str(folder / "tiny.toml"), "--out", str(folder)], catch_exceptions=False)
    assert result.exit_code == 0
    assert read(folder) == before


def test_a_config_says_what_is_wrong(tmp_path):
    for text, words in (("ways = ['fast']", "unknown way 'fast'"), ("scene = 'sea'", "unknown fluid scene 'sea'")):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(UsageError, match=words):
            _config.load(tmp_path / "bad.toml", speed.Config)
    for name in ("sph_speed", "sph_speed_h200"):
        assert _config.load(speed_report.Path("experiments/configs") / f"{name}.toml", speed.Config).ways


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


@pytest.mark.parametrize(
    ("name", "settings"),
    [("jet", {"layers": 3, "duration": 5e-4}), ("dam-break-2d", {"nx": 4})],
)
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


@pytest.mark.slow
def test_edges_of_a_list_are_pairs_of_it():
    scene = speed.set_in_motion(fluids.fluid("drop", nx=6), 50.0)
    model, s = make_model(scene), make_state(scene)
    found = edges.of_own_list(model, s, 0.5 * scene.spacing)
    apart = np.linalg.norm(scene.positions[:, None] - scene.positions, axis=2)
    np.fill_diagonal(apart, np.inf)
    near = apart < model.cutoff + 0.5 * scene.spacing
    weights = found.sum(lambda r, i, j: jnp.where(r @ r < model.cutoff**2, j, 0), s.x, model.m)
    np.testing.assert_allclose(weights, (apart < model.cutoff) @ scene.masses, rtol=1e-12)
    kept, made = found.update(s.x), found.update(1.5 * s.x)
    assert (int(kept.rebuild_count), int(made.rebuild_count), bool(made.overflow)) == (0, 1, False)
    assert (np.asarray(found.i) < scene.n).sum() == near.sum()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("jax_md") is None, reason="jax-md is not installed")
def test_jax_md_finds_the_same_edges(tmp_path):
    (tmp_path / "peer.toml").write_text('nx = [4]\nways = ["pair_sum", "jax-sph", "jax-sph, skin"]\nsteps = 3\nrounds = 1\n')
    command = [sys.executable, "-m", "experiments", "sph", "speed", str(tmp_path / "peer.toml"), "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)  # jax-md mixes dtypes, which tests refuse
    rows = read(tmp_path)
    assert [row["status"] for row in rows] == ["ok"] * 3
    assert [row["rebuilds"] for row in rows] == [None, 3, 0]
    assert all(row["difference"] < 4 for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("skin", [0.0, 0.3])
def test_the_error_of_a_known_flow(skin):
    row = tradeoff.measure(tradeoff.Spec("taylor-green", 16, "float64", "list" if skin else "pair_sum", skin, 0.05))
    assert row["status"] == "ok"
    assert 0 < row["error"]["l2 of velocity"] < 0.05


def test_the_report_draws_error_against_seconds(tmp_path):
    spec = {"kind": "tradeoff", "way": "list", "scene": "taylor-green", "dtype": "float32", "steps": 10, "status": "ok"}
    rows = [
        speed.StepRow(key=f"{nx} {skin}", nx=nx, skin=skin, seconds=nx * (1 + skin), error={"l2 of velocity": 1 / nx}, **spec)
        for nx in (10, 20)
        for skin in (0.0, 0.3)
    ]
    assert "l2 of velocity" in speed_report.report(rows, tmp_path)
    assert (tmp_path / "tradeoff.png").stat().st_size > 1000
