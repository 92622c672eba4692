"""The GPU run, on whatever device is there: its config, its checks and its rows."""

import importlib
import itertools
import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from checked import refuses, slow
from commanded import invoke, told
from places import ROOT

import jfrnn
from experiments import _config
from experiments._errors import UsageError
from experiments.bench import decisions, gpu, lists

CONFIG = ROOT / "experiments" / "configs" / "h200.toml"


def load(name="h200"):
    return _config.load(CONFIG.with_stem(name), gpu.Config)


def decided(config):
    """Return the rows of a config's tables of cases, as a run makes them."""
    return [row for name, rows in gpu.parts(config) if name.startswith("exactness") for row in rows()]


def one_table(name, cases, **changes):
    """Return a config with one table of cases alone."""
    part = next(part for part in load(name).exactness if part.cases == cases)
    return load(name).model_copy(update={"exactness": [part.model_copy(update=changes)]})


@pytest.fixture
def config():
    return load().model_copy(update={"calls": 2, "steps": 2, "repeats": 2, "sums": ()})


def test_config_errors_name_the_key(tmp_path):
    path = tmp_path / "gpu.toml"
    path.write_text(CONFIG.read_text().replace("repeats = 5", "repeats = 0\nrepeat = 5"))
    refuses(UsageError, r"(?s)gpu\.toml.*repeats.*repeat", _config.load, path, gpu.Config)


def test_rows_of_a_scene_are_checked_and_timed(config):
    rows = list(gpu.scene_rows(config, 1000))
    ours = [row for row in rows if row["method"].startswith("jfrnn")]
    assert [row["kind"] for row in ours] == ["call", "call", "scan", "scan", "scan"]
    assert all(row["median_s"] > 0 for row in ours)
    assert [row["wrong"] for row in ours if "wrong" in row] == [0, 0]
    assert [row["rebuilds"] for row in ours if "rebuilds" in row] == [0, config.steps]
    assert all(row["directed_pairs"] == row["exact_directed_pairs"] for row in ours[:2])
    assert {row["method"] for row in rows if row["kind"] == "call"} == set(gpu._CALLS)
    json.dumps(rows)


def test_of_more_particles_than_a_list_has_room_for_none_is_asked_for(config, monkeypatch):
    monkeypatch.setattr(gpu, "MOST_LISTED", 500)
    monkeypatch.setattr(gpu, "MOST_SCANNED", 500)
    config = config.model_copy(update={"sums": ("pair_sum warp", "list, sum")})
    rows = list(gpu.scene_rows(config, 1000))
    assert [row["method"] for row in rows] == [gpu.COUNTS, "pair_sum warp", "pair_sum warp"]
    assert all(row["median_s"] > 0 for row in rows)


def test_sums_are_timed_and_their_errors_known(config):
    config = config.model_copy(update={"sums": ("pair_sum warp", "nvalchemi list, sum")})
    scene = lists.make_scene(gpu.jitter_lattice(300), gpu.REACH)
    with jax.numpy_dtype_promotion("standard"):  # a peer mixes dtypes
        rows = list(gpu.sum_rows(config, {"layout": "jitter", "points": len(scene.x)}, scene))
    assert [(row["method"], row["gradient"]) for row in rows] == list(itertools.product(config.sums, (False, True)))
    assert all(row["median_s"] > 0 and row["error"] < 16 for row in rows[:2])
    for row in rows[2:]:  # a peer may be missing
        assert row["error"] < 16 if "median_s" in row else row["reason"].startswith("ModuleNotFoundError")


def test_an_inexact_answer_is_counted_as_wrong(monkeypatch):
    from jfrnn.cases import hard

    monkeypatch.setattr(hard, "HARD_CASES", {"integers_14": hard.HARD_CASES["integers_14"]})
    part = one_table("h200", "hard", dims=[3], dtypes=["float32"], least_rows=800)
    assert [row["wrong"] for row in decided(part)] == [0]
    search = jfrnn.search
    monkeypatch.setattr(jfrnn, "search", lambda x, cutoff, **options: search(x, 0.9 * cutoff, **options))
    assert [row["wrong"] for row in decided(part)] == [2]


@pytest.mark.parametrize(("table", "name"), [("radii", "queries"), slow("batches", "periodic_images")])
def test_options_are_decided_case_by_case(table, name, monkeypatch):
    """The second config names these tables; here one case of each."""
    module = importlib.import_module(f"jfrnn.cases.{table}")
    cases = {"radii": "RADII_CASES", "batches": "BATCH_CASES"}[table]
    monkeypatch.setattr(module, cases, {name: getattr(module, cases)[name]})
    (row,) = decided(one_table("h200_options", table, dims=[2], dtypes=["float32"]))
    assert (row["cases"], row["wrong"]) == ({"radii": 5, "batches": 2}[table], 0)


def test_sums_are_decided_against_lists(monkeypatch):
    """The second config names them; here two scenes, and a sum that misses a pair is wrong."""
    scenes = decisions._scenes

    def some(*given):
        return (scene for scene in scenes(*given) if scene[0] in ("open", "queries"))

    monkeypatch.setattr(decisions, "_scenes", some)
    monkeypatch.setattr(decisions, "SUMMED", (1,))
    part = one_table("h200_options", "sums", dims=[2], dtypes=["float32"], least_rows=3100)
    (row,) = decided(part)
    assert (row["method"], row["cases"], row["wrong"]) == ("jfrnn warp, sums", 2, 0)
    search = jfrnn.search
    monkeypatch.setattr(jfrnn, "search", lambda x, cutoff, **options: search(x, 0.99 * cutoff, **options))
    assert [row["wrong"] for row in decided(part)] == [2]


def test_the_command_decides_triangles_and_a_wrong_list_ends_it_with_1(tmp_path, monkeypatch):
    from jfrnn.cases import triangles as cases

    monkeypatch.setattr(cases, "TRIANGLE_CASES", {"ties": cases.TRIANGLE_CASES["ties"]})
    part = '[[exactness]]\nbackend = "warp"\ndtypes = ["float32"]\ndims = [3]\ncapacity = 40\ncases = "triangles"\n'
    (tmp_path / "one.toml").write_text(part)

    def run(out):
        code, said, _ = invoke("gpu", tmp_path / "one.toml", "--out", tmp_path / out)
        return code, said.split(";")[0]

    assert run("right") == (0, "0 wrong")
    assert "jfrnn warp, triangles" in told("report", tmp_path / "right")
    search = jfrnn.search_triangles
    monkeypatch.setattr(jfrnn, "search_triangles", lambda x, v, f, cutoff, **options: search(x, v, f, 1.5 * cutoff, **options))
    assert run("wrong") == (1, "1 wrong")


def test_distances_of_a_moved_wall_are_not_near():
    from jfrnn.cases import triangles as cases

    given = cases.TRIANGLE_CASES["random"].build(np.dtype(np.float64), 2)
    tri = jfrnn.search_triangles(given.positions, given.vertices, given.faces, given.cutoff)
    assert decisions.are_near(tri, given.positions, given)
    moved = replace(given, vertices=given.vertices * (1 + 1e-13))
    assert not decisions.are_near(tri, given.positions, moved)


def test_report_of_a_run(tmp_path):
    about = {"device": "some GPU", "versions": {"jax": "1"}, "commit": "abc", "time": "2026-01-01T00:00:00Z"}
    call = {"kind": "call", "layout": "jitter", "points": 1000, "capacity": None}
    rows = [
        {"kind": "exactness", "method": "jfrnn warp", "cases": 2, "wrong": 0, "wrong_cases": []},
        {**call, "method": "jfrnn warp", "directed_pairs": 5, "median_s": 1e-3, "seconds": [1e-3]},
        {**call, "method": "another", "reason": "not installed"},
    ]
    (tmp_path / "rows.jsonl").write_text("\n".join(json.dumps(row | about) for row in rows))
    assert [line.split() for line in told("report", tmp_path).splitlines()] == [
        *(["exactness"], ["method", "cases", "wrong", "device"], ["jfrnn", "warp", "2", "0", "some", "GPU"], []),
        *(["call"], ["method", "device", "layout", "points", "directed_pairs", "median_s", "reason"]),
        ["jfrnn", "warp", "some", "GPU", "jitter", "1000", "5", "0.001"],
        ["another", "some", "GPU", "jitter", "1000", "not", "installed"],
    ]
    assert (tmp_path / "call.csv").read_text().splitlines()[1] == "jfrnn warp,some GPU,jitter,1000,5,0.001,"
