"""`python -m experiments bench distributed`: rows, what is sent, the table; in a process of its own, which asks for its devices."""

import json

import pytest
from places import ROOT
from started import run_python

from experiments._config import load
from experiments.bench import distributed

CONFIG = """
devices = [1, 2, 4]
scaling = ["strong"]
work = ["pair_sum"]
side = 6
nx = 4
repeats = 1
min_seconds = 0.0
steps = 2
virtual_devices = 2
backend = "warp"
"""


def run(tmp_path, text):
    (tmp_path / "tiny.toml").write_text(text)
    words = ("bench", "distributed", tmp_path / "tiny.toml", "--out", tmp_path / "out")
    done = run_python("-m", "experiments", *words, JAX_PLATFORMS="cpu")
    rows = [json.loads(line) for line in (tmp_path / "out" / "rows.jsonl").read_text().splitlines()]
    return done.stdout, rows


def test_rows_of_a_tiny_run(tmp_path):
    out, rows = run(tmp_path, CONFIG)
    assert [(row["devices"], row["status"]) for row in rows] == [(1, "ok"), (2, "ok"), (4, "skipped")], rows
    for row in rows[:2]:
        assert row["particles"] == 216
        assert row["pairs"] == row["pairs_of_one"] > 216 * 20
        assert row["differing"] == 0
        assert row["median_s"] > 0
    assert (rows[0]["sent_bytes"], rows[0]["halo"]) == (0, 0)
    halo = rows[1]["halo"]
    assert 0.8 * 2 * 3 * 36 < halo < 1.2 * 2 * 4 * 36  # layers within the cutoff of the bound, and jitter
    assert rows[1]["halo_bytes"] == 12 * halo < 20 * halo < rows[1]["sent_bytes"] < 2 * 32 * halo
    assert out.count("strong") == 3
    config = load(tmp_path / "tiny.toml", distributed.Config)  # in this process nothing could be measured as it was
    assert distributed.run(config, tmp_path / "out") == rows


@pytest.mark.slow
def test_all_kinds_of_work(tmp_path):
    _, rows = run(tmp_path, (ROOT / "experiments/configs/distributed_smoke.toml").read_text().replace("side = 12", "side = 6"))
    assert {row["status"] for row in rows} == {"ok"}, rows
    expected = {(s, w) for s in ("strong", "weak") for w in ("list", "pair_sum", "sph")}
    assert {(row["scaling"], row["work"]) for row in rows} == expected
    assert {row["differing"] for row in rows if row["devices"] > 1} == {0}


def test_configs_can_be_read():
    for name in ("distributed_smoke", "distributed_cpu", "distributed_h200", "distributed_h200_x2", "distributed_h200_x2_full"):
        config = load(ROOT / "experiments" / "configs" / f"{name}.toml", distributed.Config)
        rows = len(config.scaling) * len(config.work) * len(config.axes) * len(config.devices)
        assert len(set(config.specs())) == rows


def test_bytes_that_a_program_sends():
    pairs = "source_target_pairs={{0,1},{1,2}}"
    lines = [
        f"%a = f32[2,3]{{1,0}} collective-permute(f32[2,3]{{1,0}} %b), {pairs}",
        f"%c = (s32[5]{{0}}, s32[5]{{0}}, u32[], u32[]) collective-permute-start(%d), {pairs}",
        f"%e = ((f32[7]{{0}}, f64[2,2]{{1,0}}), (f32[7]{{0}}, f64[2,2]{{1,0}})) collective-permute-start(%f, %g), {pairs}",
        f"%h = (f32[6,3]{{1,0}}, s32[6]{{0}}) collective-permute(%a, f32[2,3]{{1,0}} %b), channel_id=1, {pairs}",
        f"%l = (f32[4]{{0}}, s32[3]{{0}}, f32[4]{{0}}, s32[3]{{0}}) collective-permute-start(%a, %b), channel_id=2, {pairs}",
        "%h = s32[5]{0} collective-permute-done(%c)",
        "%i = f32[9]{0} add(%j, %k)",
    ]
    assert distributed.sent_bytes("\n".join(lines)) == 2 * (24 + 20 + (28 + 32) + (72 + 24) + (16 + 12))
