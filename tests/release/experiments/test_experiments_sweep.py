import json
import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import asdict, fields, replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from checked import refuses
from commanded import invoke, told
from places import ROOT

from experiments import _config, _machine, _measure, _rows, _sweep, _worker
from experiments._errors import UsageError

METHODS = ["jax", "warp", "cll", "scipy-kdtree", "scipy-kdtree-nolist"]  # each a process or two; test_experiments_methods has all
KDTREES = 'methods = ["scipy-kdtree", "scipy-kdtree-nolist"]\n'
QUICK = "spacing = 5e-4\nrepeats = 5\nmin_seconds = 0.0\n"
CORNERS = '[[scenes]]\nlayouts = ["corners"]\nfills = [0.11]\n'


class Sweep:
    """A folder with a config, and the command that runs it."""

    def __init__(self, folder, config, name="small"):
        folder.mkdir(exist_ok=True)
        self.config = folder / f"{name}.toml"
        self.config.write_text(config)
        self.out = folder / "out"

    @property
    def file(self):
        return self.out / "rows.jsonl"

    @property
    def command(self):
        return [sys.executable, "-m", "experiments", "run", str(self.config), "--out", str(self.out)]

    def run(self, *options, **environment):
        """Run to the end, with workers of their own but in this process; return what it said, and what its progress did."""
        code, out, err = invoke(*self.command[3:], *options, **environment)
        assert code == ("\n0 of " in f"\n{out}"), out + err  # 1 where no row has a result
        return SimpleNamespace(stdout=out, stderr=err)

    def rows(self):
        """Return the rows as they stand in the file, each line once."""
        return [json.loads(line) for line in self.file.read_text().splitlines()]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A finished sweep of every method over one scene."""
    sweep = Sweep(tmp_path_factory.mktemp("swept"), f"methods = {METHODS}\n" + QUICK + CORNERS)
    sweep.done = sweep.run()
    return sweep


def test_each_method_gives_a_whole_row(swept):
    rows = swept.rows()
    assert [row["method"] for row in rows] == METHODS
    assert "5 of 5 rows ok; rows in" in swept.done.stdout
    optional = {"reason", "allocate_s", "directed_pairs", "others_cores", "angle", "growth", "parts", "rebuilt", "device_bytes"}
    optional |= {"planned_list_bytes", "planned_scratch_bytes", "density_error", "gradient_error", "jump_error"}
    if _machine.commit()["commit"] is None:  # no git here, or no repository
        optional |= {"commit", "dirty"}
    for row in rows:
        assert set(row) == {field.name for field in fields(_rows.SearchRow)}
        assert row["status"] == "ok"
        assert {name for name, value in row.items() if value in (None, [], {})} <= optional, row["method"]
        assert (row["layout"], row["fill_asked"], row["points"], row["fill"]) == ("corners", 0.11, 256, 0.128)
        assert (row["spacing"], row["cutoff"], row["dtype"]) == (5e-4, float(np.float32(1.5e-3)), "float32")
        assert f"corners 12.8 %    {row['method']}" in swept.done.stderr, "the fill that was made"


def test_times_and_memory_of_a_row_fit_together(swept):
    for row in swept.rows():
        assert row["repeats"] == len(row["seconds"]) == 5
        assert row["median_s"] == np.median(row["seconds"])
        assert 0 < min(row["seconds"]) <= row["p10_s"] <= row["median_s"] <= row["p90_s"] <= max(row["seconds"])
        assert row["first_s"] > 0
        assert row["list_bytes"] + row["scratch_bytes"] == row["search_bytes"] <= row["peak_bytes"]
    for row in swept.rows()[:2]:
        assert row["first_s"] < row["compile_s"], row["method"]  # compiled before, whatever the machine does besides
        assert row["allocate_s"] > 0


def test_pairs_of_a_row_are_compared_with_the_exact_ones(swept):
    rows = {row["method"]: row for row in swept.rows()}
    exact = rows["jax"]["exact_pairs"]
    for method, row in rows.items():
        assert row["exact_pairs"] == exact > 0
        assert row["pairs"] == exact - row["missing"] + row["extra"], method
        assert row["compared"] == ("counts" if method == "scipy-kdtree-nolist" else "pairs")
    for method in ("jax", "warp"):
        assert (rows[method]["missing"], rows[method]["extra"], rows[method]["directed_pairs"]) == (0, 0, 2 * exact)
    assert rows["scipy-kdtree"]["extra"] == rows["scipy-kdtree-nolist"]["extra"] > 0  # pairs at exactly the cutoff
    assert rows["cll"]["missing"] > 0  # float32 decides ties as it rounds
    for method in ("jax", "warp"):
        assert (rows[method]["density_error"], rows[method]["gradient_error"], rows[method]["jump_error"]) == (0, 0, 0)
        assert rows[method]["planned_list_bytes"] == rows[method]["list_bytes"] + 8  # status, required
    assert rows["cll"]["density_error"] < 1e-12 < rows["cll"]["jump_error"]  # a tie is nothing to a kernel that ends at 0


def test_memory_holds_one_result_at_a_time(tmp_path):
    scene = '[[scenes]]\nlayouts = ["full"]\n'
    few = Sweep(tmp_path, f'methods = ["cll"]\nspacing = 2.5e-4\nrepeats = 3\nmin_seconds = 0.0\n{scene}')
    few.run()
    (row,) = few.rows()
    assert 5_000_000 < row["list_bytes"] <= row["search_bytes"] < 1.5 * row["list_bytes"]


def test_a_row_says_where_it_comes_from_but_names_no_host(swept):
    for row in swept.rows():
        assert set(row["machine"]) == {"cpu", "cores", "memory_bytes", "system"}
        assert row["versions"]["python"] == platform.python_version()
        assert all(row["versions"][name] for name in ("jfrnn", "numpy", "scipy", "jax", "warp-lang"))
        assert (row["config"], len(row["config_hash"]), len(row["key"])) == ("small", 12, 12)
        assert datetime.fromisoformat(row["time"]).utcoffset().total_seconds() == 0
        assert str(Path.home()) not in json.dumps(row)
    assert len({row["key"] for row in swept.rows()}) == len(METHODS)


def test_a_second_start_runs_nothing_again(swept):
    before = swept.file.read_bytes()
    done = swept.run()
    assert swept.file.read_bytes() == before
    assert "5 of 5 rows are there already" in done.stderr
    assert "5 of 5 rows ok" in done.stdout


def test_half_a_last_line_is_cut_off_and_measured_again(swept):
    *kept, last = before = swept.file.read_bytes().splitlines(keepends=True)
    swept.file.write_bytes(b"".join(kept) + last[: len(last) // 2])
    done = swept.run()
    assert "4 of 5 rows are there already" in done.stderr
    after = swept.file.read_bytes().splitlines(keepends=True)
    assert after[:-1] == before[:-1]
    assert json.loads(after[-1])["key"] == json.loads(last)["key"]
    assert json.loads(after[-1])["status"] == "ok"


def test_rows_that_a_limit_cut_short_are_measured_again_where_it_is_wider(tmp_path):
    sweep = Sweep(tmp_path, 'methods = ["scipy-kdtree"]\n' + QUICK + "most_seconds = 1e-9\n" + CORNERS)
    sweep.run()
    assert "1 of 1 rows are there already" in sweep.run().stderr
    assert "rows are there already" not in sweep.run("--most-seconds", "60").stderr
    assert [row["repeats"] for row in sweep.rows()] == [1, 5]
    assert [row.repeats for row in _rows.RowFile(sweep.out).read()] == [5]
    assert [row.repeats for row in _rows.read_latest(sweep.out)] == [5]
    for limit in ("60", "1e-9"):
        assert "1 of 1 rows are there already" in sweep.run("--most-seconds", limit).stderr


def test_a_method_that_is_not_installed_gives_a_row_and_the_sweep_goes_on(tmp_path):
    (tmp_path / "shadow" / "warp").mkdir(parents=True)
    (tmp_path / "shadow" / "warp" / "__init__.py").write_text("raise ImportError('there is no warp here')")
    sweep = Sweep(tmp_path, 'methods = ["cll", "scipy-kdtree"]\n' + QUICK + CORNERS)
    done = sweep.run(PYTHONPATH=str(tmp_path / "shadow"))
    assert "1 of 2 rows ok, 1 without a result (1 missing)" in done.stdout
    missing, good = sweep.rows()
    assert (missing["method"], missing["status"]) == ("cll", "missing")
    assert missing["reason"] == "cll cannot be imported: there is no warp here"
    assert (missing["median_s"], good["method"], good["status"]) == (None, "scipy-kdtree", "ok")

    sweep.run()
    assert len(sweep.rows()) == 2
    sweep.run("--retry-failed")
    assert [(row["method"], row["status"]) for row in sweep.rows()] == [("cll", "missing"), ("scipy-kdtree", "ok"), ("cll", "ok")]
    assert [row.status for row in _rows.RowFile(sweep.out).read()] == ["ok", "ok"]


def test_failed_and_skipped_rows_say_why(tmp_path):
    scenes = '[[scenes]]\nlayouts = ["full"]\nfills = [0.5]\n[[scenes]]\nlayouts = ["full"]\n'
    sweep = Sweep(tmp_path, 'methods = ["brute"]\nspacing = 2e-4\ndim = 3\n' + scenes)
    done = sweep.run()
    failed, skipped = sweep.rows()
    assert (failed["status"], skipped["status"], skipped["points"]) == ("failed", "skipped", 31250)
    assert failed["reason"].startswith("UsageError: layout 'full': fill must be 1 for the layout 'full', got 0.5")
    assert skipped["reason"] == "31250 points; brute is run up to 20000"
    assert "0 of 2 rows ok, 2 without a result (1 failed, 1 skipped)" in done.stdout


def test_a_row_that_takes_too_long_is_ended(tmp_path):
    sweep = Sweep(tmp_path, KDTREES + QUICK + "timeout = 0.01\n" + CORNERS)
    sweep.run()
    assert [(row["status"], row["reason"]) for row in sweep.rows()] == 2 * [("timeout", "not done after 0.01 s")]


@pytest.mark.skipif(sys.platform != "linux", reason="a killed runner takes its worker along on Linux alone")
def test_kill_9_loses_no_row_and_doubles_none(tmp_path):
    scenes = '[[scenes]]\nlayouts = ["full"]\nfills = [0.5]\n'  # fails at once: there is a row, and the next one is endless
    endless = "spacing = 5e-4\nrepeats = 1\nmin_seconds = 1e6\nmax_repeats = 1_000_000_000\nmost_seconds = 1e6\ntimeout = 1e6\n"
    sweep = Sweep(tmp_path, 'methods = ["scipy-kdtree"]\n' + endless + scenes + CORNERS)
    with subprocess.Popen(sweep.command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as runner:
        try:
            while not (sweep.file.exists() and sweep.file.read_text().endswith("\n")):
                assert runner.poll() is None
                time.sleep(0.02)
            workers = stop_with_a_worker(runner)
        finally:
            runner.send_signal(signal.SIGKILL)
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert (len(workers), alive) == (1, [])
    early = sweep.file.read_bytes()
    assert early.count(b"\n") == 1

    sweep.run("--most-seconds", "0.01")
    assert sweep.file.read_bytes().startswith(early)
    assert [(row["layout"], row["status"]) for row in sweep.rows()] == [("full", "failed"), ("corners", "ok")]


def stop_with_a_worker(runner):
    """Stop a runner while it has a worker, so that it starts no other, and return that."""
    while True:
        runner.send_signal(signal.SIGSTOP)
        if workers := psutil.Process(runner.pid).children():
            return workers
        runner.send_signal(signal.SIGCONT)  # it was between two of them
        time.sleep(0.02)


@pytest.mark.skipif(sys.platform != "linux", reason="a killed runner takes its worker along on Linux alone")
def test_a_worker_ends_whose_runner_was_killed_before_it_could_ask_for_a_signal():
    environment = os.environ | {_worker.RUNNER: "1"}  # who started it was another, as after the death of its parent
    command = [sys.executable, "-m", "experiments._worker"]
    done = subprocess.run(command, input="", capture_output=True, text=True, cwd=ROOT, env=environment, timeout=300)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "the runner ended before this process had begun\n")


FOUR = '[[scenes]]\nlayouts = ["corners"]\nfills = [0.02, 0.05]\n[[scenes]]\nlayouts = ["sheet"]\nfills = [0.02]\n'


@pytest.mark.slow
def test_two_shards_merged_are_the_whole(tmp_path):
    config = 'methods = ["scipy-kdtree"]\nspacing = 1e-3\nprocesses = 2\nrepeats = 2\nmin_seconds = 0.0\n' + FOUR
    whole, parts = Sweep(tmp_path / "a", config), Sweep(tmp_path / "b", config)
    whole.run()
    for part in ("1/2", "2/2"):
        parts.run("--shard", part)
    shards = [parts.out / f"shard-{k}-of-2" for k in (1, 2)]
    scenes = [{(row.layout, row.fill_asked) for row in _rows.RowFile(shard).read()} for shard in shards]
    assert [len(part) for part in scenes] == [2, 1]  # a scene is measured on one machine
    assert told("merge", parts.out).startswith("6 rows came")

    def said(rows):
        names = ("key", "layout", "fill_asked", "method", "process", "status", "pairs", "missing", "extra")
        return sorted([tuple(str(row[name]) for name in names) for row in rows])

    assert said(parts.rows()) == said(whole.rows())
    assert told("merge", parts.out).startswith("0 rows came")
    assert len(parts.rows()) == 6
    assert "6 of 6 rows are there already" in parts.run().stderr  # the whole sweep goes on from them


def test_of_one_key_a_row_with_figures_counts_when_rows_are_merged(tmp_path):
    bad, good = replace(ROW, status="failed"), replace(ROW, status="ok")
    for folder, row in (("bad", bad), ("good", good)):
        (tmp_path / folder).mkdir()
        _rows.RowFile(tmp_path / folder).append(row)
    assert _sweep.merge(tmp_path / "bad", [tmp_path / "good"]) == 1
    assert _sweep.merge(tmp_path / "good", [tmp_path / "bad"]) == 0
    assert [row.status for row in _rows.RowFile(tmp_path / "bad").read()] == ["ok"]
    (tmp_path / "more").mkdir()
    _rows.RowFile(tmp_path / "more").append(replace(good, seconds=[0.1, 0.1]))
    assert _sweep.merge(tmp_path / "more", [tmp_path / "good"]) == 0
    assert _sweep.merge(tmp_path / "good", [tmp_path / "more"]) == 1
    assert [row.seconds for row in _rows.RowFile(tmp_path / "good").read()] == [[0.1, 0.1]]
    assert _sweep.merge(tmp_path / "good", [tmp_path / "bad"]) == 0
    refuses(UsageError, "none: no rows to merge", _sweep.merge, tmp_path / "good", [tmp_path / "none"])
    refuses(UsageError, "good: no folders shard-K-of-N in it; name the folders", _sweep.merge, tmp_path / "good", [])


def test_an_array_job_measures_its_part(tmp_path):
    """The script that SLURM starts, with what SLURM sets, in a folder that has a .venv as the repository has."""
    script = ROOT / "experiments" / "slurm" / "sweep.sbatch"
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    python = tmp_path / ".venv" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    sweep = Sweep(tmp_path, 'methods = ["scipy-kdtree"]\nspacing = 1e-3\nrepeats = 2\nmin_seconds = 0.0\n' + FOUR)
    environment = os.environ | {"SLURM_SUBMIT_DIR": str(tmp_path), "SLURM_ARRAY_TASK_ID": "2", "PYTHONPATH": str(ROOT)}

    def submit(*given):
        command = ["bash", str(script), *map(str, given)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)

    assert submit(sweep.config, sweep.out, 3).returncode == 0
    assert [path.name for path in sweep.out.iterdir()] == ["shard-2-of-3"]
    assert len(_rows.RowFile(sweep.out / "shard-2-of-3").read()) == 1
    assert "number of parts" in submit(sweep.config, sweep.out).stderr


def test_where_one_run_takes_minutes_it_is_the_only_one(tmp_path):
    table = {"layouts": ("corners",), "fills": (0.02,)}
    given = {"methods": ["scipy-kdtree"], "scenes": [table], "spacing": 1e-3, "repeats": 1, "max_repeats": 1, "min_seconds": 0.0}
    (spec,) = _config.Config.model_validate(given).specs()
    row = _worker.measure(spec, tmp_path)
    assert (row["status"], row["repeats"], row["first_s"]) == ("ok", 1, row["median_s"])


ROW = _rows.SearchRow(key="a", layout="full", method="m", fill_asked=None, spacing=1.0, cutoff_ratio=3.0, dtype="f", dim=3, seed=0)


def test_rows_come_back_as_they_were_and_the_latest_of_a_key_counts(tmp_path):
    file = _rows.RowFile(tmp_path)
    assert file.read() == []
    later = replace(ROW, status="ok", seconds=[0.1, 1 / 3])
    for row in (ROW, replace(ROW, key="b"), later):
        file.append(row)
    assert file.read() == [later, replace(ROW, key="b")]


@pytest.mark.parametrize("tail", ['{"key": "c", "lay', '{"key": "c"'], ids=["in a word", "before the brace"])
def test_half_a_line_is_passed_over_and_cut_off(tmp_path, tail):
    file = _rows.RowFile(tmp_path)
    file.append(ROW)
    whole = file.path.read_bytes()
    file.path.write_bytes(whole + tail.encode())
    assert file.read() == [ROW]
    file.repair()
    assert file.path.read_bytes() == whole


def test_a_whole_line_without_its_end_is_kept(tmp_path):
    file = _rows.RowFile(tmp_path)
    file.append(ROW)
    file.path.write_bytes(file.path.read_bytes() + json.dumps(asdict(replace(ROW, key="b"))).encode())
    file.repair()
    file.append(replace(ROW, key="c"))
    assert [row.key for row in file.read()] == ["a", "b", "c"]


def test_a_line_that_is_no_row_is_named(tmp_path):
    file = _rows.RowFile(tmp_path)
    file.append(ROW)
    file.path.write_bytes(b"[1, 2]\n" + file.path.read_bytes())
    refuses(UsageError, r"rows\.jsonl: line 1 is no row .* repair or remove that line", file.read)


def test_a_folder_is_filled_by_one_process_at_a_time(tmp_path):
    file = _rows.RowFile(tmp_path)
    with file.lock(), pytest.raises(UsageError, match="another process fills this folder now"), file.lock():
        pass
    with file.lock():
        file.append(ROW)
    assert file.read() == [ROW]


def test_peak_memory_sees_what_came_and_went():
    memory = _measure.PeakMemory()
    block = np.ones(10_000_000)
    del block
    assert 75e6 < memory.peak() - memory.start < 200e6
    if memory.source == "VmHWM":
        after = _measure.PeakMemory()
        assert after.peak() - after.start < 20e6


def test_there_is_no_device_memory_on_a_cpu():
    assert _measure.DeviceMemory().peak() is None


def test_bystanders_are_other_processes_alone():
    def watch():
        """Keep this process busy; return what others and itself took [cores]."""
        bystanders, begin, worked = _measure.Bystanders(), time.perf_counter(), time.process_time()
        while (wall := time.perf_counter() - begin) < 0.5:
            pass
        return bystanders.cores(), (time.process_time() - worked) / wall

    assert _measure.Bystanders().cores() is None
    others, own = watch()
    assert others + own < psutil.cpu_count() + 0.2  # were its own work among it, there would be more than all cores
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as spinning:
        time.sleep(0.2)
        others, _ = watch()
        spinning.kill()
    assert others > 0.25


def test_repeats_go_on_until_there_are_enough_and_they_took_long_enough():
    runs = []

    def search():
        time.sleep(0.01)
        runs.append(len(runs))
        return runs[-1]

    assert _measure.repeat(search, 3, 0.0, 9)[0] == 2
    result, seconds = _measure.repeat(search, 1, 0.045, 50)
    assert (result, len(seconds)) == (len(runs) - 1, len(runs) - 3)
    assert sum(seconds) >= 0.045 > sum(seconds[:-1])
    assert len(_measure.repeat(search, 1, 60.0, 4)[1]) == 4
