"""Near ties everywhere: each cutoff is the rounded distance to a neighbor, or one float above or below, in all that finds pairs.

Of such a pair working precision may know nothing: what it is sure of, too early by a rounding, is wrong here at once.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from test_box import image_pairs, masked_images
from test_search_edges import edges_as_set

import jfrnn

SLOW = pytest.mark.slow
N, CAPACITY, TOTAL, SKIN, DRAWS = 200, 208, 8192, 0.03, 3  # more than are all tested without cells
RULES = ("gather", "scatter", "either", "both", "mean", "sum")
SPACES = {
    "open": None,
    "lengths": np.diag([1.1, 1.0, 1.3]),
    "skewed": np.array([[1.0, 0.0, 0.0], [0.3, 1.1, 0.0], [0.2, -0.4, 1.2]]),
    "images": np.diag([0.37, 1.0, 1.1]),
}
IMAGES = {"lengths": 0, "skewed": 0, "images": 2}


def neighbors_of(x, matrix):
    """Return of each point the 12 nearest images of others, [n, 12], and their shifts [n, 12, 3]."""
    shifts = np.zeros((1, 3), int) if matrix is None else np.stack(np.meshgrid(*3 * [np.arange(-1, 2)]), -1).reshape(-1, 3)
    moved = 0 if matrix is None else (shifts @ matrix)[:, None, None]
    squares = ((x[None, None] + moved - x[None, :, None]) ** 2).sum(-1)  # [shifts, i, j]
    squares[:, np.arange(len(x)), np.arange(len(x))] = np.inf
    nearest = np.argsort(squares.transpose(1, 0, 2).reshape(len(x), -1), axis=1)[:, :12]
    return nearest % len(x), shifts[nearest // len(x)]


@functools.lru_cache(maxsize=4)
def near_ties(space, rule, dtype, seed):
    """Return positions, some of them a few cells away, cutoffs, and one near tie (i, j, S) of every particle that has any.

    Of odd draws half of the points make up a clump, so that cutoffs are as various as the distances.
    """
    random, matrix = np.random.default_rng(seed), SPACES[space]
    fractions = random.random((N, 3))
    fractions[: N * (seed % 2) : 2] = 0.4 + 0.01 * fractions[: N * (seed % 2) : 2]
    x = (fractions if matrix is None else fractions @ matrix).astype(dtype)
    at, shifts = neighbors_of(x.astype(np.float64), matrix)
    chosen = random.integers(12, size=N)
    j, shift = at[np.arange(N), chosen], shifts[np.arange(N), chosen]
    turns = np.zeros((N, 3), int)
    if matrix is not None:
        matrix = matrix.astype(dtype)
        turns[::5] = random.integers(-2, 3, (len(turns[::5]), 3))
        x = (x + turns @ matrix.astype(np.float64)).astype(dtype)
    shift = shift + turns - turns[j]
    apart = x[j].astype(np.longdouble) - x
    apart += 0 if matrix is None else sum(shift[:, k, None] * matrix[k].astype(np.longdouble) for k in range(3))
    distance = np.sqrt((apart**2).sum(-1))
    step = random.integers(-1, 2, N)

    def nudged(h, step):
        return np.nextafter(h, dtype(np.inf) * np.sign(step)) if step else h

    h, tied = distance.astype(dtype), np.ones(N, bool)
    if rule in ("mean", "sum"):  # both cutoffs of a pair make up its distance, which they share unequally
        free, whole, tied = np.ones(N, bool), distance * (2 if rule == "mean" else 1), ~tied
        for i in range(N):
            if not (free[i] and free[j[i]]):
                continue
            free[i] = free[j[i]] = False
            h[i] = random.uniform(0.4, 0.6) * whole[i]
            h[j[i]], tied[i] = nudged(dtype(whole[i] - h[i]), step[i]), True
        h[free] *= dtype(whole[0] / distance[0] / 2)
    else:
        h = np.array([nudged(*each) for each in zip(h, step, strict=True)])
    ties = {(i, int(j[i]), tuple(shift[i].tolist())) for i in np.flatnonzero(tied).tolist()}
    if rule == "scatter":
        ties = {(j, i, tuple(-s for s in shift)) for i, j, shift in ties}
    return x, h, ties


@functools.lru_cache(maxsize=8)
def expected_pairs(space, rule, dtype, seed):
    x, h, _ = near_ties(space, rule, dtype, seed)
    matrix = SPACES[space]
    box = {} if matrix is None else {"matrix": matrix.astype(dtype), "periodic": (True,) * 3}
    return reference.reference_radii(x, 2 * h if rule == "sum" else h, "mean" if rule == "sum" else rule, **box)


@functools.lru_cache(maxsize=2)
def program_of(space, rule, backend, dtype, parts):
    """Return all that finds pairs, of positions before and after a motion, and cutoffs, as one program."""
    matrix = SPACES[space]
    given = {"radius_rule": rule, "backend": backend}
    if matrix is not None:
        matrix = matrix if space == "skewed" else np.diag(matrix)
        given["box"] = jfrnn.Box(matrix.astype(dtype), images=IMAGES[space] or None)
    names = jnp.arange(1, N + 1, dtype=dtype)
    found = {
        "search": lambda before, x, h: jfrnn.search(x, h, capacity=CAPACITY, **given),
        "count": lambda before, x, h: jfrnn.count(x, h, **given),
        "pair_sum": lambda before, x, h: jfrnn.pair_sum(lambda r, i, j: jnp.stack([jnp.ones_like(j), j]), x, h, names, **given),
        "kept": lambda before, x, h: jfrnn.search(before, h, capacity=CAPACITY, skin=SKIN, **given).update(x, cutoff=h),
        "search_edges": lambda before, x, h: jfrnn.search_edges(x, h, total=TOTAL, **given),
    }
    return jax.jit(lambda *args: {part: found[part](*args) for part in parts})


edges_of = jax.jit(lambda found, x: found.edges(x))
ALL = ("search", "count", "pair_sum", "kept", "search_edges")


def assert_right(space, rule, backend, dtype, parts=ALL):
    within = []
    for seed in range(DRAWS):
        x, h, ties = near_ties(space, rule, dtype, seed)
        expected = expected_pairs(space, rule, dtype, seed)
        within += [tie in expected for tie in ties]
        before = (x + np.random.default_rng(seed).uniform(-0.2, 0.2, x.shape) * SKIN).astype(dtype)
        found = program_of(space, rule, backend, dtype, parts)(before, x, h)
        i, j = np.array([pair[:2] for pair in expected]).T
        sums = np.stack([np.bincount(i, minlength=N), np.bincount(i, j + 1, minlength=N)], axis=1)
        if "search" in found:
            nbrs = found["search"]
            nbrs.check()
            assert image_pairs(nbrs, x) == expected
        if "count" in found:
            np.testing.assert_array_equal(found["count"], sums[:, 0])
        if "pair_sum" in found:
            np.testing.assert_array_equal(found["pair_sum"], sums)
        if "kept" in found:
            found["kept"].check()
            assert int(found["kept"].rebuild_count) == 0
            assert masked_images(found["kept"], x) == expected
        if "search_edges" in found:
            found["search_edges"].check()
            assert edges_as_set(edges_of(found["search_edges"], x)) == expected
    assert len(within) > N and 0.1 < np.mean(within) < 0.9  # some of the near ties are pairs, and some are not


F32, F64 = np.float32, np.float64
OFTEN = [  # each rule, part, space, engine and width; what takes long to compile is rare
    ("gather", "open", "warp", F32, ("kept",)),
    ("scatter", "skewed", "warp", F32, ("count",)),
    ("either", "lengths", "warp", F64, ("count",)),
    ("both", "open", "warp", F64, ("count", "pair_sum")),
    ("mean", "open", "warp", F32, ("search_edges",)),
    ("sum", "images", "warp", F64, ("search",)),
    ("gather", "open", "jax", F32, ("count",)),
    ("scatter", "open", "jax", F32, ("search",)),
    ("either", "open", "jax", F64, ("pair_sum",)),
]
ALIKE = OFTEN[-2:-1]  # of arrays, a count and a sum ask the same


@pytest.mark.parametrize(
    ("rule", "space", "backend", "dtype", "parts"),
    [pytest.param(*x, id="-".join([*x[:3], x[3].__name__, *x[4]]), marks=[pytest.mark.slow] * (x in ALIKE)) for x in OFTEN],
)
def test_some_of_it(rule, space, backend, dtype, parts):
    assert_right(space, rule, backend, dtype, parts)


@SLOW
@pytest.mark.parametrize("backend", ["warp", "jax"])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("rule", RULES)
def test_everything(rule, space, backend, dtype):
    assert_right(space, rule, backend, dtype)
