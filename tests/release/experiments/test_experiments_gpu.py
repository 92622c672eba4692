"""The GPU run, on whatever device is there: its config, its checks and its rows."""

import importlib
import itertools
import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from places import ROOT
from typer.testing import CliRunner

from experiments import _compare, _config
from experiments._cli import app
from experiments._errors import UsageError
from experiments.bench.triangles import gear
from experiments.gpu import exactness, run, sums, timings, triangles
from experiments.gpu.config import Config

CONFIG = ROOT / "experiments" / "configs" / "h200.toml"


def load(path):
    return _config.load(path, Config)


def decided(part):
    """Return the rows of a table of cases, as a run makes them."""
    return [row for dtype in part.dtypes for dim in part.dims for row in exactness.rows(part, dtype, dim)]


@pytest.fixture
def config():
    small = {"sizes": [1000], "counts_only": [1000], "calls": 2, "steps": 2, "repeats": 2, "sums": []}
    return load(CONFIG).model_copy(update=small)


def test_config_errors_name_the_key(tmp_path):
    path = tmp_path / "gpu.toml"
    path.write_text(CONFIG.read_text().replace("repeats = 5", "repeats = 0\nrepeat = 5"))
    with pytest.raises(UsageError, match=r"(?s)gpu\.toml.*repeats.*repeat"):
        load(path)


def test_rows_of_a_scene_are_checked_and_timed(config):
    rows = list(timings.scene_rows(config, "jitter", 1000))
    ours = [row for row in rows if row["method"].startswith("jfrnn")]
    assert [row["kind"] for row in ours] == ["call", "call", "call", "scan", "call", "scan", "scan"]
    assert all(row["median_s"] > 0 for row in ours)
    assert [row["wrong"] for row in ours if "wrong" in row] == [0, 0, 0]
    assert [row["rebuilds"] for row in ours if "rebuilds" in row] == [0, config.steps]
    assert all(row["same_bits_twice"] for row in ours[:2])
    assert all(row["directed_pairs"] == row["exact_directed_pairs"] for row in ours[:3])
    json.dumps(rows)


def test_sums_are_timed_and_their_errors_known(config):
    config = config.model_copy(update={"sums": ["pair_sum warp", "nvalchemi list, sum"]})
    x = np.asarray(timings.jitter_lattice(config, 300))
    with jax.numpy_dtype_promotion("standard"):  # a peer mixes dtypes
        rows = list(timings.sum_rows(config, {"layout": "jitter", "points": len(x)}, x, 3.0))
    assert [(row["method"], row["gradient"]) for row in rows] == list(itertools.product(config.sums, (False, True)))
    assert all(row["median_s"] > 0 and row["error"] < 16 for row in rows[:2])
    for row in rows[2:]:  # a peer may be missing
        assert row["error"] < 16 if "median_s" in row else row["reason"].startswith("ModuleNotFoundError")
    counts, *large = timings.large_rows(config, 2000)
    assert (counts["method"], counts["median_s"] > 0) == ("jfrnn warp, counts", True)
    assert [row["gradient"] for row in large] == [False, True]
    assert all(36 < row["compiled_bytes"] / row["points"] < 100 for row in large)


def test_different_rows_are_counted_as_sets():
    one = np.array([[1, 2, 3], [4, 5, 9], [6, 9, 9]], np.int32)
    other = np.array([[3, 1, 2], [4, 9, 5], [7, 9, 9]], np.int32)
    assert _compare.different_rows(one, other) == 1


def test_an_inexact_answer_is_counted_as_wrong(config, monkeypatch):
    import jfrnn
    from jfrnn.cases import hard

    monkeypatch.setattr(hard, "HARD_CASES", {"integers_14": hard.HARD_CASES["integers_14"]})
    part = config.exactness[0].model_copy(update={"dims": [3], "dtypes": ["float32"], "least_rows": 800})
    assert [row["wrong"] for row in decided(part)] == [0]
    search = jfrnn.search
    monkeypatch.setattr(jfrnn, "search", lambda x, cutoff, **options: search(x, 0.9 * cutoff, **options))
    assert [row["wrong"] for row in decided(part)] == [2]


@pytest.mark.parametrize(
    ("table", "name"), [("radii", "queries"), pytest.param("batches", "periodic_images", marks=pytest.mark.slow)]
)
def test_options_are_decided_case_by_case(table, name, monkeypatch):
    """The second config names these tables; here one case of each."""
    parts = {part.cases: part for part in load(CONFIG.with_name("h200_options.toml")).exactness}
    module = importlib.import_module(f"jfrnn.cases.{table}")
    cases = {"radii": "RADII_CASES", "batches": "BATCH_CASES"}[table]
    monkeypatch.setattr(module, cases, {name: getattr(module, cases)[name]})
    (row,) = decided(parts[table].model_copy(update={"dims": [2], "dtypes": ["float32"]}))
    assert (row["cases"], row["wrong"]) == ({"radii": 5, "batches": 2}[table], 0)


def test_sums_are_decided_against_lists(monkeypatch):
    """The second config names them; here two scenes, and a sum that misses a pair is wrong."""
    import jfrnn

    scenes = sums._scenes

    def some(*given):
        return (scene for scene in scenes(*given) if scene[0] in ("open", "queries"))

    monkeypatch.setattr(sums, "_scenes", some)
    monkeypatch.setattr(sums, "COLUMNS", (1,))
    (part,) = (part for part in load(CONFIG.with_name("h200_options.toml")).exactness if part.cases == "sums")
    part = part.model_copy(update={"dims": [2], "dtypes": ["float32"], "least_rows": 3100})
    (row,) = decided(part)
    assert (row["method"], row["cases"], row["wrong"]) == ("jfrnn warp, sums", 2, 0)
    search = jfrnn.search
    monkeypatch.setattr(jfrnn, "search", lambda x, cutoff, **options: search(x, 0.99 * cutoff, **options))
    assert [row["wrong"] for row in decided(part)] == [2]


@pytest.mark.slow  # a dozen programs
def test_triangles_are_decided_timed_and_reported(tmp_path, monkeypatch):
    """The third config, with one case and a small gear: from its command to its report."""
    from jfrnn.cases import triangles as cases

    few = {name: cases.TRIANGLE_CASES[name] for name in ("ties", "faces_out_of_range")}
    monkeypatch.setattr(cases, "TRIANGLE_CASES", few)
    monkeypatch.setattr(timings, "memory_rows", lambda: iter(()))
    monkeypatch.setattr(timings, "bandwidth_rows", lambda _: iter([{"kind": "ceiling", "bytes_per_s": 1e12}]))
    given = load(CONFIG.with_name("h200_triangles.toml"))
    gear = given.triangles[0].model_copy(update={"points": [500], "faces": 500, "cutoffs": [0.5], "dtypes": ["float32"]})
    exact = given.exactness[0].model_copy(update={"dims": [2], "dtypes": ["float64"]})
    small = {"exactness": [exact], "triangles": (gear,), "calls": 2, "steps": 2, "repeats": 2, "seconds_per_timing": 0.1}
    assert run.run(given.model_copy(update=small), tmp_path) == 0
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["kind"] for row in rows] == ["exactness", "ceiling", *["triangles"] * 12]
    assert rows[0]["cases"] == len(few)
    assert all((row["wrong"], row["same_bits_twice"]) == (0, True) and row["median_s"] > 0 for row in rows[2:])
    assert {row["pairs"] for row in rows[2:]} == {rows[-1]["pairs"]}
    assert rows[0]["wrong"] == 0
    text = CliRunner().invoke(app, ["report", str(tmp_path)]).stdout
    assert "jfrnn warp, scan of updates" in text
    assert "jfrnn bvh, rebuild" in text


def test_a_wrong_list_of_triangles_is_counted(monkeypatch):
    import jfrnn
    from jfrnn.cases import triangles as cases

    monkeypatch.setattr(cases, "TRIANGLE_CASES", {"ties": cases.TRIANGLE_CASES["ties"]})
    part = load(CONFIG.with_name("h200_triangles.toml")).exactness[0]
    part = part.model_copy(update={"dims": [3], "dtypes": ["float32"]})
    search = jfrnn.search_triangles
    monkeypatch.setattr(jfrnn, "search_triangles", lambda x, v, f, cutoff, **options: search(x, v, f, 1.5 * cutoff, **options))
    assert [row["wrong"] for row in decided(part)] == [1]


def test_distances_of_a_moved_wall_are_not_near():
    import jfrnn
    from jfrnn.cases import triangles as cases

    given = cases.TRIANGLE_CASES["random"].build(np.dtype(np.float64), 2)
    tri = jfrnn.search_triangles(given.positions, given.vertices, given.faces, given.cutoff)
    assert triangles.are_near(exactness.oracle(), tri, given.positions, given)
    moved = replace(given, vertices=given.vertices * (1 + 1e-13))
    assert not triangles.are_near(exactness.oracle(), tri, given.positions, moved)


def test_memory_is_planned_within_a_tenth(monkeypatch):
    for row in timings.memory_rows():
        assert row["planned_bytes"] == pytest.approx(row["compiled_bytes"], rel=0.1)


def test_report_of_a_run(tmp_path):
    about = {"device": "some GPU", "versions": {"jax": "1"}, "commit": "abc", "time": "2026-01-01T00:00:00Z"}
    call = {"kind": "call", "layout": "jitter", "points": 1000, "capacity": None}
    rows = [
        {"kind": "exactness", "method": "jfrnn warp", "cases": 2, "wrong": 0, "wrong_cases": []},
        {**call, "method": "jfrnn warp", "directed_pairs": 5, "median_s": 1e-3, "seconds": [1e-3]},
        {**call, "method": "another", "reason": "not installed"},
    ]
    (tmp_path / "rows.jsonl").write_text("\n".join(json.dumps(row | about) for row in rows))
    result = CliRunner().invoke(app, ["report", str(tmp_path)], catch_exceptions=False)
    assert [line.split() for line in result.stdout.splitlines()] == [
        *(["exactness"], ["method", "cases", "wrong", "device"], ["jfrnn", "warp", "2", "0", "some", "GPU"], []),
        *(["call"], ["method", "device", "layout", "points", "directed_pairs", "median_s", "reason"]),
        ["jfrnn", "warp", "some", "GPU", "jitter", "1000", "5", "0.001"],
        ["another", "some", "GPU", "jitter", "1000", "not", "installed"],
    ]
    assert (tmp_path / "call.csv").read_text().splitlines()[1] == "jfrnn warp,some GPU,jitter,1000,5,0.001,"


def test_the_tree_of_boxes_is_a_row_beside(monkeypatch):
    import jfrnn
    from experiments import _measure

    monkeypatch.setattr(_measure, "time_kernels", lambda launches, repeats: [1e-3] * len(launches))  # wants CUDA
    scene = gear(300, 500)
    tri = jfrnn.search_triangles(scene.points, scene.vertices, scene.faces, 0.5, backend="warp")
    nearest, boxes = triangles.tree_rows({"cutoff": 0.5}, scene, tri.count, "cpu")
    assert nearest["differing"] == 0
    assert boxes["boxes"] >= int(tri.count.sum())
