"""`python -m experiments sph validate`: known answers, rows, and how it goes on."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commanded import told

from experiments.sph import answers, validate
from experiments.sph.validation import CASES, Case, Figure, Seen
from jfrnn.cases import fluids

SHORT = Case(
    "one", (0.001, 0.002), lambda scene, seen: ([Figure("fallen", 0.5 - seen[-1].x[0, 1], None, 1e-9)], {}), backend="brute"
)


def test_closed_forms_give_the_tabled_numbers():
    y = np.array([0.25, 0.5, 0.75])
    np.testing.assert_allclose(answers.poiseuille(y[:2], 2e-3), [0.8107837, 1.0707961], atol=1e-7)
    np.testing.assert_allclose(answers.couette(y, 1e-3), [0.1104299, 0.3284453, 0.7200744], atol=1e-7)
    np.testing.assert_allclose(answers.drop_axis(np.array([0.0008, 0.0038, 0.0076])), [1.0831035, 1.4392191, 1.9445172], rtol=1e-7)


def test_interpolation_is_exact_for_planes_up_to_the_walls():
    x = np.random.default_rng(0).uniform(size=(400, 2))
    points = np.array([[0.0, 0.5], [0.5, 0.5], [1.0, 1.0]])
    np.testing.assert_allclose(answers.interpolate(x, x @ [2.0, 3.0] - 1, points, 0.2), points @ [2.0, 3.0] - 1, rtol=1e-12)


def test_vortices_in_3d_begin_as_taylor_and_green_say():
    """Compare with the series of Taylor & Green (1937), doi:10.1098/rspa.1937.0036, for the dissipation over 3/(4 Re)."""
    t, e = np.array([0.0, 0.1, 0.2, 0.3]), 1 / 50
    energies, rates = answers.vortices(t, 50.0, n=16)
    series = 1 - 6 * e * t + (5 / 48 + 18 * e**2) * t**2 - (5 / 3 + 36 * e**2) * e * t**3
    series += (50 / (99 * 64) + 1835 / (9 * 16) * e**2 + 54 * e**4) * t**4
    np.testing.assert_allclose(rates, 0.75 * e * series, rtol=2e-5)
    np.testing.assert_allclose(energies[::2], [1 / 8, 1 / 8 - 0.2 / 6 * (rates[0] + 4 * rates[1] + rates[2])], rtol=1e-8)


@pytest.mark.parametrize(
    "name",
    ["taylor-green", "taylor-green-3d-16", "poiseuille", "couette", "reverse-poiseuille-20", "rotor-10", "drop", "hydrostatic"],
)
def test_what_is_exact_meets_its_targets_and_what_is_not_misses_them(name, monkeypatch):
    monkeypatch.setattr(answers, "vortices", lambda times, reynolds: (np.exp(-times / 10) / 8, np.exp(-times / 10) / 80))
    case = CASES[name]
    scene = case.scene(**case.settings) if callable(case.scene) else fluids.fluid(case.scene)
    x = scene.positions if scene.wall is None else scene.positions[~scene.wall]
    for factor, met in ((1.0, True), (1.1, False)):
        figures, _ = case.judge(scene, [exact(name, x, time, factor) for time in case.times])
        assert [figure.met for figure in figures] == [met] * len(figures)


def test_a_dam_break_is_compared_with_a_perfect_fluid():
    case = CASES["dam-break-20"]
    scene = fluids.fluid(case.scene, **case.settings)
    times = np.array([0.1, 0.2])
    fronts = np.interp(times * np.sqrt(2 * 9.81), *answers.table("perfect_fluid_n2_2").T)
    for factor, met in ((1.0, True), (0.85, False)):
        empty = Seen(0.0, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), 0.0, 0.0)
        places = factor * fronts - scene.spacing / 2
        seen = [empty._replace(time=t, x=np.array([[x, 0.0]])) for t, x in zip(times, places, strict=True)]
        (perfect, *experiments), curves = case.judge(scene, seen)
        assert perfect.met == met
        assert perfect.measured == pytest.approx(1 - factor, abs=1e-9)
        assert [figure.met for figure in experiments] == [factor == 0.85] * 2  # a perfect fluid is ahead of both
        assert set(curves) == {"measured", "a perfect fluid, computed", "a = 1.125 in, known", "a = 2.25 in, known"}


def test_a_round_drop_under_the_right_pressure_meets_its_targets():
    scene = fluids.fluid("square-drop", nx=40)
    radius = np.sqrt(scene.n / np.pi) * scene.spacing
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 60) * radius] * 2), axis=-1).reshape(-1, 2)
    x = grid[np.linalg.norm(grid, axis=1) <= radius - scene.spacing / 2]
    for stretch, factor, met in ((1.0, 1.0, [True, True]), (1.0, 1.2, [False, True]), (1.1, 1.0, [True, False])):
        at = Seen(1.0, stretch * x, 0 * x, np.full(len(x), factor / radius), 0.0, 0.0)
        figures, _ = CASES["square-drop"].judge(scene, [at, at])
        assert [figure.met for figure in figures] == met


def exact(name, x, time, factor):
    seen = Seen(time, x, np.zeros_like(x), np.zeros(len(x)), factor * 0.25 * np.exp(-16 * np.pi**2 * time / 100), 0.0)
    if name == "taylor-green":
        return seen._replace(v=factor * fluids_velocity(x, time))
    if name == "taylor-green-3d-16":
        return seen._replace(kinetic=factor * np.exp(-2 * np.pi * time / 10) / 8)
    if name == "rotor-10":
        around = answers.rotor(np.linalg.norm(x, axis=1), 2.0, 0.5, 1.0) / np.linalg.norm(x, axis=1)
        return seen._replace(v=factor * around[:, None] * np.stack([-x[:, 1], x[:, 0]], axis=1), torque=-factor * 4 * np.pi / 15)
    if name == "drop":
        axis = factor * answers.drop_axis(np.array([time]))[0]
        return seen._replace(x=x * (1 / axis, axis))
    if name == "hydrostatic":
        return seen._replace(p=factor * 1000 * (0.9 - x[:, 1]))
    if name == "reverse-poiseuille-20":
        y, back = x[:, 1] % 0.5, np.sign(0.5 - x[:, 1] % 1)
        along = back * answers.poiseuille(2 * y, time, 1.0, 0.05 * (np.pi / 0.5) ** 2)
    else:
        along = {"poiseuille": answers.poiseuille, "couette": answers.couette}[name](x[:, 1], time)
    return seen._replace(v=np.stack([factor * along, 0 * along], axis=1))


def fluids_velocity(x, time):
    from jfrnn.cases._fluid_flows import taylor_green_velocity

    return taylor_green_velocity(x, time, 100.0)


def test_rows_are_kept_and_missed_targets_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(validate, "CASES", {"short": SHORT, "other": replace(SHORT, times=(0.003,))})
    out = told("sph", "validate", "short", "--out", tmp_path)
    first = (tmp_path / "rows.jsonl").read_text()
    row = json.loads(first)
    assert (row["key"], row["steps"], row["figures"][0]["met"]) == ("short", 20, False)
    assert "1.96e-05" in out and "≤ 1e-09  no" in out
    told("sph", "validate", "--out", tmp_path)
    after = (tmp_path / "rows.jsonl").read_text()
    assert after.startswith(first)  # not run again
    assert [json.loads(line)["key"] for line in after.splitlines()] == ["short", "other"]
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 3


def test_a_run_that_diverges_is_a_row(tmp_path, monkeypatch):
    wild = replace(SHORT, judge=lambda scene, seen: ([Figure("nothing", np.nan, None, 1.0)], {}))
    nothing = {"quantity": "nothing", "measured": None, "low": None, "high": 1.0, "met": False}
    assert validate.measure("wild", wild, str)["figures"] == [nothing]
    monkeypatch.setattr(validate.health, "complaint", lambda scene, s: "particle 0 is gone")
    row = validate.measure("wild", wild, str)
    assert (row["figures"], row["reason"]) == ([], "diverged until t = 0.001 s: particle 0 is gone")
    assert list(validate.table([row])["met"]) == ["no"]
