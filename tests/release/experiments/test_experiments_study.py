"""Effects of one factor with their uncertainty, small versions of sweeps, and the thesis's table beside ours."""

from dataclasses import replace

import numpy as np
import pytest
from checked import refuses
from test_experiments_report import SCENES, make_row, make_rows

from experiments import _figures, _study, _thesis
from experiments._errors import UsageError


def turned_rows(factor, noise, seed=0):
    """Rows of two layouts at three angles, in five rounds of which each is slower than the one before."""
    random, rows = np.random.default_rng(seed), []
    for layout in ("turned2", "turned4"):
        for angle in (0.0, 15.0, 45.0):
            for k in range(5):
                second = (1 + k) * (factor if angle == 45 else 1.0) * np.exp(noise * random.normal())
                scene = (layout, 0.11, 27648, 0.110592)
                rows.append(make_row(scene, "cll", second, 1.0, key=f"{layout} {angle} {k}", angle=angle, process=k))
    return rows


def test_an_effect_is_found_through_the_drift():
    found = _study.effect(_study.rounds(turned_rows(1.1, 0.01)), "angle", 0.0, 45.0)
    assert found is not None
    assert found.low < 1.1 < found.high
    assert found.ratio == pytest.approx(1.1, rel=0.02)
    assert (found.p < 0.01, found.rounds, found.scenes) == (True, 5, 2)
    assert "beyond noise (5 rounds, 2 scenes)" in str(found)


def test_rows_of_different_machines_are_not_compared():
    rows = turned_rows(1.1, 0.01)
    moved = [replace(row, machine=row.machine | {"system": "another"}) if row.process > 2 else row for row in rows]
    assert _study.effect(_study.rounds(moved), "angle", 0.0, 45.0) == _study.effect(_study.rounds(rows), "angle", 0.0, 45.0)
    apart = [replace(row, machine=row.machine | {"system": "another"}) if row.angle else row for row in rows]
    assert _study.effect(_study.rounds(apart), "angle", 0.0, 45.0) is None
    some = [replace(row, machine=row.machine | {"system": "another"}) if row.angle and row.process > 2 else row for row in rows]
    found = _study.effect(_study.rounds(some), "angle", 0.0, 45.0)
    assert found is not None
    assert (found.rounds, found.scenes) == (3, 2)


def test_without_an_effect_the_interval_misses_1_as_rarely_as_it_says():
    missed = 0
    for seed in range(200):
        found = _study.effect(_study.rounds(turned_rows(1.0, 0.05, seed)), "angle", 0.0, 45.0)
        missed += not found.low <= 1 <= found.high
    assert 2 <= missed <= 22


def test_effects_name_every_value_and_adjust_for_their_number():
    made = _study.effects(_study.rounds(turned_rows(1.1, 0.01)), "angle", 0.0, [15.0, 45.0, 30.0])
    assert made.angle.tolist() == [15.0, 45.0]
    assert (made.p_adjusted >= made.p).all()
    assert made.verdict.tolist() == ["within noise", "beyond noise"]
    one = [row for row in turned_rows(1.1, 0.0) if row.process == 0]
    alone = _study.effects(_study.rounds(one), "angle", 0.0, [45.0])
    assert (alone.verdict.tolist(), alone.ratio.tolist()) == (["one round"], [pytest.approx(1.1)])
    assert "too few rounds" in str(_study.effect(_study.rounds(one), "angle", 0.0, 45.0))
    assert _study.effect(_study.rounds(one), "angle", 0.0, 46.0) is None


def test_a_sweep_without_rows_says_what_makes_them():
    refuses(UsageError, "none: no rows; fill it with `python -m experiments run", _study.rows, "none")


def test_table_6_1_stands_beside_ours():
    lines = _figures.compare_entries(_study.table(make_rows()))
    assert len(lines) == len(_thesis.table()) == 28
    cll = lines[(lines.method == "CLL") & (lines.scene == "full 100 %")].iloc[0]
    assert (cll.ours, cll.median_s, cll.thesis_s, cll.search_mb, cll.thesis_mb) == ("cll", 1.0, 2.14, 40.0, 116.75)
    ann = lines[(lines.method == "ANN") & (lines.scene == "corners 11 %")].iloc[0]
    assert (ann.ours, ann.median_s, ann.thesis_t_processing) == ("scipy-kdtree", 1.5, 1339.18)
    assert lines[lines.scene == "clusters2 11 %"].ours.isna().all()
    assert SCENES[1][0] == "corners"
    bars = _figures.bars(lines, "median_s", "thesis_s", "time [s]", ["CLL", "ANN-NL", "ANN"], "6.1")
    assert len(bars.axes[0].containers) == 6
    _figures.split(lines, "6.4")
    assert len(_figures.over_fill(lines, "search_mb", "thesis_mb", "[MB]", ["CLL"], "6.6").axes[0].lines) == 2
