"""Adapters of methods beyond the library's own: what each finds, where it is installed."""

import os
import shutil

import numpy as np
import pytest
from checked import refuses

from experiments import _compare, _native, _oracle, methods

OURS = {"brute", "cll", "hashgrid", "jax", "pair-sum", "warp", "warp-counts"}  # run by the tests of the sweep and of the engines
MOVING = ["nanoflann-dynamic", "nanoflann-rebuild", "warp-rebuild", "warp-update"]
OTHERS = [name for name in methods.names() if name not in OURS and name not in MOVING]


def find(name, positions, cutoff):
    """Run a method once; skip where it is not installed."""
    try:
        adapter = methods.load(name)
    except ImportError as error:
        pytest.skip(f"{name}: {error}")
    capacity = (adapter.allocate(positions, cutoff),) if hasattr(adapter, "allocate") else ()
    return adapter.read(adapter.prepare(positions, cutoff, *capacity)())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", OTHERS)
def test_pairs_without_ties_are_the_exact_ones(name, foreign):
    positions = np.random.default_rng(3).random((700, 3)).astype(np.float32)
    cutoff = _oracle.round_cutoff(0.15, np.float32)
    exact = _oracle.find_pairs(positions, cutoff)
    row = _compare.compare(find(name, positions, cutoff), exact, len(positions))
    assert (row["missing"], row["extra"], row["pairs"]) == (0, 0, len(exact)), row


@pytest.mark.parametrize("name", MOVING)
def test_methods_that_follow_motion_find_the_pairs_where_particles_are(name, foreign):
    try:
        adapter = methods.load(name)
    except ImportError as error:
        pytest.skip(f"{name}: {error}")
    positions = np.random.default_rng(3).random((300, 3)).astype(np.float32)
    cutoff = _oracle.round_cutoff(0.2, np.float32)
    search = adapter.follow(positions, cutoff, 0.002)
    for _ in range(2):
        found = adapter.read(search())
        gone = np.linalg.norm(found.positions.astype(float) - positions, axis=1)
        assert 0.001 < gone.min() < gone.max() < cutoff / 3
        row = _compare.compare(found, _oracle.find_pairs(found.positions, cutoff), 300)
        assert (row["missing"], row["extra"], row["pairs"] > 0) == (0, 0, True)
    if name.startswith("warp-"):
        plan = adapter.plan(positions, cutoff)
        assert (plan.list_bytes, plan.backend) == (found.list_bytes + 8, "warp")  # status, required
    shares = {"warp-update": (0.05, 0.2), "warp-rebuild": (1.0, 1.0)}
    assert found.rebuilt is None if name not in shares else shares[name][0] <= found.rebuilt <= shares[name][1]


@pytest.mark.parametrize(("name", "pointers"), [("pair-sum", 16), ("warp-counts", 0)])  # XLA counts those to two sums as results
def test_methods_without_a_list_plan_their_results(name, pointers):
    positions = np.random.default_rng(3).random((300, 3)).astype(np.float32)
    plan = methods.load(name).plan(positions, 0.2)
    assert (plan.list_bytes, plan.result_bytes) == (0, find(name, positions, 0.2).list_bytes + pointers)


def test_the_list_of_the_thesis_and_the_sane_one_are_the_same():
    positions = np.random.default_rng(4).random((300, 3))
    naive, sane = (find(name, positions, 0.2) for name in ("ann-kd-naive", "ann-kd"))
    listed = [sorted(map(tuple, np.stack(found.pairs, axis=1).tolist())) for found in (naive, sane)]
    assert listed[0] == listed[1] != []
    assert set(naive.parts) == {"t_tree", "t_ksearch", "t_frsearch", "t_processing"}
    assert naive.parts["t_processing"] > sane.parts["t_processing"] > 0


def test_an_adapter_says_what_it_lacks(monkeypatch):
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    lacks = r"no/such/header\.h is not installed: apt-get install libnothing-dev" if compiler else r"no C\+\+ compiler: install g"
    refuses(ImportError, lacks, _native.load, "ann", "no/such/header.h", "libnothing-dev")
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ImportError, match="no C\\+\\+ compiler: install g\\+\\+, or name one in the environment variable CXX"):
        _native.load("ann", "ANN/ANN.h", "libann-dev")


@pytest.mark.usefixtures("foreign")
def test_methods_that_cannot_be_imported_are_those_that_lack_something():
    found = []
    for name in methods.names():
        try:
            methods.load(name)
        except ImportError:
            found.append(name)
    assert found == [name for name in methods.names() if methods.lacks(name)]


def test_without_a_compiler_its_methods_are_said_to_lack_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    methods._lacks.cache_clear()
    said = [methods.lacks(name) for name in ("ann-kd", "scipy-kdtree")]
    methods._lacks.cache_clear()
    assert said == ["no C++ compiler: install g++, or name one in the environment variable CXX", None]
