"""`search_edges`: flat lists of edges against the oracle, what too small a total says, and their geometry against padded lists."""

from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import add_up, in_order, pull
from checked import refuses, slow, slowly, sparing

import jfrnn
from jfrnn._engine import rows as engine_rows
from jfrnn._engine.rows import add_up as add_up_rows

LENGTHS = {"open": None, "nearest": [1.0, 1.0, 1.0], "images": [0.5, 0.3, 1.0]}
N, CUTOFF = 60, 0.3
SLOW = pytest.mark.slow


def points(n=N, box="open", seed=0, dtype=np.float32):
    """Return points of which a third are a dense clump, so that rows differ in length."""
    x = np.random.default_rng(seed).random((n, 3)) * np.array(LENGTHS[box] or [1, 1, 1])
    x[: n // 3] = 0.2 + 0.05 * x[: n // 3]
    return x.astype(dtype)


def box_of(name, dtype=np.float32):
    return None if LENGTHS[name] is None else jfrnn.Box(np.array(LENGTHS[name], dtype))


def oracle(x, box, **options):
    cell = LENGTHS[box]
    matrix = np.ones(3) if cell is None else np.array(cell, x.dtype)
    return reference.reference_images(x, CUTOFF, matrix=matrix, periodic=(cell is not None,) * 3, **options)


def edges_as_set(edges):
    """Return (i, j, S) of the edges, after checking that each is there once, and sorted by receiver."""
    found = checked.as_set(*(np.asarray(x)[np.asarray(edges.mask)] for x in (edges.receivers, edges.senders, edges.shift)))
    assert len(found) == int(edges.pair_count)
    assert (np.diff(edges.receivers) >= 0).all()
    return found


def assert_right(nbrs, x, expected, queries=None):
    edges = nbrs.edges(x, queries=queries)
    assert edges_as_set(edges) == expected
    m, held = len(x if queries is None else queries), int(nbrs.pair_count)
    assert held == len(expected) == int(nbrs.required)
    assert (np.asarray(nbrs.senders)[held:] == len(x)).all()
    assert (np.asarray(nbrs.receivers)[held:] == m).all()
    np.testing.assert_array_equal(np.diff(nbrs.offsets), np.bincount(np.asarray(nbrs.receivers)[:held], minlength=m))
    assert set(zip(*(part.tolist() for part in nbrs.pairs()), strict=True)) == {pair[:2] for pair in expected}
    nbrs.check()


@pytest.mark.parametrize(("backend", "box"), sparing(product(("warp", "jax", "brute"), LENGTHS), [("warp", "images")]))
def test_edges_are_those_of_the_oracle(backend, box):
    x = points(box=box)
    assert_right(jfrnn.search_edges(x, CUTOFF, box=box_of(box), backend=backend), x, oracle(x, box))


@SLOW
@pytest.mark.parametrize("backend", ["warp", "jax", "brute", "hashgrid"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("options", [{"half": True}, {"include_self": True}, {"closed": True}, {"queries": True}], ids=str)
def test_options(backend, dtype, options):
    for box in ("open", "images") if backend != "hashgrid" else ("open",):
        x = points(200, box, dtype=dtype)
        given = options | ({"queries": points(70, box, 1, dtype)} if "queries" in options else {})
        nbrs = jfrnn.search_edges(x, CUTOFF, box=box_of(box, dtype), backend=backend, **given)
        assert_right(nbrs, x, oracle(x, box, **given), given.get("queries"))


@SLOW
@pytest.mark.parametrize("backend", ["warp", "jax", "brute"])
def test_cutoffs_per_particle_and_inactive_ones(backend):
    x, radii = points(), np.random.default_rng(2).uniform(0.05, 0.3, N).astype(np.float32)
    active = np.arange(N) % 5 > 0
    nbrs = jfrnn.search_edges(x, radii, radius_rule="either", active=active, backend=backend)
    expected = reference.reference_radii(x, radii, "either")
    assert_right(nbrs, x, {pair for pair in expected if active[pair[0]] and active[pair[1]]})


@SLOW
@pytest.mark.parametrize("backend", ["warp", "jax", "brute"])
def test_systems(backend):
    x, systems = points(120, "images"), np.arange(120) % 3
    nbrs = jfrnn.search_edges(x, CUTOFF, batch=systems, box=box_of("images"), backend=backend)
    assert_right(nbrs, x, {p for p in oracle(x, "images") if systems[p[0]] == systems[p[1]]})


@pytest.mark.parametrize("backend", ["warp", slow("brute")])
def test_too_small_a_total_is_never_silent(backend):
    x = points()
    whole = jfrnn.search_edges(x, CUTOFF, backend=backend)
    pairs = int(whole.pair_count)
    for total in (pairs - 1, 0):

        @jax.jit
        def step(x, total=total):
            nbrs = jfrnn.search_edges(x, CUTOFF, total=total, backend=backend)
            apart = nbrs.update(jnp.arange(N, dtype=x.dtype)[:, None] * jnp.ones(3, x.dtype))  # nobody is near anybody
            return nbrs, apart, nbrs.edges(x)

        nbrs, apart, edges = step(x)
        assert (int(nbrs.pair_count), int(apart.pair_count)) == (pairs, 0)
        np.testing.assert_array_equal(nbrs.senders, whole.senders[:total])
        assert np.isnan(edges.displacement).all()
        assert int(edges.status) == jfrnn.Status.TOTAL_OVERFLOW
        for kept in (nbrs, apart):  # sticky
            assert bool(kept.overflow)
            assert int(kept.required) == pairs
            with pytest.raises(jfrnn.NeighborOverflowError, match=f"total={total} is too small: there are {pairs} pairs") as raised:
                kept.check()
            assert (raised.value.required, raised.value.capacity) == (pairs, total)
        assert apart.grow(x).total >= pairs


def test_a_chunk_is_replayed_with_a_larger_total():
    @jax.jit
    def chunk(x, nbrs):
        def step(_, state):
            x, nbrs = state
            return 0.8 * x, nbrs.update(0.8 * x)

        return jax.lax.fori_loop(0, 3, step, (x, nbrs))

    x = jnp.asarray(points())
    nbrs = jfrnn.search_edges(x, CUTOFF, skin=0.02, backend="warp")
    y, grown = jfrnn.run_chunk(chunk, x, nbrs, lambda x: x)
    assert grown.total > nbrs.total
    assert edges_as_set(grown.edges(y)) == oracle(np.asarray(y), "open")


@pytest.mark.parametrize("half", [True, slow(False)])
def test_sums_are_those_of_numpy(half):
    """Over the pairs of a flat list at positions of now and at a shorter cutoff, with derivatives in positions, values and box."""
    x, lengths = points(30, "images", dtype=np.float64), np.array(LENGTHS["images"])
    m, w = np.linspace(1, 2, 30), np.arange(30.0)
    nbrs = jfrnn.search_edges(x, 0.4, box=jfrnn.Box(lengths), skin=0.02, half=half, total=3000, backend="brute")
    nbrs.check()
    x, cutoff = x + 0.005 * np.sin(40 * x), 0.35

    @jax.jit
    def all_of(x, m, lengths, nbrs):
        def f(x, m, lengths):
            fn = lambda r, i, j: i * j**2 * (r**3).sum()  # noqa: E731
            return w @ jfrnn.pair_sum(fn, x, cutoff, m, neighbors=nbrs, box=jfrnn.Box(lengths))

        return jax.value_and_grad(f, (0, 1, 2))(x, m, lengths)

    i, j, shift = pairs = in_order(reference.reference_images(x, cutoff, matrix=lengths, periodic=(True,) * 3), 3)
    assert (i == j).any()
    r = x[j] - x[i] + shift * lengths
    each, cubes = w[i] * m[i] * m[j] ** 2, (r**3).sum(1)
    of_r, of_m = 3 * each[:, None] * r**2, add_up(each / m[i] * cubes, i, 30) + add_up(2 * each / m[j] * cubes, j, 30)
    expected = each @ cubes, (pull(pairs, of_r, x), of_m, (of_r * shift).sum(0))
    found = all_of(x, m, lengths, nbrs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12 * np.abs(b).max()), found, expected)
    if half:
        with pytest.raises(ValueError, match="must be a full list for reduce='max'"):
            jfrnn.pair_sum(lambda r, i, j: r, x, None, neighbors=nbrs, reduce="max")


def test_derivatives_do_not_scatter():
    x, options = points(dtype=np.float64), {"total": 2000, "reverse": True, "backend": "brute"}
    nbrs = jax.eval_shape(lambda x: jfrnn.search_edges(x, CUTOFF, **options), x)  # for which no program is compiled
    text = jax.jit(jax.grad(lambda x, nbrs: jnp.sum(nbrs.edges(x).displacement ** 4))).lower(x, nbrs).as_text()
    assert [line for line in text.splitlines() if "stablehlo.scatter" in line and "f64" in line] == []


def test_graphs():
    x = points()
    nbrs = jfrnn.search_edges(x, CUTOFF, backend="warp", total=3000)
    graph, padded = nbrs.to_jraph(x), jfrnn.search(x, CUTOFF, backend="warp").to_jraph(x, 3000)
    assert graph.n_edge.tolist() == padded.n_edge.tolist()
    np.testing.assert_array_equal(np.bincount(graph.senders), np.bincount(padded.senders))
    refuses(ValueError, "cannot leave pairs of a skin out", jfrnn.search_edges(x, CUTOFF, skin=0.1, backend="warp").to_jraph, x)
    refuses(ValueError, "this list has queries", jfrnn.search_edges(x, CUTOFF, queries=x[:3], backend="warp").to_jraph, x)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"total": 2**31}, r"total must be at most 2147483647"),
        ({"total": -1}, "total must be at least 0"),
        ({"total": 3.5}, "total must be a static int"),
        ({}, "total must be given where positions are traced"),
    ],
)
def test_totals_are_refused_while_tracing(options, message):
    refuses((ValueError, TypeError), message, jax.eval_shape, lambda x: jfrnn.search_edges(x, CUTOFF, **options), jnp.zeros((4, 3)))


def test_more_pairs_than_int32_are_refused(monkeypatch):
    monkeypatch.setattr("jfrnn._search.edge_list.MOST_PAIRS", 10)
    with pytest.raises(ValueError, match="total must be at most 10, as many pairs as int32 can number, and there are"):
        jfrnn.search_edges(points(), CUTOFF, backend="warp")


def test_nobody():
    for n, total in ((0, 3), (5, 0)):
        x = np.zeros((n, 3), np.float32)
        nbrs = jfrnn.search_edges(x, 1.0, total=total, backend="warp")
        assert nbrs.senders.shape == nbrs.edges(x).senders.shape == (total,) if n == 0 else (0,)
        assert int(nbrs.pair_count) == n * (n - 1) if n else True
        assert bool(nbrs.overflow) == (n > 0)


def test_positions_that_are_not_finite_are_told():
    x = points()
    x[3] = np.nan
    nbrs = jfrnn.search_edges(x, CUTOFF, backend="warp")
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE
    refuses(ValueError, "non-finite", nbrs.check)
    assert 3 not in np.asarray(nbrs.edges(jnp.asarray(x)).senders)


def test_a_line_says_what_the_list_is():
    x = jnp.zeros((5, 3), np.float32)
    one = jfrnn.search_edges(x, 1.0, total=30, queries=x[:2], backend="warp")
    assert repr(one) == "EdgeList(2 queries of 5 particles, total 30, cutoff 1, engine 'warp', 10 pairs, status OK)"
    many = jax.vmap(lambda x: jfrnn.search_edges(x, 1.0, total=8, backend="warp"))(x[None])
    assert repr(many) == "EdgeList(batch of [1], 5 particles, total 8, cutoff 1, engine 'warp', 20 pairs, status TOTAL_OVERFLOW)"
    assert "total None" in repr(jax.tree.map(lambda _: None, one))  # whatever stands where arrays stood
    assert "total None" in repr(jax.tree.map(jnp.sum, one))
    assert "float32 pairs, status float32" in repr(jax.tree.map(lambda x: x.astype(jnp.float32), one))


def test_where_rows_begin_never_wraps():
    """Counts whose sums leave int32 once, and come back to where they look right."""
    counts = np.array([5, 2**30, 0, 2**30, 2**31 - 1, 2**31 - 1, 7], np.int32)
    exact = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    wrapped = np.cumsum(counts, dtype=np.int32)
    assert (wrapped[exact[1:] >= 2**31] >= 0).any()
    np.testing.assert_array_equal(jax.jit(add_up_rows)(jnp.asarray(counts)), np.minimum(exact, 2**31 - 1))
    np.testing.assert_array_equal(jax.jit(add_up_rows)(jnp.asarray(counts[:3])), exact[:4])


@pytest.mark.parametrize(("backend", "include_self"), [("warp", False), *slowly(("warp", True), ("jax", False))])
def test_own_images_in_half_lists(backend, include_self):
    """They are listed once, and so counted, with and without a program, where both ends of a pair are one particle."""
    x, lengths = points(5), np.array([0.25, 0.25, 0.25])
    given = {"half": True, "include_self": include_self}
    expected = reference.reference_images(x, CUTOFF, matrix=np.diag(lengths), periodic=(True,) * 3, **given)
    assert sum(i == j for i, j, _ in expected) == 5 * (3 + include_self)
    options = given | {"box": jfrnn.Box(lengths), "backend": backend}
    room = {"total": len(expected)} if backend == "jax" else {}  # given where a program that counts compiles for seconds
    nbrs = jfrnn.search_edges(x, CUTOFF, **options, **room)
    nbrs.check()
    assert nbrs.total == (len(expected) if room else -(-len(expected) // 8) * 8)
    assert edges_as_set(nbrs.edges(x)) == expected
    if not room:
        rows = jfrnn.search(x, CUTOFF, **options)
        rows.check()
        np.testing.assert_array_equal(rows.count, np.bincount([i for i, *_ in expected], minlength=5))


COPIED = list(product(["", "half", "include_self", "queries", "box"], [10, 100_000], [0, 300]))  # rows of 300 overflow
COPIED_OFTEN = [*COPIED[:4], *(each for each in COPIED[4:] if each[1:] == (100_000, 300))]


@pytest.mark.parametrize(("asked", "total", "dense"), sparing(COPIED, COPIED_OFTEN))
def test_rows_that_are_copied_are_those_that_are_filled(monkeypatch, asked, total, dense):
    rng = np.random.default_rng(0)
    x = jnp.asarray(np.concatenate([rng.random((2000, 3)), 0.02 * rng.random((dense, 3))]), jnp.float32)
    given = {"queries": x[:700] + 0.01, "box": jfrnn.Box([1.0, 1.0, 1.0])}
    options = {asked: given.get(asked, True)} if asked else {}
    filled, copied = (_edges_with(monkeypatch, copies, x, total, options) for copies in (False, True))
    jax.tree.map(np.testing.assert_array_equal, filled, copied)


def _edges_with(monkeypatch, copies, x, total, options):
    monkeypatch.setattr(engine_rows, "copies_rows", lambda *_: copies)
    jax.clear_caches()
    return jfrnn.search_edges(x, 0.1, total=total, **options)
