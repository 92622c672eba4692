"""Benches of lists, those of triangles too, and what they share: ways that are right are timed, and nothing wrong is."""

import jax
import numpy as np
import pandas as pd
import pytest
from commanded import invoke, told

from experiments import methods
from experiments.bench import arrays, crystals, latency, lists, structures, table, triangles

N = 16
SUMS = ("list", "counts", "density", "density, gradient")
WAYS = {  # of each bench: its options, who does what, and times
    "latency": (
        ("--sizes", str(N)),
        ("x + 1", *SUMS, "dense list", "sparse list", "cells", "all pairs"),
        ("waited_us", "step_us", "waited_ratio", "step_ratio"),
    ),
    "crystals": (("--sizes", "3x12"), ("counts", "list", "list", "list"), ("waited_ms",)),
    "arrays": (
        ("--sides", "6"),
        ("list", *SUMS, "list in a box", "x + 1", "list", "list", "counts"),
        ("lower_s", "compile_s", "waited_ms", "step_ms"),
    ),
}


@pytest.mark.parametrize("bench", ["latency", "crystals", pytest.param("arrays", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_way_gets_a_row_and_none_twice(tmp_path, foreign, bench):
    options, whats, times = WAYS[bench]
    words = ("bench", bench, *options, "--repeats", 2, "--out", tmp_path)
    said = told(*words)
    rows = (tmp_path / "rows.jsonl").read_bytes()
    assert told(*words) == said
    assert (tmp_path / "rows.jsonl").read_bytes() == rows
    found = pd.read_csv(tmp_path / "cpu.csv")
    assert tuple(found["what"]) == whats
    for _, row in found.iterrows():
        missing = None if row["who"] in ("jfrnn", "jax", "XLA") else methods.lacks(row["who"])
        assert row["status"] == ("ok" if missing is None else "missing")
        assert (row[[*times]] > 0).all() and row["wrong"] == 0 if missing is None else row["reason"] == missing
    if bench == "latency":
        assert (found.loc[found["what"] == "x + 1", ["waited_ratio", "step_ratio"]] == 1).all(axis=None)
    if bench == "arrays":
        assert list(found["layout"]) == ["jitter"] * 8 + ["ties"] * 2


def test_a_size_is_systems_and_atoms():
    assert crystals._read_size("256x100") == (256, 100)


@pytest.fixture(scope="module")
def scene():
    return latency._make_scene(N)


def test_of_a_wrong_answer_no_time_is_taken(scene):
    nearer = scene._replace(cutoff=0.8 * scene.cutoff)
    for way in latency._ways():
        if way.who == "jfrnn":
            row = {}
            wrong = way._replace(make=lambda scene, way=way: way.make(nearer))
            assert table.judge(row, wrong, scene, lambda function: lambda: jax.jit(function)(scene.x)) is None
            assert (row["status"], row["wrong"] > 0) == ("failed", True), way.what
            assert row["reason"] == f"the answer is wrong for {row['wrong']} particles"


def test_an_error_is_a_row(scene):
    def make(scene):
        raise RuntimeError("no such thing")

    row = {}
    assert table.judge(row, next(latency._ways())._replace(make=make), scene, None) is None
    assert row == {"who": "jax", "what": "x + 1", "status": "failed", "reason": "RuntimeError: no such thing"}


def test_a_wrong_list_is_seen():
    scene = arrays._make_scene(5, "ties")
    distances = np.linalg.norm(np.asarray(scene.x)[:, None] - np.asarray(scene.x), axis=2)
    rows = [[j for j in np.flatnonzero(row < 3) if j != i] for i, row in enumerate(distances)]
    n, width = len(rows), max(map(len, rows))
    idx = np.array([row + [n] * (width - len(row)) for row in rows])
    assert lists.wrong_rows(scene, (idx, scene.counts)) == 0
    assert lists.wrong_rows(scene, (idx[:, ::-1], scene.counts)) == 0
    assert lists.wrong_rows(scene, (idx, scene.counts + (np.arange(n) < 2))) == 2
    pairs = np.array([(i, j) for i, row in enumerate(rows) for j in row]).T
    padded = np.pad(pairs, ((0, 0), (0, 3)), constant_values=n)
    assert lists.wrong_counts_of_pairs(scene, padded) == 0
    assert lists.wrong_counts_of_pairs(scene, padded[:, 1:]) == 1
    idx[3, 0], idx[7, 1] = 3, idx[7, 0]
    assert lists.wrong_rows(scene, (idx, None)) == 2
    tied = idx.copy()
    tied[9, 0] = np.flatnonzero(distances[9] == 3)[0]
    assert lists.wrong_rows(scene, (tied, None)) == 3


@pytest.mark.slow  # the other benches of lists get their rows in the same way
@pytest.mark.filterwarnings("ignore")  # of other libraries
def test_every_library_gets_its_rows(tmp_path, foreign):
    """`bench structures`: those that are there found the same pairs."""
    told("bench", "structures", "--count", 4, "--repeats", 20, "--out", tmp_path)
    rows = pd.read_csv(tmp_path / "cpu.csv")
    assert sorted(rows["who"]) == sorted([*structures.LIBRARIES * 2, "jfrnn"])
    done = rows[rows["status"] == "ok"]
    assert set(done["who"]) >= {"jfrnn"}
    assert (done.groupby(done["atoms"].fillna(0))["pairs"].nunique() == 1).all()


@pytest.mark.slow  # thirty programs
def test_every_kind_of_sites_gets_a_row_that_was_checked(tmp_path):
    """`bench ties`: lattices beside the same scenes moved at random, each count compared with the oracle."""
    told("bench", "ties", "--cube", 1000, "--rounds", 2, "--out", tmp_path)
    found = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert len(found) == 2 * 5
    assert (found["wrong"] == 0).all()
    assert (found["checked"] == 1000).all()
    whole = found[found["sites"].isin(["spacing 1", "spacing 1/64"])]["neighbors"]
    assert whole.nunique() == 1  # strictly less: no tie is a pair
    assert (found[["count_s", "list_s", "density_s"]] > 0).all(axis=None)


def test_libraries_that_find_nearest_triangles_agree(tmp_path):
    text = triangles.command(tmp_path, 500, [500], [0.5], 2, "warp")
    rows = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert list(rows["method"])[:3] == ["jfrnn warp update", "jfrnn warp rebuild", "jfrnn warp count"]
    assert "trimesh" in set(rows["method"])
    assert list(rows["method"])[3:6] == ["jfrnn bvh update", "jfrnn bvh rebuild", "jfrnn bvh count"]
    assert (rows["processor_s"] > 0).all()
    peers = rows[rows["method"].isin(["trimesh", "libigl", "wp.Mesh nearest"])]
    assert not peers[["missing", "extra"]].to_numpy().any()
    assert "us_per_particle" in text


def test_a_bench_of_which_no_row_has_a_result_ends_with_status_1(tmp_path, monkeypatch):
    ways = [each._replace(method="a-peer") for each in crystals._ways()]
    monkeypatch.setattr(crystals, "_ways", lambda: iter(ways))
    monkeypatch.setattr(methods, "lacks", lambda name: f"no module named {name!r}")
    words = ("bench", "crystals", "--sizes", "2x5", "--repeats", 2, "--out", tmp_path)
    for _ in range(2):  # measured, and there already
        code, out, err = invoke(*words)
        assert (code, out) == (1, "")
        assert err.endswith(f"\nerror: none of {len(ways)} rows has a result (missing: no module named 'a-peer')\n")
