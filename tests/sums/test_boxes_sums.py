"""Fused pair sums with a box per system, searched and over kept lists: the pairs of the oracle, and derivatives."""

import functools
from itertools import product

import jax
import numpy as np
import pytest
from checked import sparing
from marked import assert_marks, marks
from test_boxes import CAPACITY, box_of, expected_images
from test_kept_cuda import compiles, term_of

import jfrnn
from jfrnn.cases.crystals import CRYSTAL_CASES
from jfrnn.kernels import Kind, boxes, kept

SLOW = pytest.mark.slow
fused = functools.partial(jfrnn.pair_sum, backend="warp")


def assert_case(name, dtype, dim, listed):
    given = CRYSTAL_CASES[name].build(dtype, dim)
    q, systems = given.queries, given.batch if given.queries is None else given.query_batch
    queries = {} if q is None else {"queries": q}
    images = box_of(given).images_for(given.cutoff)
    box = jfrnn.Box(given.boxes, given.periodic, per_system=True, images=images)
    batch = given.batch if q is None else (given.batch, given.query_batch)
    values = {"query_values": np.arange(len(systems), dtype=dtype)} if queries else {}
    ids = np.arange(len(given.positions), dtype=dtype)

    @jax.jit
    def sums(x, box, queries):
        if not listed:
            return fused(marks, x, given.cutoff, ids, box=box, batch=batch, **queries, **values), None
        nbrs = jfrnn.search(x, given.cutoff, box=box, batch=batch, capacity=CAPACITY[dim], backend="warp", **queries)
        return jfrnn.pair_sum(marks, x, None, ids, neighbors=nbrs, **queries, **values), nbrs

    found, nbrs = sums(given.positions, box, queries)
    if listed:
        nbrs.check()
    cells = given.boxes if given.boxes.ndim == 3 else np.einsum("sd,dk->sdk", given.boxes, np.eye(dim))
    there = (systems >= 0) & (systems < len(cells))
    points = np.where(there[:, None], given.positions if q is None else given.queries, 0)
    pairs = expected_images(name, dtype, dim)
    keep = there & np.isfinite(points).all(axis=1)
    found = jax.tree.map(lambda s: np.where(keep.reshape(-1, *[1] * (s.ndim - 1)), s, 0), jax.tree.map(np.asarray, found))
    assert_marks(found, pairs, given.positions, points, cells[np.clip(systems, 0, len(cells) - 1)])


@pytest.mark.parametrize(("name", "listed"), sparing(product(CRYSTAL_CASES, (False, True)), [("mixed", False), ("far", True)]))
def test_case(name, listed):
    assert_case(name, np.float32, 3, listed)


@SLOW
@pytest.mark.parametrize(("dim", "double", "periodic"), [(3, False, 4), (2, True, 1)])
def test_kernels_compile_for_cuda(dim, double, periodic):
    space = Kind(dim, double, periodic=periodic, batched=2)
    for kernel in boxes.sorting_kernels(space):
        assert compiles(kernel)
    for lists, later in ((False, False), (True, False), (True, True)):
        assert compiles(boxes.rows_kernel(space._replace(lists=lists, later=later)))
    term = term_of(kept.ListKind(space, lanes=8))
    for extremes in (False, True):
        asked = term._replace(sums=term.sums[:1]) if extremes else term
        kind = space._replace(compensated=not extremes, extremes=extremes)
        assert compiles(boxes.sum_kernel(kind, asked, f"test_{extremes}"))
