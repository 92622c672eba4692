"""`python -m experiments bench peers`: what others answer on the catalog of hard cases, here of peers that are always there."""

import csv

import numpy as np
import pytest
from checked import slow
from commanded import told

from experiments.bench import peers
from jfrnn.cases.catalog import CATALOG, TABLES, problem


def test_every_case_of_the_catalog_exists():
    cases = [case for row in CATALOG for case in row.cases]
    assert len(set(cases)) == len(cases)
    for case in cases:
        table, name = case.split("/")
        assert name in TABLES[table]
        assert np.isfinite(problem(case, np.float32, 3).cutoff)


def test_answers_are_judged_and_tabled(tmp_path, monkeypatch):
    kept = {"hard/integers_9", "periodic/flat", "batches/far_apart"}
    rows = [row._replace(cases=tuple(case for case in row.cases if case in kept)) for row in CATALOG]
    monkeypatch.setattr(peers, "CATALOG", tuple(row for row in rows if row.cases))
    said = told("bench", "peers", "jfrnn", "scipy", "--out", tmp_path)
    with (tmp_path / "answers.csv").open() as stream:
        answers = {(row["peer"], row["case"]): row for row in csv.DictReader(stream)}
    assert {row["answer"] for (peer, _), row in answers.items() if peer == "jfrnn"} == {"right"}
    ties = answers["scipy", "hard/integers_9"]  # its list is closed
    assert (ties["answer"], ties["missing"]) == ("right, closed", "0")
    assert int(ties["extra"]) > 0
    assert answers["scipy", "periodic/flat"]["answer"] == "no skewed boxes"
    assert "| left-handed and skewed boxes | right | no skewed boxes |" in said
    assert "| batches | right | not asked |" in said


def _stop(given):
    raise SystemExit(3)


def _sleep(given):
    import time

    time.sleep(60)


@pytest.mark.parametrize(("ask", "said"), [pytest.param(_stop, "crash (3)", id="crash"), slow(_sleep, "none in 2 s", id="endless")])
def test_a_peer_that_crashes_or_does_not_end_says_so(ask, said, monkeypatch):
    monkeypatch.setattr(peers, "_serve", _serve_with)
    monkeypatch.setattr(peers, "PEERS", {ask.__name__: peers._Peer("jfrnn", ask)})
    names = ["hard/n_1", "hard/n_2"][: 2 if ask is _stop else 1]  # the next one is asked of another process
    answers = list(peers._answers(ask.__name__, names, 2.0))
    assert [answer["answer"] for answer in answers] == [said] * len(names)


def _serve_with(name, pipe):
    """Serve a peer of this file: a process of its own does not know what the test has patched."""
    peers.PEERS[name] = peers._Peer("jfrnn", {"_stop": _stop, "_sleep": _sleep}[name])
    peers._serve(name, pipe)
