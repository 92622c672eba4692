"""Periodic boxes: every case of `jfrnn.cases.periodic` against the oracle, then what boxes add to lists."""

import functools

import checked
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jfrnn.cases.periodic import PERIODIC_CASES

import jfrnn
from jfrnn._box import unpacked_turns

CAPACITY = 400
LENGTH = 304


def image_pairs(nbrs, positions, queries=None):
    """Return (i, j, S) of every used slot, after checking padding and counts; S is found without the library's vectors."""
    assert not nbrs.overflow
    idx, count = np.asarray(nbrs.idx), np.asarray(nbrs.count)
    used = np.arange(nbrs.capacity) < count[:, None]
    assert (idx[~used] == nbrs.source_count).all()
    i, k = np.nonzero(used)
    j, kind = idx[i, k], nbrs.box_kind
    if nbrs.images is None:
        x = np.asarray(positions, np.float64)
        q, periodic = x if queries is None else np.asarray(queries, np.float64), list(kind.periodic)
        vectors = np.asarray(nbrs.box.vectors, np.float64)
        vectors = (np.diag(vectors) if vectors.ndim == 1 else vectors)[periodic]
        shifts = np.zeros((len(i), x.shape[1]), int)
        shifts[:, periodic] = -np.rint((x[j] - q[i]) @ np.linalg.pinv(vectors))
    else:
        turns, query_turns = (None if t is None else np.asarray(unpacked_turns(t, nbrs.box.dim)) for t in nbrs.images[1:])
        shifts = kind.shifts[np.asarray(nbrs.images.codes)[i, k]] + (turns if query_turns is None else query_turns)[i] - turns[j]
    pairs = list(zip(i.tolist(), j.tolist(), map(tuple, shifts.tolist()), strict=True))
    assert len(set(pairs)) == len(pairs)
    return set(pairs)


def masked_images(nbrs, positions, **options):
    """Return (i, j, S) of every pair within the true cutoff, as the list's own geometry has them."""
    assert not nbrs.overflow
    shifts, (_, mask) = np.asarray(nbrs.shifts(positions, **options)), nbrs.vectors(positions, **options)
    i, k = np.nonzero(mask)
    pairs = list(zip(i.tolist(), np.asarray(nbrs.idx)[i, k].tolist(), map(tuple, shifts[i, k].tolist()), strict=True))
    assert len(set(pairs)) == len(pairs)
    return set(pairs)


@functools.lru_cache(maxsize=4)
def expected_images(name, dtype, dim, closed):
    given = PERIODIC_CASES[name].build(dtype, dim)
    options = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries, "closed": closed}
    return reference.reference_images(given.positions, given.cutoff, **options)


def assert_case(name, dtype, dim, backend, *, closed=False, geometry=False):
    given = PERIODIC_CASES[name].build(dtype, dim)
    box = jfrnn.Box(given.matrix, given.periodic) if any(given.periodic) else None
    queries = {} if given.queries is None else {"queries": jnp.asarray(checked.padded(given.queries, LENGTH))}
    x, expected = jnp.asarray(checked.padded(given.positions, LENGTH)), expected_images(name, dtype, dim, closed)
    nbrs = jfrnn.search(x, given.cutoff, box=box, backend=backend, capacity=CAPACITY, closed=closed, **queries)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE  # the padding
    if box is None:
        found = reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), nbrs.source_count)
        assert {(i, j, (0,) * dim) for i, j in found} == expected
        return
    for found in [image_pairs(nbrs, x, **queries), *([masked_images(nbrs, x, **queries)] if geometry else [])]:
        missing, extra = expected - found, found - expected
        assert (len(missing), len(extra)) == (0, 0), f"missing {sorted(missing)[:5]}, extra {sorted(extra)[:5]} of {len(expected)}"


TIED = [name for name in PERIODIC_CASES if any(word in name for word in ("ties", "crystal", "cutoffs", "residues", "_supercell"))]
BOTH = [pytest.param(np.float32, 3, id="f32-3d"), pytest.param(np.float64, 2, id="f64-2d")]
OTHERS = [pytest.param(np.float32, 2, id="f32-2d"), pytest.param(np.float64, 3, id="f64-3d")]
# one case for each way in which a program differs: axes, skew, images, queries
DIFFERENT = [
    ("crystal_0.1_outside", np.float32, 3),
    ("ties_across_skewed_far", np.float32, 3),
    ("skewed_slab", np.float32, 3),
    ("cutoff_1.5_boxes", np.float32, 3),
    ("unequal_1e6", np.float32, 3),
    ("queries_many_images", np.float32, 2),
    ("coincident", np.float64, 2),
    ("residues_across_100", np.float64, 2),
    ("alone_skewed", np.float64, 2),
    ("nonfinite_slab", np.float64, 3),
]


@pytest.mark.parametrize("name", PERIODIC_CASES)
@pytest.mark.parametrize(("dtype", "dim"), BOTH)
def test_case(name, dtype, dim):
    assert_case(name, dtype, dim, "warp")


@pytest.mark.parametrize("name", TIED)
@pytest.mark.parametrize(("dtype", "dim"), BOTH)
def test_case_closed(name, dtype, dim):
    assert_case(name, dtype, dim, "warp", closed=True)


@pytest.mark.parametrize(("name", "dtype", "dim"), DIFFERENT)
def test_case_of_every_kind(name, dtype, dim):
    assert_case(name, dtype, dim, "jax", geometry=True)


@pytest.mark.parametrize("name", ["ties_across", "cutoff_1_boxes"])
def test_brute_force(name):
    assert_case(name, np.float32, 2, "brute")


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize("name", PERIODIC_CASES)
@pytest.mark.parametrize("backend", ["jax", "warp", "brute"])
@pytest.mark.parametrize(("dtype", "dim"), [*BOTH, *OTHERS])
def test_every_case(name, dtype, dim, closed, backend):
    assert_case(name, dtype, dim, backend, closed=closed, geometry=True)
