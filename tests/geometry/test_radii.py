"""Cutoffs that differ from particle to particle: every rule against the oracle, then what lists make of them."""

import dataclasses
import functools
from fractions import Fraction
from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow, sparing
from scipy.spatial import cKDTree
from test_box import image_pairs, masked_images

import jfrnn
from jfrnn._engine import warp
from jfrnn._geometry.cutoffs import RANGE_OF, RULES, Radii, is_radius, make_cutoffs
from jfrnn.cases.radii import RADII_CASES

SLOW = pytest.mark.slow
LENGTH, CAPACITY = 160, 256  # more pairs than are all tested by "jax"
# How a case is lengthened: a few are all tested, more are sorted into cells or a tree; beside a crowd it is a tree, on a CPU.
CROWD, LENGTHS = 400, {"few": LENGTH, "more": 192, "crowd": 640}
KINDS = {"gather": (np.float64, 2), "scatter": (np.float32, 2), "either": (np.float32, 3), "both": (np.float32, 3)}
KINDS["mean"] = (np.float64, 3)
ALONE = ("periodic", "periodic_ties", "periodic_images", "queries")  # nothing lies beside a box; a crowd has no queries


def built(name, dtype, dim, way):
    """Build a case; "crowd" puts particles of tiny cutoffs into a small ball beside it, beyond the reach of all others."""
    given = RADII_CASES[name].build(dtype, dim)
    if way != "crowd":
        return given
    random, reach = np.random.default_rng(0), 4 * float(given.cutoffs.max())
    x = random.uniform(-0.02, 0.02, (CROWD, dim)) * reach + (given.positions.max(axis=0) + reach).astype(float)
    h = np.full(CROWD, 1e-3 * reach)
    more = {"positions": np.r_[given.positions, x.astype(dtype)], "cutoffs": np.r_[given.cutoffs, h.astype(dtype)]}
    return dataclasses.replace(given, **more)


def radii_of(given, rule, length=None):
    """Return cutoffs as a search takes them, padded with 1, as the NaN rows of positions are."""

    def padded(x):
        return x if x is None or length is None else np.concatenate([x, np.ones(length - len(x), x.dtype)])

    own, others = padded(given.query_cutoffs), padded(given.cutoffs)
    if own is None:
        return others
    return {"gather": own, "scatter": others}.get(rule, (others, own))


@functools.lru_cache(maxsize=64)
def expected_pairs(name, dtype, dim, rule, closed=False, way="few"):
    given = built(name, dtype, dim, way)
    options = {"queries": given.queries, "query_radii": given.query_cutoffs, "lengths": given.lengths}
    if way != "crowd":
        return reference.reference_radii(given.positions, given.cutoffs, rule, closed=closed, **options)
    n = len(given.positions) - CROWD
    beside = reference.reference_radii(given.positions[n:], given.cutoffs[n:], rule, closed=closed)
    return expected_pairs(name, dtype, dim, rule, closed) | {(n + i, n + j, shift) for i, j, shift in beside}


def search_case(name, dtype, dim, rule, backend, way="few", **options):
    """Search a case padded to one length, so that cases share compiled programs; return the list, positions and queries."""
    given, length = built(name, dtype, dim, way), LENGTHS[way]
    x = jnp.asarray(checked.padded(given.positions, length))
    queries = {} if given.queries is None else {"queries": jnp.asarray(checked.padded(given.queries, length))}
    box = {} if given.lengths is None else {"box": jfrnn.Box(given.lengths)}
    radii = radii_of(given, rule, length)
    return jfrnn.search(x, radii, radius_rule=rule, backend=backend, **queries, **box, **options), x, queries


def assert_case(name, dtype, dim, rule, backend, closed=False, masked=True, way="few"):
    capacity = CAPACITY if way != "crowd" else 512
    nbrs, x, queries = search_case(name, dtype, dim, rule, backend, way, closed=closed, capacity=capacity)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE  # the padding
    expected = expected_pairs(name, dtype, dim, rule, closed, way)
    checked.assert_same(image_pairs(nbrs, x, **queries), expected)
    if (nbrs.box is not None or not closed) and masked:
        assert masked_images(nbrs, x, **queries) == expected


def each_case():
    """Yield every case, rule, kind and engine; by default, of the array engines, which compile slowly, one kind of one rule.

    Each kind of input is a program for each rule: in boxes and with queries not all rules are tried by default.
    """
    compiled = dict.fromkeys(("queries", "periodic", "periodic_ties", "periodic_images"), ())
    walked = {"periodic": (), "periodic_images": ("gather",), "periodic_ties": (), "queries": ("mean",)}
    for name, rule, dtype, dim, backend in product(RADII_CASES, RULES, (np.float32, np.float64), (2, 3), ("jax", "warp", "brute")):
        common = walked.get(name, RULES)
        often = (dtype, dim) == KINDS[rule] and rule in (common if backend == "warp" else compiled.get(name, ("mean",)))
        in_turn = (list(RADII_CASES).index(name) + RULES.index(rule)) % 3  # by default, each case in each way by some rule
        for k, way in enumerate(LENGTHS):
            rarely = backend == "brute" or not often or (k != in_turn if backend == "warp" else k > 0)
            kind = f"{name}-{rule}-f{8 * dtype().itemsize}-{dim}d-{backend}-{way}"
            if way != "crowd" or name not in ALONE:
                yield pytest.param(name, rule, dtype, dim, backend, way, id=kind, marks=[SLOW] * rarely)


def with_few_longer(dtype, dim, factor, longer):
    """Return points with cutoffs within a factor of 1.5, but for some that are longer by about a factor, some of them far away."""
    random = np.random.default_rng(1)
    x, cutoffs = random.random((200, dim)), 0.1 * random.uniform(1, 1.5, 200)
    some = random.permutation(200)[:longer]
    cutoffs[some] *= factor
    away = some[::2]
    x[away] = cutoffs[away, None] * random.uniform(-0.6, 0.6, (len(away), dim))
    return x.astype(dtype), cutoffs.astype(dtype)


@pytest.mark.parametrize("apart", [False, True], ids=["own", "queries"])
@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 3), pytest.param(np.float64, 2, marks=SLOW)])
def test_few_cutoffs_much_longer_than_the_rest(dtype, dim, apart):
    """Cells are made for the others, and the few are served apart: as many as there may be, and one more, which a tree serves."""
    capacity = 256

    @jax.jit
    def found(x, cutoffs, weights):
        given = (x, cutoffs) if not apart else (x[50:], cutoffs[:150])
        queries = {"queries": x[:150]} if apart else {}
        nbrs = jfrnn.search(*given, capacity=capacity, backend="warp", **queries)
        values = {"values": weights[50:], "query_values": weights[:150]} if apart else {"values": weights}
        total = jfrnn.pair_sum(lambda r, i, j: j, *given, backend="warp", **queries, **values)
        return nbrs.idx, nbrs.count, nbrs.status, jfrnn.count(*given, backend="warp", **queries), total

    weights = np.arange(1, 201).astype(dtype)
    for factor, longer in ((8, 16), (1e6, 10), (1e15, 3), (8, 17), (30, 1), (1, 1)):
        x, cutoffs = with_few_longer(dtype, dim, factor, longer)
        idx, count, status, counts, total = (np.asarray(each) for each in found(x, cutoffs, weights))
        if apart:
            expected = reference.reference_radii(x[50:], cutoffs[50:], "gather", queries=x[:150], query_radii=cutoffs[:150])
        else:
            expected = reference.reference_radii(x, cutoffs, "gather")
        pairs = {pair[:2] for pair in expected}
        assert int(status) == 0
        assert sorted(reference.pairs_of(idx, count, len(x) - 50 * apart)) == sorted(pairs), (factor, longer)
        assert counts.tolist() == np.bincount([i for i, _ in pairs], minlength=len(counts)).tolist()
        weight, rows = weights[50:] if apart else weights, np.zeros(len(counts))
        np.add.at(rows, [i for i, _ in pairs], [weight[j] for _, j in pairs])
        assert total.tolist() == rows.tolist()


def test_few_cutoffs_much_longer_than_those_of_many():
    """Among so many particles, CUDA serves blocks of queries in parts: the few still find what is marked for them."""
    random = np.random.default_rng(2)
    x, cutoffs = random.random((20_000, 3)).astype(np.float32), np.full(20_000, 0.03, np.float32)
    cutoffs[random.permutation(20_000)[:12]] = 0.25
    nbrs = jfrnn.search(x, cutoffs, capacity=1792, backend="warp")
    nbrs.check()
    near = cKDTree(x.astype(float)).query_ball_point(x.astype(float), cutoffs.astype(float), return_sorted=True)
    found = zip(np.asarray(nbrs.idx), np.asarray(nbrs.count), strict=True)
    assert [sorted([i, *row[:count].tolist()]) for i, (row, count) in enumerate(found)] == list(near)
    np.testing.assert_array_equal(jfrnn.pair_sum(lambda r, i, j: 1.0, x, cutoffs, backend="warp"), nbrs.count)


@pytest.mark.parametrize(("name", "rule", "dtype", "dim", "backend", "way"), list(each_case()))
def test_case(name, rule, dtype, dim, backend, way):
    often = way == "few" and rule in ("gather", "either", "mean") and name != "queries"  # the mask is a program of its own
    assert_case(name, dtype, dim, rule, backend, masked=often, way=way)


@pytest.mark.skipif(jax.default_backend() != "gpu", reason="only on CUDA there is a choice between cells and a tree")
@pytest.mark.parametrize("rule", RULES)
def test_a_tree_wherever_cutoffs_differ(rule, monkeypatch):
    jax.clear_caches()  # programs hold the choice
    monkeypatch.setattr(warp, "MOST_MET", -np.inf)
    for name in ("graded", "spread_100", "ties", "periodic"):
        assert_case(name, *KINDS[rule], rule, "warp", masked=False)
    jax.clear_caches()


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
@pytest.mark.parametrize("rule", ["mean", *(slow(rule) for rule in RULES if rule != "mean")])
def test_ties_when_closed(rule, backend):
    for name in ("ties", "ties_far", "coincident", "mean_residues"):
        assert_case(name, *KINDS[rule], rule, backend, closed=True)


def test_each_rule_differs_and_equal_radii_agree_with_one_cutoff():
    found = [expected_pairs("spread_100", np.float32, 3, rule) for rule in RULES]
    assert len(set(map(frozenset, found))) == len(RULES)
    assert found[3] < found[0] < found[2]  # both, gather, either
    x, options = RADII_CASES["spread_100"].build(np.float64, 3).positions, {"radius_rule": "mean", "backend": "warp"}
    nbrs = jfrnn.search(checked.padded(x, LENGTH), np.full(LENGTH, 0.2), capacity=CAPACITY, closed=False, **options)
    assert set(reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), LENGTH)) == reference.reference_pairs(x, 0.2)


def test_half_lists_take_symmetric_rules_alone():
    given = RADII_CASES["spread_100"].build(np.float32, 3)
    nbrs = jfrnn.search(given.positions, given.cutoffs, radius_rule="either", half=True, capacity=CAPACITY)
    expected = {(i, j) for i, j, _ in expected_pairs("spread_100", np.float32, 3, "either") if i < j}
    assert set(zip(*(part.tolist() for part in nbrs.pairs()), strict=True)) == expected
    with pytest.raises(ValueError, match=r"half=True keeps pairs without direction.*'gather'"):
        jfrnn.search(given.positions, given.cutoffs, half=True)


def test_traced_radii_share_one_program_and_bad_ones_set_a_bit():
    x = RADII_CASES["spread_100"].build(np.float32, 2).positions
    traces = []

    @jax.jit
    def search(x, h):
        traces.append(None)
        return jfrnn.search(x, h, capacity=CAPACITY)

    for scale in (0.05, 0.2):
        h = (scale * (1 + np.arange(len(x)) / len(x))).astype(np.float32)
        nbrs = search(x, h)
        nbrs.check()
        expected = {(i, j) for i, j, _ in reference.reference_radii(x, h, "gather")}
        assert set(zip(*(part.tolist() for part in nbrs.pairs()), strict=True)) == expected
    assert len(traces) == 1
    for bad in (np.nan, np.inf, -1.0, 1e-38):
        h[7] = bad
        nbrs = search(x, h)
        assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.INVALID_CUTOFF
        assert nbrs.count[7] == 0
        assert {(i, j) for i, j in reference.pairs_of(nbrs.idx, nbrs.count, len(x))} == {pair for pair in expected if 7 not in pair}
        refuses(ValueError, "`cutoff` holds values that are negative or not finite", nbrs.check)
    assert len(traces) == 1


RADII_OF_0 = {
    "most": lambda h: np.where(np.arange(len(h)) % 4 > 0, 0, h),
    "nearly all": lambda h: np.where(np.arange(len(h)) == 1, 1e-6, 0),
    "negative zero": lambda h: np.where(np.arange(len(h)) % 2 > 0, -0.0, h),
}


OF_0 = product(("warp", "jax", "brute"), RULES, (False, True), (False, True), (np.float32, np.float64), (2, 3))
OF_0_OFTEN = [("warp", rule, False, False, *KINDS[rule]) for rule in RULES]  # other tests have compiled the kernels


@pytest.mark.parametrize(("backend", "rule", "box", "closed", "dtype", "dim"), sparing(OF_0, OF_0_OFTEN))
def test_a_radius_of_0_is_a_radius(backend, rule, box, closed, dtype, dim):
    """A third of the points lie on top of each other; lists, then, by hand, sums."""
    random = np.random.default_rng(1)
    x = random.random((LENGTH, dim)).astype(dtype)
    x[::3] = x[0]
    given = {"radius_rule": rule, "backend": backend, "closed": closed} | ({"box": jfrnn.Box(np.ones(dim))} if box else {})
    counted = jax.jit(lambda x, h: jfrnn.pair_sum(lambda r, i, j: jnp.ones((), dtype), x, h, **given))
    for zeros in RADII_OF_0.values():
        h = zeros(np.exp(random.uniform(np.log(0.02), np.log(0.4), LENGTH))).astype(dtype)
        nbrs = jfrnn.search(x, h, capacity=CAPACITY, **given)
        nbrs.check()
        expected = reference.reference_radii(x, h, rule, closed=closed, lengths=np.ones(dim) if box else None)
        assert image_pairs(nbrs, x) == expected
        if (backend, rule, box, closed, dtype, dim) not in OF_0_OFTEN:
            np.testing.assert_array_equal(counted(x, h), np.bincount([i for i, *_ in expected], minlength=LENGTH))


@pytest.mark.parametrize("backend", ["warp", "jax", slow("brute")])
def test_a_mean_with_0_reaches_half_as_far(backend):
    """As many points as in other tests, so that they share programs: most of them are nowhere."""
    x, radii = np.zeros((2, 3)), np.array([0.0, 3.0])
    x[1, 0] = 1.0

    def neighbors(x, radii, closed=False):
        given = np.concatenate([radii, np.ones(LENGTH - len(radii))])
        options = {"radius_rule": "mean", "capacity": CAPACITY, "backend": backend, "closed": closed}
        nbrs = jfrnn.search(checked.padded(x, LENGTH), given, **options)
        return np.asarray(nbrs.count)[: len(x)].tolist()

    assert neighbors(x, radii) == [1, 1]
    twice, none = np.repeat(x, 2, axis=0), np.zeros(4)
    assert neighbors(twice, none) == [0] * 4
    if backend == "warp":
        assert neighbors(twice, none, closed=True) == [1] * 4


def touching(x, h, q=None, g=None, *, closed=False):
    """Return the pairs of spheres closer than the sum of their radii, by fractions."""
    q, g = (x, h) if q is None else (q, g)
    found = set()
    for i, j in product(range(len(q)), range(len(x))):
        square = sum((Fraction(float(a)) - Fraction(float(b))) ** 2 for a, b in zip(q[i], x[j]))
        reach = (Fraction(float(g[i])) + Fraction(float(h[j]))) ** 2
        if (i != j or q is not x) and (square < reach or (closed and square == reach)):
            found.add((i, j))
    return found


def spheres(dtype):
    """Return positions and radii full of ties."""
    rng = np.random.default_rng(4)
    x, h = (rng.integers(0, 8, (60, 2)) / 8).astype(dtype), (rng.integers(0, 3, 60) / 16).astype(dtype)
    h[::7] = rng.uniform(0, 0.2, len(h[::7])).astype(dtype)
    return x, h


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
@pytest.mark.parametrize("backend", ["warp", slow("brute"), slow("jax")])
def test_spheres_touch_at_the_sum_of_their_radii(backend, dtype):
    x, h = spheres(dtype)
    given = {"radius_rule": "sum", "backend": backend}

    @jax.jit
    def summed(x, h):
        return jfrnn.pair_sum(lambda r, i, j: jnp.ones((), dtype), x, h, **given)

    nbrs = jfrnn.search(x, h, capacity=60, closed=True, **given)
    assert set(zip(*(part.tolist() for part in nbrs.pairs()))) == touching(x, h, closed=True)
    expected = touching(x, h)
    np.testing.assert_array_equal(summed(x, h), np.bincount([i for i, _ in expected], minlength=60))
    assert np.sum(nbrs.count) > len(expected) > 60


@SLOW
@pytest.mark.parametrize("backend", ["warp", "brute", "jax"])
def test_spheres_touch_those_of_queries(backend, dtype):
    x, h = spheres(dtype)
    q, g = x[:9] + dtype(0.125), h[:9]
    for closed in (False, True):
        nbrs = jfrnn.search(x, (h, g), queries=q, closed=closed, radius_rule="sum", backend=backend)
        assert set(zip(*(part.tolist() for part in nbrs.pairs()))) == touching(x, h, q, g, closed=closed)


def test_lists_of_spheres_grow_with_the_radii_they_have():
    """A chunk that does not say cutoffs grows its list with those of the list: the radii, not the sums for which it keeps them."""
    rng = np.random.default_rng(6)
    x, h = rng.random((60, 2)).astype(np.float32), rng.uniform(0, 0.2, 60).astype(np.float32)
    nbrs = jfrnn.search(x, h, radius_rule="sum", capacity=1)
    assert nbrs.overflow
    _, grown = jfrnn.run_chunk(lambda x, nbrs: (x, nbrs), jnp.asarray(x), nbrs, lambda x: x)
    assert set(zip(*(part.tolist() for part in grown.pairs()))) == touching(x, h)
    np.testing.assert_array_equal(grown.radii.sources, nbrs.radii.sources)
    assert grown.radii.asked == "sum"
    h[3] = 2e38
    assert jfrnn.Status(int(jfrnn.search(x, h, radius_rule="sum", capacity=1).status)) & jfrnn.Status.INVALID_CUTOFF


def test_motion_and_growth_share_the_skin():
    """A list is kept while twice the motion and the growth of radii stay below the skin together, and misses no pair."""
    random, skin, n = np.random.default_rng(0), 0.1, 136
    x = random.random((n, 2)).astype(np.float32)
    h = np.exp(random.uniform(np.log(0.02), np.log(0.3), n)).astype(np.float32)
    nbrs = jfrnn.search(x, h, radius_rule="mean", skin=skin, capacity=CAPACITY)
    update = jax.jit(lambda nbrs, x, h: nbrs.update(x, cutoff=h))
    for move, grow in [(0.03, 0.03), (0.03, 0.05), (0.049, 0.0), (0.051, 0.0), (0.0, 0.09), (0.0, 0.11), (0.04, -0.01)]:
        made, before = nbrs.verlet, int(nbrs.rebuild_count)
        angle = random.uniform(0, 2 * np.pi, n)
        now = np.asarray(made.positions) + (move * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(np.float32)
        radii = np.asarray(made.radii.sources) + np.float32(grow)
        nbrs = update(nbrs, now, radii)
        assert int(nbrs.rebuild_count) - before == (2 * move + grow > skin)
        nbrs.check()
        assert masked_images(nbrs, now) == reference.reference_radii(now, radii, "mean")


X, H = np.zeros((4, 3), np.float32), np.ones(4, np.float32)


@pytest.mark.parametrize(
    ("error", "match", "make"),
    [
        (ValueError, r"radius_rule must be one of 'gather'.*got 'total'", lambda: jfrnn.search(X, H, radius_rule="total")),
        (ValueError, r"cutoff must be a number, or have shape \[4\], one per particle.*\[3\]", lambda: jfrnn.search(X, H[:3])),
        (TypeError, "cutoff must be a number, or an array of floats with one per particle", lambda: jfrnn.search(X, H.astype(int))),
        (TypeError, "cutoff must be a number, got str", lambda: jfrnn.search(X, "far")),
        (ValueError, r"cutoff must be a number, or have shape \[2\], one per query", lambda: jfrnn.search(X, H, queries=X[:2])),
        (
            ValueError,
            r"cutoff must be a pair of arrays, of the positions \[4\] and of the queries \[2\].*'mean'",
            lambda: jfrnn.search(X, H, queries=X[:2], radius_rule="mean"),
        ),
        (ValueError, "backend='hashgrid' takes one cutoff for all particles: pass", lambda: jfrnn.search(X, H, backend="hashgrid")),
        (ValueError, "adds radii of particles.*got float 0.5", lambda: jfrnn.search(X, 0.5, radius_rule="sum")),
        (ValueError, "made with one cutoff for all particles", lambda: jfrnn.search(X, 1.0).update(X, cutoff=H)),
        (ValueError, "pass such an array", lambda: jfrnn.search(X, H, capacity=4, backend="brute").update(X, cutoff=1.0)),
    ],
)
def test_errors(error, match, make):
    refuses(error, match, make)


def test_known_cutoffs_are_read_while_positions_are_traced():
    x = np.random.default_rng(0).random((30, 3)).astype(np.float32)
    cutoffs = jnp.asarray(np.linspace(0.2, 0.4, 30))
    found = jax.jit(lambda x: jfrnn.search(x, cutoffs, capacity=32, backend="brute"))(x)
    expected = reference.reference_radii(x, np.asarray(cutoffs), "gather")
    assert sorted(reference.pairs_of(np.asarray(found.idx), np.asarray(found.count), 30)) == sorted(pair[:2] for pair in expected)


def test_valid_cutoffs_are_told_alike_on_the_host():
    for dtype in (np.float32, np.float64):
        info = np.finfo(dtype)
        given = [0.0, -0.0, 1.0, -1.0, np.inf, np.nan, -np.nan, info.smallest_subnormal, info.tiny, info.max, info.max / 4]
        given += [x * f for x in (RANGE_OF[np.dtype(dtype)][0],) for f in (0.5, 1.0, 2.0)]
        radii = np.array(given, dtype)
        valid = is_radius(radii)
        assert isinstance(valid, np.ndarray)
        np.testing.assert_array_equal(valid, jax.jit(is_radius)(radii))
        assert valid[:4].tolist() == [True, True, True, False]


@pytest.mark.parametrize("backend", ["warp", "jax"])
def test_cutoffs_between_two_powers_of_two_reach_as_far_as_the_largest_of_them(backend):
    """Cells half as wide as the largest cutoff are wider than some cutoffs of a group, the last ones, but not than all of them."""
    n, radii = LENGTH, np.repeat([1.9, 0.99, 0.6], [2, 118, 40])  # more than are tested without cells
    x = 3 * np.random.default_rng(14).random((n, 3))
    x[2:120:2, 0], x[3:120:2, 0] = 0.94, 1.91  # on either side of such a cell
    x[3:120:2, 1:] = x[2:120:2, 1:]
    nbrs = jfrnn.search(jnp.asarray(x), radii, radius_rule="mean", capacity=CAPACITY, backend=backend)
    found = reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), n)
    assert set(found) == {pair[:2] for pair in reference.reference_radii(x, radii, "mean")}


def test_a_skin_is_added_to_cutoffs_and_rounded_up(dtype):
    """The smallest float from which on a list holds all pairs that its skin promises."""
    radii, skin = np.random.default_rng(15).uniform(0.1, 9, 100).astype(dtype), dtype(0.3)
    made = jax.jit(lambda radii: make_cutoffs(Radii(radii, None, "scatter"), False, float(skin)).sources)(radii)
    below = np.nextafter(np.asarray(made), dtype(0))
    nearest = 0
    for radius, whole, less in zip(radii.tolist(), np.asarray(made).tolist(), below.tolist(), strict=True):
        assert Fraction(less) < Fraction(radius) + Fraction(float(skin)) <= Fraction(whole)
        nearest += float(dtype(radius) + skin) == whole
    assert 10 < nearest < 90  # else all, or none, were rounded up
