"""`python -m experiments bench sums`: one sum in many ways, a process per row."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses
from commanded import told
from places import ROOT

import jfrnn
from experiments import _config
from experiments._errors import UsageError
from experiments.bench import sums, ways

CONFIGS = ROOT / "experiments" / "configs"
TINY = """
ways = ["pair_sum warp", "list, sum", "scipy pairs alone", "nvalchemi list, sum", "brute force"]
layouts = ["full"]
spacings = [1e-3]
gradients = [false]
compensated = [false]
most_points = { "brute force" = 10 }
repeats = 2
min_seconds = 0.0
"""


def scene(n=300, dtype=np.float32):
    random = np.random.default_rng(0)
    return ways.Given(jnp.asarray(random.random((n, 3)), dtype), jnp.asarray(random.uniform(0.5, 1.5, n), dtype), 0.2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Run the command once; its folder holds the config, too."""
    there = tmp_path_factory.mktemp("sums")
    (there / "tiny.toml").write_text(TINY)
    (there / "said.txt").write_text(told("bench", "sums", there / "tiny.toml", "--out", there))
    return there


def read(folder):
    return {row["way"]: row for row in sums.RowFile(folder, dict).read()}


def test_every_way_gets_a_row(folder):
    rows = read(folder)
    assert {way: row["status"] for way, row in rows.items()} == {
        **{"pair_sum warp": "ok", "list, sum": "ok", "scipy pairs alone": "ok"},
        **{"nvalchemi list, sum": rows["nvalchemi list, sum"]["status"], "brute force": "skipped"},
    }
    assert rows["nvalchemi list, sum"]["status"] == "ok" or "cannot be imported" in rows["nvalchemi list, sum"]["reason"]
    assert "250 points" in rows["brute force"]["reason"]
    for way in ("pair_sum warp", "list, sum"):
        row = rows[way]
        assert (row["points"], row["repeats"]) == (250, 2)
        assert 0 < row["error"] < 4
        assert 0 < row["p10_s"] <= row["median_s"] <= row["p90_s"]
        assert row["peak_bytes"] >= 0
    assert "build_s" not in rows["pair_sum warp"]
    assert rows["list, sum"]["build_s"] > 0
    assert "error" not in rows["scipy pairs alone"]


def test_the_table_and_the_pictures(folder):
    text = (folder / "said.txt").read_text()
    assert "pays_from" in text
    assert "skipped: 250 points" in text
    assert len((folder / "table.csv").read_text().splitlines()) == 6
    for name in ("sums.png", "payoff.png"):
        assert (folder / name).read_bytes()[:4] == b"\x89PNG"


def test_rows_that_are_there_are_not_measured_again(folder, monkeypatch):
    def fail(*args, **options):
        raise AssertionError("measured again")

    monkeypatch.setattr(sums._sweep, "ask", fail)
    config = _config.load(folder / "tiny.toml", sums.Config)
    assert [row["way"] for row in sums.run(config, folder)] == list(config.ways)
    refuses(AssertionError, "measured again", sums.run, config.model_copy(update={"repeats": 3}), folder)


def test_a_row_is_on_disk_before_the_next_one_starts(tmp_path, monkeypatch):
    config = sums.Config(ways=("pair_sum warp", "list, sum"), layouts=("full",), spacings=(1e-3,), gradients=(False,))
    answers = [{"status": "skipped"}]
    monkeypatch.setattr(sums._sweep, "ask", lambda *args, **options: answers.pop())
    with pytest.raises(IndexError):
        sums.run(config, tmp_path)
    assert list(read(tmp_path)) == ["pair_sum warp"]


ROW = {"layout": "full", "gradient": False, "way": "pair_sum warp", "compensated": False, "status": "ok", "points": 100}
ROW |= {"error": 1.0, "peak_bytes": 4000, "median_s": 6.0, "sum_s": 6.0}


def test_where_a_list_pays_off():
    assert sums.pays_from(10.0, 1.0, 6.0) == 3  # 10 + 2·1 = 2·6 is no gain yet
    assert sums.pays_from(10.0, 6.0, 6.0) == math.inf
    listed = ROW | {"way": "list, sum", "median_s": 11.0, "sum_s": 1.0, "build_s": 10.0}
    first, second = sums.table([ROW, listed])
    assert (first["ratio"], first["B per particle"], second["ratio"], second["pays_from"]) == (1.0, 40.0, 11 / 6, 3)


def test_an_error_is_said_with_its_unit(tmp_path):
    row = ROW | {"error": 0.19}
    assert sums.describe(row).endswith(", error 0.19 eps·√neighbors")
    assert "error [eps·√neighbors]" in sums.report([row], tmp_path).splitlines()[0]


@pytest.mark.parametrize("gradient", [False, True])
def test_float64_is_exact_and_an_error_is_seen(gradient):
    given = scene(dtype=np.float64)
    steps = ways.WAYS["list, sum"].prepare(given, gradient, False)
    found = steps.sums(given.x, given.m, steps.build(given.x))
    assert ways.error_of(given, found, gradient) < 4
    sums = (found[0], found[1] * 1.001) if gradient else found * 1.001
    assert ways.error_of(given, sums, gradient) > 1e6


def test_the_ways_agree():
    given = scene()
    results = {}
    for name in ("pair_sum warp", "list, pair_sum", "list, sum"):
        steps = ways.WAYS[name].prepare(given, True, False)
        made = None if steps.build is None else steps.build(given.x)
        assert ways.error_of(given, steps.sums(given.x, given.m, made), True) < 40, name  # few neighbors, some near the cutoff
        results[name] = made
    assert isinstance(results["list, sum"], jfrnn.NeighborList)


@pytest.mark.parametrize("name", ["sums", "sums_smoke"])
def test_configs(name):
    config = _config.load(CONFIGS / f"{name}.toml", sums.Config)
    assert set(config.ways) == set(ways.WAYS)
    specs = list(config.specs())
    assert len({_config.digest(spec) for spec in specs}) == len(specs)
    assert not any(spec["gradient"] for spec in specs if spec["way"] == "scipy pairs alone")


def test_an_unknown_way_is_named(tmp_path):
    (tmp_path / "bad.toml").write_text('ways = ["magic"]\nlayouts = ["full"]\nspacings = [1e-3]\nspeed = 1\n')
    with pytest.raises(UsageError, match=r"unknown way 'magic'; allowed: pair_sum warp.*\n.*speed: unknown key.*most_points"):
        _config.load(tmp_path / "bad.toml", sums.Config)
