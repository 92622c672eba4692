"""A box per system: every case of `jfrnn.cases.crystals` against the oracle, system by system, then what lists make of them."""

import functools
from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
import reference
from test_box import masked_images

import jfrnn
from jfrnn.cases.crystals import CRYSTAL_CASES

SLOW = pytest.mark.slow
CAPACITY = {2: 96, 3: 256}


def oracle(boxes, x, batch, cutoff, periodic=None, queries=None, query_batch=None, **options):
    """Return (i, j, S) of all pairs, system by system."""
    found = set()
    for system, box in enumerate(np.asarray(boxes, x.dtype)):
        flags = np.ones(x.shape[1], bool) if periodic is None else np.broadcast_to(np.asarray(periodic), boxes.shape[:2])[system]
        matrix, ends = np.diag(box) if box.ndim == 1 else box, np.flatnonzero(batch == system)
        starts = ends if queries is None else np.flatnonzero(query_batch == system)
        asking = {} if queries is None else {"queries": queries[starts]}
        if len(ends) and len(starts):
            pairs = reference.reference_images(x[ends], cutoff, matrix=matrix, periodic=flags.tolist(), **asking, **options)
            found |= {(int(starts[i]), int(ends[j]), shift) for i, j, shift in pairs}
    return found


@functools.lru_cache(maxsize=32)
def expected_images(name, dtype, dim, closed=False, half=False):
    given = CRYSTAL_CASES[name].build(dtype, dim)
    of_queries = {"queries": given.queries, "query_batch": given.query_batch}
    options = {"closed": closed, **({"half": True} if half else {})}
    return oracle(given.boxes, given.positions, given.batch, given.cutoff, given.periodic, **of_queries, **options)


def listed_images(nbrs, x, **queries):
    """Return (i, j, S) of all slots of a list without a skin."""
    shifts, (i, j) = np.asarray(nbrs.shifts(x, **queries)), nbrs.pairs()
    shifts = shifts[np.asarray(nbrs.idx) < nbrs.source_count]
    pairs = set(zip(i.tolist(), j.tolist(), map(tuple, shifts.tolist()), strict=True))
    assert len(pairs) == len(i)
    return pairs


def box_of(given):
    return jfrnn.Box(given.boxes, given.periodic, per_system=True)


def assert_case(name, dtype, dim, backend, closed=False, half=False, geometry=False):
    given = CRYSTAL_CASES[name].build(dtype, dim)
    x, expected = jnp.asarray(given.positions), expected_images(name, dtype, dim, closed, half)
    queries = {} if given.queries is None else {"queries": jnp.asarray(given.queries)}
    batch = given.batch if given.queries is None else (given.batch, given.query_batch)
    options = {"box": box_of(given), "batch": batch, "backend": backend, "closed": closed, "half": half}
    nbrs = jfrnn.search(x, given.cutoff, capacity=CAPACITY[dim], **queries, **options)
    nbrs.check()
    found = masked_images(nbrs, x, **queries) if geometry else listed_images(nbrs, x, **queries)
    missing, extra = expected - found, found - expected
    assert (len(missing), len(extra)) == (0, 0), f"missing {sorted(missing)[:5]}, extra {sorted(extra)[:5]} of {len(expected)}"
    assert int(nbrs.count.sum()) == len(expected) > 0
    assert nbrs.backend == backend
    assert (nbrs.images is None) == (name == "nearest")


def each_case():
    """Yield every case, kind and engine; by default two kinds on Warp, and a few cases on the engines that compile slowly."""
    often = {("mixed", np.float32, 3, "jax"), ("slabs", np.float64, 2, "jax"), ("absent", np.float32, 2, "brute")}
    for name, dtype, dim, backend in product(CRYSTAL_CASES, (np.float32, np.float64), (2, 3), ("jax", "warp", "brute")):
        by_default = (name, dtype, dim, backend) in often or (backend == "warp" and (dtype, dim) == (np.float32, 3))
        kind = f"{name}-f{8 * dtype().itemsize}-{dim}d-{backend}"
        yield pytest.param(name, dtype, dim, backend, id=kind, marks=[SLOW] * (not by_default))


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), list(each_case()))
def test_case(name, dtype, dim, backend):
    assert_case(name, dtype, dim, backend, geometry=name in ("mixed", "nearest", "queries"))


@pytest.mark.parametrize("backend", ["warp", pytest.param("jax", marks=SLOW), pytest.param("brute", marks=SLOW)])
def test_closed_and_half(backend):
    assert_case("ties", np.float64, 2, backend, closed=True)
    assert_case("ties", np.float64, 2, backend, half=True)
    assert_case("mixed", np.float64, 2, backend, half=True)
