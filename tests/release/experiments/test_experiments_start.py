"""`python -m experiments bench start`: fresh processes, and what they say."""

import pandas as pd
import pytest
from commanded import told

from experiments.bench import guides, start


@pytest.mark.parametrize("what", [("search",), pytest.param(start.WHAT, marks=pytest.mark.slow)], ids="+".join)
def test_rows_of_fresh_processes(monkeypatch, tmp_path, what):
    monkeypatch.setattr(start, "WHAT", what)
    monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # as the command sets it
    said = told("bench", "start", "--repeats", 1, "--out", tmp_path)
    table = pd.read_csv(tmp_path / "start_cpu.csv")
    assert list(zip(table["what"], table["cache"])) == [(each, cache) for each in what for cache in ("cold", "warm")]
    assert (table["status"] == "ok").all(), table["reason"]
    assert (table["said_lines"] == 0).all()  # neither the library nor Warp says a word on standard output
    assert (table[["wait_s", *start.PARTS]] > 0).all(axis=None)
    assert (table["wait_s"] < table["process_s"]).all()
    assert (table.groupby("what")["answer"].nunique() == 1).all()
    assert said.split()[:3] == ["what", "cache", "who"]


def test_a_process_that_fails_says_why(tmp_path):
    start.link(start.ROOT, tmp_path / "packages")
    row = start.run("nothing", tmp_path / "packages", tmp_path)
    assert row["status"] == "failed"
    assert row["reason"].endswith("KeyError: 'nothing'")


def test_two_checkouts_are_named_and_compared(tmp_path):
    rows = [
        {"who": who, "what": "search", "cache": "cold", "status": "ok", "wait_s": wait, "said_lines": 0}
        | dict.fromkeys(start.PARTS, wait)
        for who, wait in (("before", 4.0), ("after", 1.0), ("before", 6.0), ("after", 1.5), ("before", 2.0), ("after", 3.0))
    ]
    rows.append({"who": "after", "what": "search", "cache": "warm", "status": "failed", "reason": "a stone"})
    table = start._summarize(pd.DataFrame(rows, dtype=object))
    assert list(table["who"][:2]) == ["before", "after"]
    assert list(table["wait_s"][:2]) == [4.0, 1.5]
    assert list(table["ratio"][:2]) == [1.0, 1.5 / 4]
    assert table["what"].iloc[-1] == "failed: a stone"


@pytest.mark.slow
def test_guides_are_run_and_what_they_compile_is_counted(monkeypatch, tmp_path):
    (tmp_path / "one.md").write_text(
        "```python\nimport jfrnn\n\nn = jfrnn.count([[0.0, 0.0]], 1.0)\n```\n\n```python\nassert n[0] == 0\n```\n"
    )
    monkeypatch.setattr(guides, "GUIDES", tmp_path)
    told("bench", "guides", "--out", tmp_path)
    table = pd.read_csv(tmp_path / "guides_cpu.csv")
    assert list(zip(table["guide"], table["cache"], table["status"])) == [("one", "cold", "ok"), ("one", "warm", "ok")]
    assert table["programs"].nunique() == 1 and (table["programs"] > 0).all() and (table["kernels"] > 0).all()
    assert (table["compile_s"] < table["page_s"]).all() and (table["page_s"] < table["process_s"]).all()
