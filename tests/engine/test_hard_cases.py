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


EXACT = ("residues", "residues_balanced")  # most pairs are decided in integers, which array programs do slowly
SCALED = ("near_max", "clumps_near_max", "tiny_scale")  # lengths are scaled: other programs
BRUTE = ("lattice_1_at_0", "ulp_away", "n_33")  # all pairs are tested as "jax" tests those of cells


def is_default(name, dtype, dim, closed, backend):
    """Say whether a combination runs by default: each case in as few programs as meet each dtype, dimension and comparison.

    "warp" answers each case in both dtypes, and half of them in another dimension, too, where pairs at the cutoff count. "jax" and
    "hashgrid", whose programs take long to compile, answer each case in one of two kinds, but for two on "jax"; "brute" a few.
    """
    kind, place, queried = (dtype, dim, closed), NAMES.index(name), "queries" in name or name == "no_sources"
    odd = place % 2 == 1
    first, second = (np.float32, 3, False), (np.float64, 2, False)
    if backend == "warp":
        return kind in (first, second, {0: (np.float64, 3, True), 1: (np.float32, 2, True)}.get(place % 4))
    if backend == "hashgrid":
        return kind == ((np.float32, 3, True) if not queried and (odd or name in SCALED) else second)
    if backend == "jax" and name in ("uniform", "mixed_exponents"):  # another program, and as much time as all others take
        return False
    if backend == "jax":
        return kind == (first if name not in EXACT and not queried and (odd or name in SCALED) else second)
    return kind == first and (queried or name in BRUTE)


def each_case():
    """Yield every dtype, dimension, comparison, case and backend, in an order in which the oracle answers each case once."""
    for dtype, dim, closed, name, backend in product((np.float32, np.float64), (2, 3), (False, True), NAMES, BACKENDS):
        kind = f"f{8 * dtype().itemsize}-{dim}d-{'closed' if closed else 'open'}"
        marks = [] if is_default(name, dtype, dim, closed, backend) else [pytest.mark.slow]
        if (dtype, dim, closed, backend) == (np.float32, 3, False, "warp") and name not in SCALED:
            marks.append(pytest.mark.kernels)
        yield pytest.param(name, dtype, dim, closed, backend, id=f"{kind}-{name}-{backend}", marks=marks)


@pytest.mark.parametrize(("name", "dtype", "dim", "closed", "backend"), list(each_case()))
def test_hard_case(name, dtype, dim, closed, backend):
    given = HARD_CASES[name].build(dtype, dim)
    rows = max(len(given.positions), 0 if given.queries is None else len(given.queries))
    length = 704 if rows <= 704 else 2048
    nbrs = checked.search_padded(given, length, CAPACITY, backend=backend, closed=closed)
    checked.assert_pairs(nbrs, expected_pairs(name, dtype, dim, closed))  # the padding is NaN and in no pair


# Sizes, unpadded, each a program of its own: by default of one kind, on Warp some of two, on array engines but one.
EMPTY, SOME, OTHERS = ("n_0", "no_queries", "no_sources"), ("n_1", "queries_fewer"), ("n_2", "n_33", "n_65")
SIZES = list(product(EMPTY + SOME + OTHERS, (np.float32, np.float64), (2, 3), BACKENDS))
OFTEN = [*product(EMPTY, [np.float32], [3], BACKENDS), *product(SOME, [np.float32], [3], BACKENDS[2:])]
OFTEN += [*product(OTHERS, [np.float32], [3], ["warp"]), *product(("n_0", *SOME), [np.float64], [2], ["warp"])]
OFTEN += [("n_33", np.float64, 2, "jax")]


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), checked.sparing(SIZES, OFTEN))
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


@pytest.mark.parametrize("periodic", [pytest.param(False, id="open"), checked.slow(True, id="periodic along x")])
def test_rows_of_cells_that_hold_few(periodic):
    """Pairs of a ragged surface, whose queries CUDA serves in parts, are those of array programs, and rows the same each time."""
    rng, cutoff = np.random.default_rng(5), np.float32(0.055)
    body, strewn = rng.uniform(size=(40_000, 3)), rng.uniform(size=(600, 3))
    strewn[:, 2] = 1 + cutoff * rng.integers(0, 12, 600)
    x = np.concatenate([body, strewn]).astype(np.float32)
    space = {"box": jfrnn.Box([1.0, 1.0, 1.0], periodic=[True, False, False])} if periodic else {}
    rows = [jfrnn.search(x, cutoff, backend=backend, capacity=64, **space) for backend in ("warp", "warp", "jax")]
    for nbrs in rows:
        nbrs.check()
    first, again, expected = (np.asarray(nbrs.idx) for nbrs in rows)
    assert (first == again).all()
    assert (np.sort(first, axis=1) == np.sort(expected, axis=1)).all()
