"""Batches: every case of `jfrnn.cases.batches` against the oracle, system by system, then what lists make of them."""

import functools
from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow, sparing
from test_box import image_pairs, masked_images

import jfrnn
from jfrnn.cases.batches import BATCH_CASES

LENGTH, CAPACITY = 136, 256


@functools.lru_cache(maxsize=64)
def expected_images(name, dtype, dim, closed=False):
    """Return (i, j, S) of the pairs within a system; S is 0 in open space."""
    given = BATCH_CASES[name].build(dtype, dim)
    if given.lengths is None:
        pairs = reference.reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)
        found = {(i, j, (0,) * dim) for i, j in pairs}
    else:
        matrix = np.diag(given.lengths)
        found = reference.reference_images(given.positions, given.cutoff, matrix=matrix, periodic=(True,) * dim, closed=closed)
    of_queries = given.batch if given.query_batch is None else given.query_batch
    return {pair for pair in found if of_queries[pair[0]] == given.batch[pair[1]]}


def numbered(systems):
    """Return systems padded as the NaN rows of positions are, with a number that none of them has."""
    return np.concatenate([systems, np.full(LENGTH - len(systems), 12345, np.int32)])


def search_case(name, dtype, dim, backend, radii=False, **options):
    """Search a case padded to one length, so that cases share compiled programs; return the list, positions and queries."""
    given = BATCH_CASES[name].build(dtype, dim)
    x, batch, queries = jnp.asarray(checked.padded(given.positions, LENGTH)), numbered(given.batch), {}
    if given.queries is not None:
        queries, batch = {"queries": jnp.asarray(checked.padded(given.queries, LENGTH))}, (batch, numbered(given.query_batch))
    box = {} if given.lengths is None else {"box": jfrnn.Box(given.lengths)}
    cutoff = jnp.full(LENGTH, given.cutoff, dtype) if radii else given.cutoff
    nbrs = jfrnn.search(x, cutoff, batch=batch, backend=backend, capacity=CAPACITY, **queries, **box, **options)
    return nbrs, x, queries


def assert_case(name, dtype, dim, backend, closed=False, **options):
    nbrs, x, queries = search_case(name, dtype, dim, backend, closed=closed, **options)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE  # the padding
    found = image_pairs(nbrs, x, **queries)
    assert nbrs.box is None or masked_images(nbrs, x, **queries) == found
    checked.assert_same(found, expected_images(name, dtype, dim, closed))


# By default two kinds of cases that share a program, one of others and of array engines.
ALONE = {"queries": (np.float32, 3), "periodic": (np.float32, 3), "periodic_images": (np.float64, 2)}
SHARING = [name for name in BATCH_CASES if name not in ALONE]
OFTEN = [(name, *kind, "warp") for name, kind in ALONE.items()] + list(product(SHARING, [np.float32], [2], ["jax"]))
OFTEN += [(name, *kind, "warp") for name in SHARING for kind in ((np.float32, 3), (np.float64, 2))]
EACH = list(product(BATCH_CASES, (np.float32, np.float64), (2, 3), ("jax", "warp", "brute")))


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), sparing(EACH, OFTEN))
def test_case(name, dtype, dim, backend):
    assert_case(name, dtype, dim, backend)


WITH_RADII = [case for case in EACH if case[1:3] in ((np.float32, 3), (np.float64, 2)) and case[3] != "brute"]


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), sparing(WITH_RADII, product(SHARING, [np.float32], [3], ["warp"])))
def test_case_with_a_cutoff_per_particle(name, dtype, dim, backend):
    rule = "gather" if name == "queries" else "mean"  # of all of them, the same cutoff
    assert_case(name, dtype, dim, backend, radii=True, radius_rule=rule)


@pytest.mark.parametrize("rule", ["gather", slow("either")])
def test_systems_on_top_of_each_other_whose_cutoffs_differ_widely(rule):
    """Most particles of each system stand in one place, with tiny cutoffs: sources are sorted into a tree."""
    random, systems, n, crowd = np.random.default_rng(0), 3, 180, 120
    one = random.random((n, 3)).astype(np.float32)
    one[:crowd] = 0.5 + 1e-3 * one[:crowd]
    order = random.permutation(systems * n)
    x, batch = np.tile(one, (systems, 1))[order], np.repeat(np.arange(systems, dtype=np.int32), n)[order]
    cutoffs = np.tile(np.where(np.arange(n) < crowd, np.float32(1e-4), np.float32(0.3)), systems)[order]
    nbrs = jfrnn.search(x, cutoffs, batch=batch, radius_rule=rule, capacity=256, backend="warp")
    expected = set()
    for system in range(systems):
        (ids,) = np.nonzero(batch == system)
        expected |= {(ids[i], ids[j]) for i, j, _ in reference.reference_radii(x[ids], cutoffs[ids], rule)}
    assert set(reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), len(x))) == expected


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_closed_and_half(backend):
    assert_case("ties", np.float32, 3, backend, closed=True)
    nbrs, *_ = search_case("ties", np.float32, 3, backend, half=True)
    expected = {(i, j) for i, j, _ in expected_images("ties", np.float32, 3) if i < j}
    assert set(reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), LENGTH)) == expected


def test_updates_keep_the_systems():
    given, shift = BATCH_CASES["superposed"].build(np.float32, 3), np.float32(0.25)
    nbrs = jfrnn.search(given.positions, given.cutoff, batch=given.batch, skin=0.1, slack=2.0)
    moved = given.positions * (1 - shift * given.positions)
    again = jax.jit(lambda nbrs, x: nbrs.update(x))(nbrs, moved)
    again.check()
    assert again.rebuild_count == 1
    pairs = reference.reference_pairs(moved, given.cutoff)
    expected = {(i, j) for i, j in pairs if given.batch[i] == given.batch[j]}
    assert checked.slots_as_set(again.idx, again.distances(moved)[1]) == expected


def test_traced_systems_share_one_program():
    given, traces = BATCH_CASES["superposed"].build(np.float32, 2), []

    @jax.jit
    def count(x, batch):
        traces.append(None)
        return jfrnn.count(x, 0.375, batch=batch)

    pairs = reference.reference_pairs(given.positions, 0.375)
    for batch in (given.batch, 0 * given.batch):
        expected = np.bincount([i for i, j in pairs if batch[i] == batch[j]], minlength=len(batch))
        np.testing.assert_array_equal(count(given.positions, batch), expected)
    assert len(traces) == 1


X, SYSTEMS = np.zeros((4, 3), np.float32), np.zeros(4, np.int32)
PAIR = {"queries": X[:2]}


@pytest.mark.parametrize(
    ("error", "match", "options"),
    [
        (TypeError, "batch must be an array of integers, the system of each particle, got float32", {"batch": X[:, 0]}),
        (TypeError, "batch must be an array of integers.*got set", {"batch": {0, 1}}),
        (ValueError, r"batch must have shape \[4\], the system of each particle, got shape \[3\]", {"batch": SYSTEMS[:3]}),
        (ValueError, r"batch holds numbers from 0 to 4294967296", {"batch": np.array([0, 1, 2, 2**32])}),
        (ValueError, r"batch must be a pair of arrays.* positions \[4\] and of the queries \[2\]", {"batch": SYSTEMS, **PAIR}),
        (ValueError, r"batch\[1\] must have shape \[2\], the system of each query", {"batch": (SYSTEMS, SYSTEMS), **PAIR}),
        (ValueError, "backend='hashgrid' knows one system at a time: pass", {"batch": SYSTEMS, "backend": "hashgrid"}),
    ],
)
def test_errors(error, match, options):
    for function in (jfrnn.search, jfrnn.count):
        refuses(error, match, function, X, 1.0, **options)


@pytest.mark.parametrize("wide", [np.int64, *(slow(wide) for wide in (np.uint32, np.uint64))])
def test_wide_numbers_of_systems_and_species_are_taken_inside_jit(wide):
    """As outside; a number that int32 does not hold sets the bit, and its particle has no neighbors."""
    x = np.random.default_rng(0).random((30, 3)).astype(np.float32)
    batch, table = (np.arange(30) % 3).astype(wide), np.full((3, 3), 0.4, np.float32)
    far = batch.copy()
    far[4] = 2**32 - 2

    @jax.jit
    def find(batch):
        options = {"batch": batch, "capacity": 32}
        return {
            "list": jfrnn.search(x, 0.4, **options),
            "counts": jfrnn.count(x, 0.4, batch=batch),
            "sums": jfrnn.pair_sum(lambda r, i, j: 1.0, x, 0.4, batch=batch),
            "queries": jfrnn.count(x, 0.4, queries=x[:5], batch=(batch, batch[:5])),
            "kinds": jfrnn.search(x, table, species=batch, capacity=32),
        }

    near = {(i, j) for i, j in reference.reference_pairs(x, 0.4)}

    def counts(of):
        return np.bincount([i for i, j in near if of[i] == of[j]], minlength=30)

    found = find(batch)
    for name in ("counts", "sums"):
        np.testing.assert_array_equal(found[name], counts(batch))
    np.testing.assert_array_equal(found["list"].count, counts(batch))
    np.testing.assert_array_equal(found["queries"], counts(batch)[:5] + 1)  # each of which meets the particle in its place
    np.testing.assert_array_equal(found["kinds"].count, counts(0 * batch))
    found = find(far)
    assert jfrnn.Status(int(found["list"].status)) == jfrnn.Status.SYSTEM_WITHOUT_BOX
    np.testing.assert_array_equal(found["list"].count, counts(far))
    for name in ("counts", "queries"):
        assert (np.asarray(found[name]) == np.iinfo(np.int32).min).all()
    assert np.isnan(found["sums"]).all()
    assert jfrnn.Status(int(found["kinds"].status)) == jfrnn.Status.INVALID_CUTOFF
