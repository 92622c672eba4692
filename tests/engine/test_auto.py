"""Which engine answers: "auto" on every platform, with and without Warp, and engines that are named but cannot run."""

import collections
import csv

import jax
import numpy as np
import pytest
import reference
from places import ROOT
from started import run_python

import jfrnn
from jfrnn._engine import auto as _auto

X = np.random.default_rng(0).random((50, 3)).astype(np.float32)
ROWS = ROOT / "experiments" / "results" / "crossovers" / "cpu.csv"


def test_auto_takes_warp_and_says_so():
    assert jfrnn.search(X, 0.3).backend == "warp"
    assert jax.eval_shape(lambda x: jfrnn.search(x, 0.3, capacity=50), X).backend == "warp"
    assert jax.eval_shape(lambda x: jfrnn.search(x, 0.3, queries=X[:5], capacity=50), X).backend == "warp"
    np.testing.assert_array_equal(jfrnn.count(X, 0.3), np.bincount([i for i, _ in reference.reference_pairs(X, 0.3)], minlength=50))


@pytest.mark.parametrize("backend", ["jax", "brute", "warp", "hashgrid"])
def test_a_named_engine_is_the_one_that_runs(backend):
    assert jax.eval_shape(lambda x: jfrnn.search(x, 0.3, capacity=8, backend=backend), X).backend == backend


def run_without_warp(code):
    """Run code in a fresh process that cannot import Warp; return its output."""
    blocker = """
import sys, warnings
import numpy as np

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "warp":
            raise ModuleNotFoundError(f"No module named {name!r}")

sys.meta_path.insert(0, Blocker())
import jax, jfrnn
X = np.random.default_rng(0).random((50, 3)).astype(np.float32)
"""
    return run_python("-c", blocker + code).stdout


@pytest.fixture(scope="module")
def without_warp():
    """Return the lines of a process that lets "auto" choose, then asks for engines by name, which warn of nothing."""
    text = run_without_warp("""
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(jfrnn.search(X, 0.3, capacity=9).backend, jfrnn.search(X, 0.2, capacity=9).backend, jfrnn.memory_plan(50, 0.3, 8).backend)
    print(int(jfrnn.count(X, 0.3).sum()))
print(len(caught), caught[0].category.__name__, caught[0].filename)
print(caught[0].message)
warnings.simplefilter("error")
for backend in ("warp", "hashgrid"):
    for call in (jfrnn.search, jfrnn.count, lambda x, r, backend: jfrnn.memory_plan(50, r, 8, backend=backend)):
        try:
            call(X, 0.3, backend=backend)
        except ImportError as error:
            print(error)
print(*(jax.eval_shape(lambda x: jfrnn.search(x, 0.3, capacity=9, backend=backend), X).backend for backend in ("jax", "brute")))
""")
    return text.splitlines()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the warning names the platform")
def test_without_warp_auto_takes_jax_and_warns_once(without_warp):
    engines, pairs, warned, message = without_warp[:4]
    assert engines == "jax jax jax"
    assert int(pairs) == np.sum(jfrnn.count(X, 0.3))
    assert warned == "1 RuntimeWarning <string>"
    assert message == (
        "backend='auto' takes the slower engine 'jax' on the platform 'cpu': the backends 'warp' and 'hashgrid' need the package "
        "warp-lang (1.18 or 1.19): pip install 'warp-lang==1.19.*'. Pass backend='jax' to choose it without this warning."
    )


def test_without_warp_named_engines_say_what_to_install(without_warp):
    *messages, engines = without_warp[4:]
    assert messages == 6 * [
        "the backends 'warp' and 'hashgrid' need the package warp-lang (1.18 or 1.19): pip install 'warp-lang==1.19.*'"
    ]
    assert engines == "jax brute"


@pytest.fixture
def unknown_platform(monkeypatch):
    """Pretend that JAX makes arrays on a platform for which Warp has no engine."""
    monkeypatch.setattr(_auto, "default_platform", lambda: "abacus")
    yield "abacus"
    for function in (_auto._what_is_missing, _auto._can_warp):
        function.cache_clear()


def test_a_platform_without_measurements_takes_jax(unknown_platform):
    assert jax.eval_shape(lambda x: jfrnn.search(x, 0.3, capacity=40), X).backend == "jax"


def test_a_platform_without_warp_falls_back_and_warns_once(unknown_platform, monkeypatch):
    monkeypatch.setitem(_auto._WARP_FROM, unknown_platform, 0)
    with pytest.warns(RuntimeWarning, match=r"the platform 'abacus': Warp has no engine for .*Pass backend='jax'") as caught:
        for capacity in (40, 50):
            assert jax.eval_shape(lambda x, k=capacity: jfrnn.search(x, 0.3, capacity=k), X).backend == "jax"
    assert [warning.filename for warning in caught] == [__file__]


@pytest.mark.parametrize("backend", ["warp", "hashgrid"])
def test_a_named_engine_does_not_fall_back(backend, unknown_platform):
    with pytest.raises(RuntimeError, match=f"backend='{backend}' cannot run on the platform 'abacus': Warp has no engine for"):
        jax.jit(lambda x: jfrnn.search(x, 0.3, capacity=50, backend=backend))(X)


def test_concrete_arrays_know_their_platform(unknown_platform):
    assert jfrnn.search(jax.numpy.asarray(X), 0.3).backend == "warp"


def test_the_default_device_decides_for_traced_arrays():
    assert _auto.default_platform() == jax.default_backend()
    for device in ("cpu", jax.devices("cpu")[0]):
        with jax.default_device(device):
            assert _auto.default_platform() == "cpu"


def test_the_choice_is_the_measured_one():
    """At every size and number of neighbors that was measured, no engine was much faster than the one that "auto" takes."""
    scenes = collections.defaultdict(dict)
    with ROWS.open(newline="") as stream:
        for row in csv.DictReader(stream):
            assert (row["missing"], row["extra"]) == ("0", "0")
            scenes[int(row["n"]), int(row["neighbors"])][row["backend"]] = float(row["median_s"])
    assert {16, 100_000} <= {n for n, _ in scenes}
    assert _auto.fastest_engine("cpu", 10**6).name == "warp"
    for (n, _), seconds in scenes.items():
        fastest = min(seconds.values())
        assert seconds[_auto.fastest_engine("cpu", n).name] < max(1.1 * fastest, fastest + 1e-4), n
