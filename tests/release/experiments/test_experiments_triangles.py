"""The comparison with libraries that find nearest triangles runs, and agrees."""

import pandas as pd

from experiments.bench import triangles


def test_a_small_comparison(tmp_path):
    text = triangles.command(tmp_path, 500, [500], [0.5], 2, "warp")
    rows = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert list(rows["method"])[:3] == ["jfrnn warp update", "jfrnn warp rebuild", "jfrnn warp count"]
    assert "trimesh" in set(rows["method"])
    assert {"jfrnn warp update, hilbert order", "jfrnn bvh update, hilbert order"} < set(rows["method"])
    assert (rows["processor_s"] > 0).all()
    peers = rows[rows["method"].isin(["trimesh", "libigl", "wp.Mesh nearest"])]
    assert not peers[["missing", "extra"]].to_numpy().any()
    assert "us_per_particle" in text
