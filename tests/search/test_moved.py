"""Whether a list with a skin is stale: the kernel that looks on the CPU says what array programs say, whichever point it is."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import sparing

import jfrnn
from jfrnn._engine import Inputs
from jfrnn._search import kept_search

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="the kernel is one of the CPU")
CUTOFF, SKIN, LENGTH = 1.0, 0.3, 10.0
KINDS = [(2, np.float32), (3, np.float32), (2, np.float64), (3, np.float64)]
BOXES = {"open": (), "box": (True, True, True), "axis": (False, True, False)}
OTHERS, CROSSED = (KINDS[0], KINDS[3]), KINDS[1:3]  # each dimension and width, together; programs of each compile


def a_list(x, periodic, **options):
    box = jfrnn.Box(np.full(x.shape[1], LENGTH, x.dtype), periodic=periodic[: x.shape[1]]) if periodic else None
    return jfrnn.search(jnp.asarray(x), CUTOFF, skin=SKIN, box=box, capacity=16, **options)


def answers(nbrs, x):
    """Return what the kernel says, and what array programs do."""
    inputs = Inputs(jnp.asarray(x), None, None, nbrs.box, nbrs.problem.listed_within(None), nbrs.batch, nbrs.exclude)
    return [bool(jax.jit(says)(nbrs, inputs)) for says in (kept_search._kernel_says_so, kept_search._has_moved_too_far)]


def points(n, dim, dtype, seed=0):
    return np.random.default_rng(seed).uniform(0, LENGTH, (n, dim)).astype(dtype)


@pytest.mark.parametrize(
    ("dim", "dtype", "box"),
    sparing(
        [(*kind, box) for box, kind in product(BOXES, KINDS)],
        [(*kind, box) for box in BOXES for kind in (OTHERS if box == "box" else CROSSED)],
    ),
)
def test_one_point_that_moves_decides(dim, dtype, box):
    """Among so many points that they fill lanes and chunks of threads, and leave some over."""
    n, half = 1025, np.float64(dtype(SKIN)) / 2
    x = points(n, dim, dtype)
    x[:: n // 4] = 4.0  # there, what is added is exact
    nbrs = a_list(x, BOXES[box])
    assert answers(nbrs, x) == [False, False]
    along_all = half / np.sqrt(dim)
    motions = [([half * 0.999], False), ([half * 1.001], True), ([0, -half * 0.999], False), ([0, -half * 1.001], True)]
    motions += [([along_all * 0.999] * dim, False), ([along_all * 1.001] * dim, True), ([np.nan], True), ([np.inf], True)]
    for place in range(0, n, n // 4):
        for motion, stale in motions:
            moved = x.copy()
            moved[place, : len(motion)] += np.asarray(motion, dtype)
            assert answers(nbrs, moved) == [stale, stale], (place, motion)


@pytest.mark.parametrize("times", [1, -3, 300, 5000])
@pytest.mark.parametrize(("dim", "dtype"), sparing(KINDS, CROSSED))
def test_lattice_vectors_are_no_motion(dim, dtype, times):
    x = np.round(points(400, dim, dtype, seed=1) * 64) / 64  # so that whole vectors are added without rounding
    nbrs = a_list(x, BOXES["box"])
    turned = x + (np.arange(len(x)) % 3 == 0)[:, None] * np.asarray(times * LENGTH, dtype)
    assert answers(nbrs, turned) == [False, False]
    turned[7, 0] += dtype(SKIN)
    assert answers(nbrs, turned) == [True, True]
    assert answers(a_list(x, BOXES["axis"]), turned) == [True, True]


@pytest.mark.parametrize(("dim", "dtype"), KINDS)
def test_points_that_are_not_finite_move_when_they_become_finite(dim, dtype):
    x = points(300, dim, dtype, seed=2)
    x[299] = np.nan
    nbrs = a_list(x, ())
    assert answers(nbrs, x) == [False, False]
    x[299] = 0
    assert answers(nbrs, x) == [True, True]


@pytest.mark.parametrize("skin", [1e-9, 1e-20, 2.0**32])
@pytest.mark.parametrize("box", ["open", "box"])
def test_skins_whose_squares_are_no_floats_that_kernels_compare(skin, box):
    """Array programs compare them in another unit, and are asked."""
    x = np.asarray([[0, 0, 0], [1.25, 0, 0]], np.float32)
    box = jfrnn.Box(np.full(3, LENGTH * max(1, skin), np.float32)) if box == "box" else None
    nbrs = jfrnn.search(jnp.asarray(x), CUTOFF, skin=skin, box=box, capacity=2)
    x[1, 0] = 0.5
    after = nbrs.update(jnp.asarray(x))
    assert int(after.rebuild_count) == (skin < 1)
    assert int(after.distances(jnp.asarray(x))[1].sum()) == 2


def test_a_box_that_has_changed_since_makes_a_list_stale():
    """The box of a list may be another one than that in which it was made; by the kernel, any other makes it stale."""
    x = points(200, 3, np.float32, seed=3)
    nbrs = a_list(x, BOXES["box"])
    wider = nbrs.update(jnp.asarray(x), box=jfrnn.Box(np.full(3, LENGTH + 2**-10, np.float32)))
    assert int(wider.rebuild_count) == 0
    assert answers(wider, x) == [True, False]
    moved = jnp.asarray(x + np.float32(0.01))
    again = wider.update(moved)
    np.testing.assert_array_equal(again.idx, a_list(x + np.float32(0.01), BOXES["box"]).update(moved, box=wider.box).idx)


@pytest.mark.parametrize(
    "options", [{"half": True}, {"reverse": True}, {"batch": jnp.arange(200) % 3}], ids=lambda each: next(iter(each))
)
def test_lists_of_other_kinds_are_asked_about_in_the_same_way(options):
    x = points(200, 3, np.float32, seed=4)
    nbrs = a_list(x, BOXES["box"], **options)
    text = jax.jit(jfrnn.NeighborList.update).lower(nbrs, jnp.asarray(x)).as_text()
    assert "jfrnn_moved_3d_f32_boxed" in text
    moved = x.copy()
    moved[13] += np.float32(SKIN)
    assert answers(nbrs, moved) == [True, True]
    assert int(nbrs.update(jnp.asarray(moved)).rebuild_count) == 1


def test_many_lists_at_once():
    """Under vmap, they are asked one by one."""
    x = np.stack([points(100, 2, np.float32, seed=k) for k in range(3)])
    found = jax.vmap(partial(jfrnn.search, cutoff=CUTOFF, skin=SKIN, capacity=16))(jnp.asarray(x))
    x[1, 5, 0] += np.float32(SKIN)
    counts = jax.vmap(lambda nbrs, x: nbrs.update(x).rebuild_count)(found, jnp.asarray(x))
    assert counts.tolist() == [0, 1, 0]
