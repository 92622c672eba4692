"""Particles in a box that kernels bring near it: rows, turns and what is met are those of array programs, bit by bit."""

import functools
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_numpy import image_counts
from checked import slow, sparing

import jfrnn
from jfrnn._engine.near_warp import prepare_for_kernels
from jfrnn._engine.operands import as_integer, pack_particles
from jfrnn._engine.problem import prepare_search
from jfrnn._geometry import NOT_FINITE, TOO_FAR, unpack_turns
from jfrnn._search.problem import Asked, check_problem

LENGTHS = (10.0, 7.3, 1.7)
BOUNDS = [22, 23, 24, 28, 29]  # reach, slack and turns, which XLA may count of other vectors than those of its rows


@functools.partial(jax.jit, static_argnums=(0, 2))
def pack(prepare, inputs, options):
    search = prepare(inputs, options)
    return *pack_particles(search), search.torus[1].met


def prepared(prepare, x, queries, box):
    """Return rows of sources and of queries, numbers of the lattice, and bits of what is met."""
    problem, inputs = check_problem(Asked(x, 0.8, queries=queries, box=box, backend="warp"))
    return [np.asarray(found) for found in pack(prepare, inputs, problem.options)]


def scene(dim, dtype, spread):
    """Return points in a box and in those beside it, some of them further away, and some at faces of boxes or in the middle."""
    rng, lengths = np.random.default_rng(dim), np.array(LENGTHS[:dim])
    x = (rng.uniform(-1, 2, (500, dim)) * lengths * np.where(np.arange(500) % 7 > 0, 1, spread)[:, None]).astype(dtype)
    x[::11] = (np.round(x[::11] / lengths * 2) / 2 * lengths).astype(dtype)
    x[5, 0], x[6, dim - 1] = (np.nan, -np.inf) if spread == 3 else x[5:7, 0]
    return x


def turns_in(rows, dim):
    return np.asarray(unpack_turns(as_integer(jnp.asarray(rows[:, dim])), dim))


SPREADS = [1, 2, 3, 200, 1e4, 1e7, 1e12]
CASES = list(product([0.0, 0.3, -0.7], [3, 2], [np.float32, np.float64], SPREADS))
OFTEN = [(0.0, 3, np.float32, spread) for spread in SPREADS] + [(-0.7, 3, np.float32, spread) for spread in SPREADS[:4]]
OFTEN += [(0.0, 2, np.float64, 2), (0.0, 2, np.float64, 1e7), (-0.7, 2, np.float64, 3), (-0.7, 2, np.float64, 1e12)]


@pytest.mark.parametrize(("skew", "dim", "dtype", "spread"), sparing(CASES, OFTEN))
def test_rows_are_those_of_array_programs(dim, dtype, spread, skew):
    x, periodic = scene(dim, dtype, spread), (True, False, True)[:dim] if spread in (2, 200) else True
    vectors = np.diag(LENGTHS[:dim]) + np.diag([skew * LENGTHS[1]] * (dim - 1), 1)
    for origin in (0.0, 0.3, 1e6 if dtype == np.float64 else 3e3):
        box = jfrnn.Box((vectors if skew else np.diag(vectors)).astype(dtype), periodic, origin=np.full(dim, origin, dtype))
        for queries in (None, jnp.asarray(x[:50] + dtype(0.1))):
            known = prepared(prepare_for_kernels, jnp.asarray(x), queries, box)
            expected = prepared(prepare_search, jnp.asarray(x), queries, box)
            numbers, others = known[2], expected[2]
            np.testing.assert_array_equal(np.delete(numbers, BOUNDS), np.delete(others, BOUNDS))
            assert (numbers[BOUNDS] >= others[BOUNDS] * (1 - 4 * np.finfo(dtype).eps)).all()
            for mine, theirs in zip(known[:2], expected[:2], strict=True):
                np.testing.assert_array_equal(*(rows[:, :dim].copy().view(f"i{rows.itemsize}") for rows in (mine, theirs)))
                asserted = mine[:, dim].view(f"i{mine.itemsize}") == theirs[:, dim].view(f"i{mine.itemsize}")
                if skew:  # where products are contracted with sums, another vector may be counted at a face
                    transform = others[10:19].reshape(3, 3)[:dim, :dim].astype(np.float64)
                    with np.errstate(invalid="ignore"):
                        units = (mine[:, :dim].astype(np.float64) - others[19 : 19 + dim]) @ transform
                        asserted |= (np.abs(units - np.round(units)) < 1e-3 * (dtype == np.float32) + 1e-6).any(axis=1)
                assert asserted.all()
            assert int(known[3]) & (NOT_FINITE | TOO_FAR) == int(expected[3]) & (NOT_FINITE | TOO_FAR)
            most = max(np.abs(turns_in(rows, dim)).max() for rows in known[:2])
            assert most == int(known[3]) & (NOT_FINITE - 1)


@pytest.mark.parametrize("backend", ["warp", slow("brute"), slow("jax")])
@pytest.mark.parametrize("turns", [(128, 127), (1, 2)])
def test_bounds_are_those_of_the_most_turns(turns, backend):
    """With a cutoff of nearly half the box, one turn more would not be sure that one image of each pair is enough."""
    x = np.random.default_rng(0).random((300, 3)).astype(np.float32)
    x[0] += turns[0]
    queries, box = x[:50] + np.float32(turns[1]), jfrnn.Box([1.0, 1.0, 1.0], images=0)
    x[1] += turns[1]
    near = image_counts(np.concatenate([queries, x]), 0.499, box.vectors)[:, 50:].sum(1)
    for asked, expected in ((None, near[50:]), (queries, near[:50])):
        np.testing.assert_array_equal(jfrnn.count(x, 0.499, queries=asked, box=box, backend=backend), expected)


def test_one_call_serves_a_search_and_its_checks():
    """A sum of a program asks whether particles are too far away, which the call for its rows has found."""
    x, box = jnp.asarray(np.random.default_rng(0).random((300, 3)), jnp.float32), jfrnn.Box([1.0, 1.0, 1.0])
    program = jax.jit(lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.2, box=box, backend="warp")).lower(x).compile()
    assert program.as_text().count('kernel = "jfrnn_near') == 1
