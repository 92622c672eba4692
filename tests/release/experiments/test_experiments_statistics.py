"""Intervals of medians, processes put together, and what the report says of noise, the table that it writes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from commanded import told
from test_experiments_report import SCENES, make_row

from experiments import _report, _statistics, _table
from experiments._rows import RowFile, read_latest


@pytest.mark.parametrize(("n", "low", "confidence"), [(1, 0, 0.0), (2, 0, 0.5), (5, 0, 0.9375), (6, 0, 0.96875), (9, 1, 0.9609375)])
def test_the_interval_lies_between_order_statistics(n, low, confidence):
    interval = _statistics.median_interval(np.arange(n)[::-1])
    assert interval == (np.median(np.arange(n)), low, n - 1 - low, confidence)


def test_the_interval_holds_the_median_as_often_as_it_says():
    random = np.random.default_rng(1)
    held = [low <= np.log(2) <= high for _, low, high, _ in map(_statistics.median_interval, random.exponential(size=(4000, 20)))]
    promised = _statistics.median_interval(range(20)).confidence
    assert 0.95 <= promised < 0.98
    assert np.mean(held) == pytest.approx(promised, abs=0.012)


def rounds(method, medians):
    rows = [make_row(SCENES[1], method, second, 10.0, key=f"{method} {k}", process=k) for k, second in enumerate(medians)]
    return [replace(row, seconds=[row.median_s, 1.1 * row.median_s, 0.9 * row.median_s]) for row in rows]


def test_processes_become_one_row():
    rows = rounds("jax", [3.0, 1.0, 2.0, 5.0, 4.0])
    rows[2] = replace(rows[2], extra=4, search_bytes=90_000_000)
    (summary,) = _statistics.summarize(rows)
    assert (summary.median_s, summary.low_s, summary.high_s, summary.processes, summary.repeats) == (3.0, 1.0, 5.0, 5, 15)
    assert (summary.extra, summary.missing, summary.search_bytes) == (4, 0, 10_000_000)
    failed = replace(rows[0], key="f", process=9, status="failed", reason="no", median_s=None)
    partial = _statistics.summarize([*rows, failed])[0]
    assert (partial.status, partial.processes, partial.reason) == ("ok", 5, "1 of 6 processes, the first of them failed: no")
    assert _statistics.summarize([failed])[0].reason == "no"


def test_what_the_first_process_alone_finds_out_may_come_later():
    rows = rounds("jax", [3.0, 1.0, 2.0])
    rows[0] = replace(rows[0], status="missing", reason="not there", median_s=None, density_error=None)
    rows[2] = replace(rows[2], density_error=1e-9)
    rows[1] = replace(rows[1], density_error=None)
    (summary,) = _statistics.summarize(rows)
    assert (summary.density_error, summary.compile_s) == (1e-9, None)  # later processes find their kernels compiled
    assert _statistics.summarize(rounds("jax", [3.0, 1.0]))[0].compile_s == 0.5


def test_rows_measured_in_another_way_replace_those_from_before(tmp_path):
    before = rounds("jax", [3.0, 1.0, 2.0])
    again = replace(before[1], key="another way", median_s=4.0)
    for row in [*before, *rounds("cll", [1.0]), again]:
        RowFile(tmp_path).append(row)
    found = [(row.method, row.process, row.median_s) for row in read_latest(tmp_path)]
    assert found == [("jax", 0, 3.0), ("jax", 1, 4.0), ("jax", 2, 2.0), ("cll", 0, 1.0)]
    _report.report(tmp_path)
    table = pd.read_csv(tmp_path / "table.csv").set_index("method")
    assert (table.loc["jax", "median_s"], table.loc["jax", "processes"], table.loc["jax", "repeats"]) == (3.0, 3, 9)
    RowFile(tmp_path).append(replace(before[1], median_s=5.0))  # its key stands in the file already, before the other
    assert [row.median_s for row in read_latest(tmp_path)] == [3.0, 5.0, 2.0, 1.0]


def test_a_ratio_is_taken_round_by_round_so_that_drift_cancels():
    drift = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    rows = rounds("cll", drift) + rounds("jax", 1.1 * drift) + rounds("warp", drift * [0.9, 1.1, 1.0, 1.2, 0.8])
    lines = {line["method"]: line for line in _table.lines(rows)}
    assert lines["jax"]["seconds_ratio"] == pytest.approx(1.1)
    assert (lines["jax"]["within_noise"], lines["warp"]["within_noise"], lines["cll"]["within_noise"]) == (False, True, None)


def test_too_few_rounds_give_no_verdict():
    lines = {line["method"]: line for line in _table.lines(rounds("cll", [1.0, 1.0]) + rounds("jax", [2.0, 3.0]))}
    assert (lines["jax"]["within_noise"], lines["jax"]["seconds_ratio"]) == (None, 2.5)
    once = [replace(rounds(name, [second])[0], seconds=[second]) for name, second in (("cll", 1.0), ("jax", 2.0))]
    line = _table.lines(once)[1]
    assert (line["within_noise"], line["confidence"], line["seconds_ratio"]) == (None, 0.0, 2.0)


def test_rounds_of_different_machines_are_not_divided():
    cll, jax = rounds("cll", [1.0, 1.0, 1.0, 2.0, 2.0]), rounds("jax", [3.0, 3.0, 3.0, 60.0, 60.0])
    moved = [replace(row, machine=row.machine | {"system": "another"}) if row.process > 2 else row for row in jax]
    line = _table.lines(cll + moved)[1]
    assert (line["seconds_ratio"], line["within_noise"]) == (3.0, False)
    apart = [replace(row, machine=row.machine | {"cpu": "another"}) for row in jax]
    line = _table.lines(cll + apart)[1]
    assert (line["within_noise"], line["seconds_ratio"]) == (None, 3.0)
    line = _table.lines([cll[0], apart[0]])[1]
    assert line["within_noise"] is None


def test_without_cll_ratios_divide_by_a_method_that_is_there():
    rows = rounds("jax", [2.0, 4.0, 6.0]) + rounds("warp", [1.0, 2.0, 3.0])
    lines = {line["method"]: line for line in _table.lines(rows)}
    assert [lines[name]["seconds_ratio"] for name in ("jax", "warp")] == [2.0, 1.0]
    assert {line["yardstick"] for line in lines.values()} == {"warp"}


def test_of_one_process_repeats_are_told_and_said_to_be_that():
    (line,) = _table.lines(rounds("jax", [2.0]))
    assert (line["processes"], line["low_s"], line["high_s"]) == (1, 1.8, pytest.approx(2.2))


def test_pandas_reads_the_table(tmp_path):
    skipped = make_row(SCENES[0], "brute", 0, 0, status="skipped", reason="x")
    for row in [*rounds("cll", [1.0, 1.2]), *rounds("jax", [2.0, 2.2]), skipped]:
        RowFile(tmp_path).append(row)
    told("report", tmp_path)
    table = pd.read_csv(tmp_path / "table.csv")
    assert list(table.columns) == list(_table.COLUMNS)
    assert table.set_index("method").loc["cll", "median_s"] == pytest.approx(1.1)
    assert table.seconds_ratio.dtype == float
