"""Every backend, dtype and dimension against the oracle on every hard case."""

import functools
from itertools import product

import checked
import numpy as np
import pytest
import reference

import jfrnn
from jfrnn.cases.hard import HARD_CASES

BACKENDS = ("jax", "brute", "warp", "hashgrid")
CAPACITY = 704  # the fullest row of all hard cases fits


@pytest.fixture(params=BACKENDS)
def backend(request):
    return request.param


REFUSED = "denormal_lattice"  # its cutoff is a denormal: see test_denormal_cutoff_is_refused
NAMES = [name for name in HARD_CASES if name != REFUSED]


def test_denormal_cutoff_is_refused(dtype, dim, backend):
    given = HARD_CASES[REFUSED].build(dtype, dim)
    with pytest.raises(ValueError, match=r"cutoff=.* is outside .* choose another unit of length"):
        jfrnn.search(given.positions, given.cutoff, backend=backend)


@functools.lru_cache(maxsize=1)
def expected_pairs(name, dtype, dim, closed):
    given = HARD_CASES[name].build(dtype, dim)
    return reference.reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)


def each_case():
    """Yield every dtype, dimension, comparison, case and backend, in an order in which the oracle answers each case once.

    By default "warp" takes each dtype in each dimension, and either comparison with each of them; of the array engines, which
    decide alike and compile slowly, and of "hashgrid" more kinds run by hand alone.
    """
    for dtype, dim, closed, name, backend in product((np.float32, np.float64), (2, 3), (False, True), NAMES, BACKENDS):
        often = (dtype, dim) in ((np.float32, 3), (np.float64, 2))
        first = (dtype, dim) == (np.float32, 3)
        rarely = {
            "brute": closed or not first,
            "jax": closed or not often,
            "hashgrid": not often or closed is not first,
            "warp": closed is often,
        }[backend]
        kind = f"f{8 * dtype().itemsize}-{dim}d-{'closed' if closed else 'open'}"
        yield pytest.param(name, dtype, dim, closed, backend, id=f"{kind}-{name}-{backend}", marks=[pytest.mark.slow] * rarely)


@pytest.mark.kernels
@pytest.mark.parametrize(("name", "dtype", "dim", "closed", "backend"), list(each_case()))
def test_hard_case(name, dtype, dim, closed, backend):
    given = HARD_CASES[name].build(dtype, dim)
    rows = max(len(given.positions), 0 if given.queries is None else len(given.queries))
    length = 704 if rows <= 704 else 2048
    nbrs = checked.search_padded(given, length, CAPACITY, backend=backend, closed=closed)
    checked.assert_pairs(nbrs, expected_pairs(name, dtype, dim, closed))  # the padding is NaN and in no pair


def each_size():
    """Yield sizes, unpadded, each a program of its own: of the array engines, which compile slowly, one of one kind."""
    empty, others = ("n_0", "no_queries", "no_sources"), ("n_1", "n_2", "n_33", "n_65", "queries_fewer")
    for name, dtype, dim, backend in product(empty + others, (np.float32, np.float64), (2, 3), BACKENDS):
        slowly = name in others and (backend == "brute" or (backend == "jax" and (name, dtype, dim) != ("n_33", np.float64, 2)))
        kind = f"{name}-f{8 * dtype().itemsize}-{dim}d-{backend}"
        yield pytest.param(name, dtype, dim, backend, id=kind, marks=[pytest.mark.slow] * slowly)


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), list(each_size()))
def test_sizes_as_they_are(name, dtype, dim, backend):
    given = HARD_CASES[name].build(dtype, dim)
    nbrs = jfrnn.search(given.positions, given.cutoff, queries=given.queries, backend=backend)
    checked.assert_exact(nbrs, given.positions, given.cutoff, queries=given.queries)
    nbrs.check()
    i, j = nbrs.pairs()
    assert i.dtype == j.dtype == np.int32
    assert len(i) == len(j) == int(np.sum(nbrs.count))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_case_as_it_is(name, dtype, dim, backend):
    """Eager, unpadded, capacity counted: hundreds of compilations, hence slow."""
    given = HARD_CASES[name].build(dtype, dim)
    for options in ({}, {"closed": True}):
        nbrs = jfrnn.search(given.positions, given.cutoff, queries=given.queries, backend=backend, **options)
        checked.assert_exact(nbrs, given.positions, given.cutoff, queries=given.queries, **options)
