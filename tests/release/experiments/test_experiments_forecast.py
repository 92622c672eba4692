"""How long a sweep will take, and what of it is not installed, before it begins."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from test_experiments_report import make_row

from experiments import _config, _forecast, _sweep, methods
from experiments._rows import RowFile

ROOT = Path(_forecast.__file__).resolve().parent.parent
SCENE = ("corners", 0.11, 256, 0.128)


def specs(processes=1, **more):
    table = {"layouts": ("corners",), "fills": (0.11,)}
    given = {"methods": ["cll", "scipy-kdtree", "scipy-kdtree-nolist"], "scenes": [table], "spacing": 5e-4, "processes": processes}
    return list(_config.Config.model_validate(given | {"repeats": 4, "min_seconds": 0.0, "max_repeats": 10} | more).specs())


def measured(method, seconds, **more):
    return make_row(SCENE, method, seconds, 1.0, spacing=5e-4, compile_s=2.0, **more)


@pytest.fixture
def results(tmp_path):
    """A folder of rows that were measured before: `cll` in two processes, of which the first compiled, and one other method."""
    folder = tmp_path / "results" / "before"
    folder.mkdir(parents=True)
    file = RowFile(folder)
    again = replace(measured("cll", 1.0), key="again", process=1, first_s=0.0)
    for row in (measured("cll", 1.0), again, measured("scipy-kdtree", 0.5)):
        file.append(row)
    return folder.parent


def test_what_was_measured_before_tells_how_long_it_will_take_now(results, tmp_path):
    cll, tree, other = specs()
    alone = _forecast.Forecast([cll], results=results)
    assert alone.left([cll]) == pytest.approx(_forecast.STARTED_S + 2 + 1 + 4 * 1.0)
    assert alone.left([replace(cll, process=1)]) == pytest.approx(_forecast.STARTED_S + 2 + 0 + 4 * 1.0)
    assert alone.left([replace(cll, min_seconds=7.0)]) == pytest.approx(_forecast.STARTED_S + 3 + 7)
    assert alone.left([replace(cll, min_seconds=70.0)]) == pytest.approx(_forecast.STARTED_S + 3 + 10 * 1.0)
    assert alone.left([replace(cll, repeats=10, most_seconds=2.0)]) == pytest.approx(_forecast.STARTED_S + 3 + 3)
    assert alone.left([]) == 0
    known = alone.left([cll]) + alone.left([tree])
    assert alone.left([cll, tree, other]) == pytest.approx(1.5 * known)  # of the third nothing is known
    assert _forecast.Forecast([cll], results=tmp_path / "none").left([cll]) is None
    assert _forecast.Forecast([cll], [measured("cll", 1.0)], tmp_path / "none").left([cll]) == alone.left([cll])


def test_rows_of_this_run_correct_what_is_left(results):
    cll, tree, other = specs()
    forecast = _forecast.Forecast([cll, tree, other], results=results)
    before = forecast.left([tree])
    forecast.note(cll, 3 * forecast.left([cll]))
    assert before < forecast.left([tree]) < 3 * before
    forecast.note(other, 100.0)
    assert forecast.left([other]) == 100.0


def test_what_is_not_installed_takes_no_time(results, monkeypatch):
    cll, tree, _ = specs()
    monkeypatch.setattr(methods, "lacks", lambda name: "no module named 'warp'" if name == "cll" else None)
    forecast = _forecast.Forecast([cll, tree], results=results)
    assert (forecast.absent, forecast.left([cll])) == (["cll"], 0)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "a time that the first rows will tell"),
        (0, "about 1 s"),
        (89, "about 89 s"),
        (1320, "about 22 min"),
        (7200, "about 2.0 h"),
    ],
)
def test_times_in_words(seconds, text):
    assert _forecast.in_words(seconds) == text


def test_a_sweep_says_how_long_it_will_take_and_how_much_is_left(tmp_path, capfd):
    config = _config.Config.model_validate(
        {"methods": ["scipy-kdtree"], "scenes": [{"layouts": ("corners",), "fills": (0.5, 0.02)}], "spacing": 1e-3}
        | {"repeats": 2, "min_seconds": 0.0}
    )
    fast, slow = config.specs()
    file = RowFile(tmp_path)
    for spec in (fast, slow):
        scene = ("corners", spec.fill, 10, spec.fill)
        file.append(replace(make_row(scene, "scipy-kdtree", 6000.0, 1.0, spacing=1e-3), key=f"of another config {spec.fill}"))
    _sweep.run(config, "small", tmp_path)
    said = capfd.readouterr().err
    assert "2 rows to measure: about 6.7 h\n" in said  # two of 3 + 0.5 + 6000 + 6060 s, and the first is over sooner
    assert "corners 50 %: 0 of 2 rows measured, left: about 6.7 h\n" in said
    assert re.search(r"corners 2 %: 1 of 2 rows measured, left: about \d+ (s|min)\n", said)


@pytest.mark.usefixtures("foreign")
def test_methods_that_cannot_be_imported_are_those_that_lack_something():
    found = []
    for name in methods.names():
        try:
            methods.load(name)
        except ImportError:
            found.append(name)
    assert found == [name for name in methods.names() if methods.lacks(name)]


def test_without_a_compiler_its_methods_are_said_to_lack_it(tmp_path):
    code = "from experiments import methods; print(methods.lacks('ann-kd')); print(methods.lacks('scipy-kdtree'))"
    environment = os.environ | {"PATH": str(tmp_path)}
    environment.pop("CXX", None)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=environment)
    assert done.stdout.splitlines() == ["no C++ compiler: install g++, or name one in the environment variable CXX", "None"]


def test_committed_rows_know_the_sweep_of_the_thesis():
    config = _config.load(ROOT / "experiments" / "configs" / "thesis.toml")
    specs = [spec for spec in config.specs() if spec.process == 0 and spec.method in ("cll", "scipy-kdtree", "warp")]
    forecast = _forecast.Forecast(specs)
    assert 60 < forecast.left(specs) < 3600
