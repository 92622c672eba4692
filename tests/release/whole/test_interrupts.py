"""Handlers of signals that raise while searches run: no wrong result, nothing lost, no memory written after it was given back."""

import os
import signal
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow
from places import TESTS
from started import run_python

import jfrnn
from jfrnn._engine import launch
from jfrnn._tracing.internals import set_current_trace


def run(tries, *more):
    """Raise so many times in each of 16 works; return how often a result was wrong, and an exception lost."""
    done = run_python(TESTS / "interrupted.py", tries, *more, JAX_ENABLE_X64="0")
    print(done.stderr)  # what was dropped, and where
    words = done.stdout.split()
    return {kind: int(times) for kind, times in zip(words[::2], words[1::2])}


@pytest.mark.parametrize(("tries", "more"), [(24, ()), slow(48, ("unmapped",)), slow(300, ())])
def test_interrupted_searches_are_right_or_raise(tries, more):
    """Thousands of times, and without memory for instructions, too."""
    found = run(tries, *more)
    assert (found["wrong"], found["lost"]) == (0, 0)
    assert found["interrupted"] + found["finished"] == 16 * tries
    assert min(found["interrupted"], found["finished"]) > tries  # it was raised within searches, and behind them


@pytest.mark.parametrize("backend", ["warp", "hashgrid"])
def test_what_a_handler_raises_while_python_is_asked_is_raised_when_the_call_has_ended(backend, monkeypatch):
    """A program whose plan is gone asks on the main thread."""
    x = np.random.default_rng(0).random((40, 3), np.float32)
    count = jax.jit(lambda x: jfrnn.search(x, 0.3, capacity=40, backend=backend).count)
    right, threads, work = np.asarray(count(x)), [], launch._keep_plan

    def interrupted(*given):
        threads.append(threading.current_thread())
        os.kill(os.getpid(), signal.SIGUSR1)
        time.sleep(0.1)
        return work(*given)

    def handle(number, _):
        raise error

    error = KeyboardInterrupt("itself")
    for key in list(launch._plans):
        launch._open().drop(launch._plans.pop(key))
    monkeypatch.setattr(launch, "_keep_plan", interrupted)
    before = signal.signal(signal.SIGUSR1, handle)
    try:
        with pytest.raises(KeyboardInterrupt, match="itself") as raised:
            jax.block_until_ready(count(x))
            time.sleep(1)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert raised.value is error
    assert threads
    assert threading.main_thread() not in threads
    monkeypatch.undo()
    np.testing.assert_array_equal(count(x), right)


class Raise:
    """As a profile of Python: raise where JAX has begun a trace, or is about to end it, the next time that as many have passed."""

    def __init__(self, passed):
        self.passed, self.places = passed, (set_current_trace.__enter__.__code__, set_current_trace.__exit__.__code__)

    def __call__(self, frame, event, _):
        if (frame.f_code, event) in zip(self.places, ("c_return", "call"), strict=True):
            self.passed -= 1
            if self.passed < 0:
                sys.setprofile(None)
                raise KeyboardInterrupt


WORKS = {
    "sum": lambda x: jfrnn.pair_sum(lambda r, i, j: jnp.where(r @ r > 0, 1 - r @ r, 0), x, 0.3),
    "largest": lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.3, reduce="max"),
    "sum over a list": lambda x: jfrnn.pair_sum(lambda r, i, j: 1 - r @ r, x, None, neighbors=jfrnn.search(x, 0.3, skin=0.01)),
    "list": lambda x: jfrnn.search(x, 0.3, box=jfrnn.Box([1.0, 1.0, 1.0])).idx,
    "renewed": lambda x: jfrnn.search(x, 0.3, skin=0.01).update(x + 0.01).idx,
    "edges": lambda x: jfrnn.search_edges(x, 0.3).senders,
    "distances": lambda x: jfrnn.search(x, 0.3).distances(x)[0],
    "triangles": lambda x: jfrnn.search_triangles(x, x, np.array([[0, 1, 2], [2, 3, 4]]), 0.3).closest(x)[0],
}


@pytest.mark.parametrize("work", WORKS)
def test_what_interrupts_a_trace_leaves_none_behind(work):
    """JAX leaves its traces by Python code, in which a handler of signals may raise."""
    x, ended = np.random.default_rng(0).random((30, 3), np.float32), 0
    right = np.asarray(WORKS[work](x))
    for passed in range(20):
        sys.setprofile(Raise(passed))
        try:
            result = np.asarray(WORKS[work](x))
        except KeyboardInterrupt:
            ended += 1
        else:
            np.testing.assert_array_equal(result, right)
            break
        finally:
            sys.setprofile(None)
            assert not isinstance(jnp.ones(2) + 1, jax.core.Tracer)
    assert ended > 0
    np.testing.assert_array_equal(WORKS[work](x), right)
