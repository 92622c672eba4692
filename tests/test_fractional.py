"""Fractional coordinates: the product with the lattice vectors, then searches, lists and sums as of positions that are lengths."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from test_box import masked_images
from test_boxes import oracle as oracle_of_systems

import jfrnn
import jfrnn.distributed
from jfrnn._search.fractional import real_points

SLOW = pytest.mark.slow
SKEWED = np.array([[1.0, 0.0, 0.0], [0.45, 0.9, 0.0], [-0.3, 0.35, 1.1]])
BOXES = {
    "skewed": (SKEWED, True, 0.7),
    "lengths": (np.array([0.9, 1.3, 1.1]), True, 0.6),
    "slab": (SKEWED, (True, False, True), 0.7),
    "open": (SKEWED, False, 0.6),
    "nearest": (3 * SKEWED, True, 0.7),
}
N, CAPACITY = 24, 192


def exact(points, vectors, dtype):
    """Return points @ vectors, each component rounded once."""
    rows = np.diag(vectors) if np.ndim(vectors) == 1 else vectors
    rows = [[Fraction(x) for x in row] for row in np.asarray(rows, dtype).tolist()]
    given = [[Fraction(x) for x in point] for point in np.asarray(points, dtype).tolist()]
    return np.array([[float(sum(x * row[k] for x, row in zip(p, rows))) for k in range(len(rows))] for p in given]).astype(dtype)


def points(dtype, seed=0, n=N):
    return jnp.asarray(np.random.default_rng(seed).uniform(-1.5, 1.5, (n, 3)), dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_products_are_rounded_once(dtype):
    u = points(dtype, n=500)
    for vectors in (SKEWED, 7.3 * SKEWED, BOXES["lengths"][0]):
        for convert in (real_points, jax.jit(real_points, static_argnums=(3, 4))):
            found = convert(u, None, jfrnn.Box(vectors, fractional=True), None, True)[0]
            np.testing.assert_array_equal(found, exact(u, vectors, dtype))


OFTEN = [("skewed", np.float32, "warp")]
ALL = [(name, dtype, backend) for name in BOXES for dtype in (np.float32, np.float64) for backend in ("warp", "jax", "brute")]


@pytest.mark.parametrize(("name", "dtype", "backend"), [*OFTEN, *(pytest.param(*x, marks=SLOW) for x in ALL if x not in OFTEN)])
def test_lists_flat_lists_and_counts(name, dtype, backend):
    (vectors, periodic, cutoff), u, q = BOXES[name], points(dtype), points(dtype, 1, 7)
    real, asking = exact(u, vectors, dtype), exact(q, vectors, dtype)
    flags = [periodic] * 3 if isinstance(periodic, bool) else periodic
    given = {"box": jfrnn.Box(vectors, periodic, fractional=True), "backend": backend}
    expected = reference.reference_images(real, cutoff, matrix=vectors, periodic=flags)
    nbrs = jfrnn.search(u, cutoff, capacity=CAPACITY, **given)
    nbrs.check()
    assert masked_images(nbrs, u) == expected
    np.testing.assert_array_equal(jfrnn.count(u, cutoff, **given), nbrs.count)
    flat = jfrnn.search_edges(u, cutoff, half=True, **given)
    edges = flat.edges(u)
    i, j, s = (np.asarray(part)[np.asarray(edges.mask)] for part in (edges.receivers, edges.senders, edges.shift))
    half = reference.reference_images(real, cutoff, matrix=vectors, periodic=flags, half=True)
    assert set(zip(i.tolist(), j.tolist(), map(tuple, s.tolist()), strict=True)) == half
    rows = np.diag(vectors) if vectors.ndim == 1 else vectors
    np.testing.assert_allclose(edges.displacement[: len(i)], real[j] - real[i] + s @ rows, atol=1e-5)
    of_queries = jfrnn.search(u, cutoff, queries=q, capacity=CAPACITY, **given)
    asked = reference.reference_images(real, cutoff, matrix=vectors, periodic=flags, queries=asking)
    assert masked_images(of_queries, u, queries=q) == asked


CELLS = np.stack([SKEWED, 0.4 * SKEWED, 2.5 * SKEWED[::-1]])


def test_queries_count_the_vectors_of_their_own_system():
    """As many queries as particles, of other systems: whoever takes the systems of the others has shapes that fit."""
    dtype, u, q, of_u, of_q = np.float32, points(np.float32), points(np.float32, 1), np.arange(N) % 3, np.arange(N) // 8
    cells = CELLS.astype(dtype)
    box = jfrnn.Box(cells, fractional=True)
    x, y = (np.concatenate([exact(p[None], cells[k], dtype) for p, k in zip(*each)]) for each in ((u, of_u), (q, of_q)))
    expected = oracle_of_systems(cells, x, of_u, 0.5, queries=y, query_batch=of_q)
    counts = jfrnn.count(u, 0.5, queries=q, box=box, batch=(of_u, of_q))
    np.testing.assert_array_equal(counts, np.bincount([i for i, _, _ in expected], minlength=N))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["warp", "jax", "brute"])
def test_systems_with_skins_in_boxes_that_change(backend):
    """Every step holds the pairs of that step; coordinates stay, while boxes breathe; then room is made."""
    random, dtype = np.random.default_rng(2), np.float32
    u, batch, cells = points(dtype, 3), np.arange(N) % 4 - 1, jnp.asarray(CELLS, dtype)
    nbrs = jfrnn.search(u, 0.5, box=jfrnn.Box(cells, fractional=True), batch=batch, skin=0.08, slack=1.5, backend=backend)
    update = jax.jit(lambda nbrs, u, cells: nbrs.update(u, box=jfrnn.Box(cells, fractional=True)))

    def expected():
        real = np.concatenate([exact(p[None], np.asarray(cells)[max(b, 0)], dtype) for p, b in zip(np.asarray(u), batch)])
        return oracle_of_systems(np.asarray(cells), real, batch, 0.5)

    for step in range(6):
        u = u + jnp.asarray(random.normal(scale=0.004, size=u.shape), dtype) - np.float32(step == 3)
        cells = cells * np.float32(1 + 0.002 * step)
        nbrs = update(nbrs, u, cells)
        nbrs.check()
        assert masked_images(nbrs, u) == expected()
    assert 0 < int(nbrs.rebuild_count) < 6
    small = jfrnn.search(u, 0.5, box=jfrnn.Box(cells, fractional=True), batch=batch, capacity=1, backend=backend)
    assert masked_images(small.grow(u), u) == expected()


def smooth(r, i, j):
    return (0.7 - jnp.sqrt(r @ r + 0.01)) ** 3 * (1 + r[0])


@pytest.mark.parametrize("per_system", [True, pytest.param(False, marks=SLOW)])
@pytest.mark.parametrize("way", ["search", *(pytest.param(way, marks=SLOW) for way in ("list", "edges", "distances", "jax"))])
def test_derivatives_in_coordinates_and_vectors_are_those_of_the_product(way, per_system):
    u, batch = points(np.float64, 4), jnp.arange(N) % 3
    cells = jnp.asarray(CELLS if per_system else SKEWED)
    more = {"batch": batch} if per_system else {}
    nbrs = jfrnn.search(u, 0.6, box=jfrnn.Box(cells, fractional=True), **more)
    total = int(nbrs.count.sum())
    weights = jnp.cos(jnp.arange(N))

    def energy(u, cells, fractional):
        x = u if fractional else jnp.einsum("nd,ndk->nk", u, cells[batch]) if per_system else u @ cells
        box, kept = jfrnn.Box(cells, images=nbrs.box_kind.reach, fractional=fractional), nbrs
        if not fractional:
            kept = jfrnn.search(jax.lax.stop_gradient(x), 0.6, box=box, capacity=nbrs.capacity, **more)
        if way == "list":
            return jfrnn.pair_sum(smooth, x, None, neighbors=kept, box=box) @ weights
        if way == "edges":
            edges = kept.edges(x, total, box=box)
            return (jnp.where(edges.mask, jax.vmap(lambda r: smooth(r, None, None))(edges.displacement), 0) * edges.receivers).sum()
        if way == "distances":
            r, mask = kept.distances(x, box=box)
            return jnp.where(mask, (0.6 - r) ** 3, 0).sum(1) @ weights
        return jfrnn.pair_sum(smooth, x, 0.6, box=box, backend="jax" if way == "jax" else "warp", **more) @ weights

    def everything(u, cells, fractional):
        slopes = jax.value_and_grad(energy, (0, 1))
        second = jax.jvp(lambda u, c: slopes(u, c, fractional), (u, cells), (jnp.sin(u), jnp.cos(cells)))[1]
        return slopes(u, cells, fractional), second

    for found, right in zip(
        *(jax.tree.leaves(jax.jit(everything, static_argnums=2)(u, cells, x)) for x in (True, False)), strict=True
    ):
        np.testing.assert_allclose(found, right, rtol=1e-8, atol=1e-9 * float(jnp.abs(right).max()))


def test_chunks_of_steps():
    u = points(np.float64, 5)
    box = lambda size: jfrnn.Box(size * 3 * jnp.asarray(SKEWED), fractional=True)  # noqa: E731

    @jax.jit
    def chunk(size, nbrs):
        def step(_, carry):
            size, nbrs = carry
            return 0.9 * size, nbrs.update(u, box=box(0.9 * size))

        return jax.lax.fori_loop(0, 5, step, (size, nbrs))

    nbrs = jfrnn.search(u, 0.7, skin=0.1, box=jfrnn.Box(3 * SKEWED, fractional=True))
    size, nbrs = jfrnn.run_chunk(chunk, jnp.asarray(1.0), nbrs, lambda size: u, box=box)
    real = exact(u, size * 3 * SKEWED, np.float64)
    assert masked_images(nbrs, u) == reference.reference_images(real, 0.7, matrix=np.asarray(nbrs.box.vectors), periodic=[True] * 3)
    graph = nbrs.to_jraph(u, 4096)
    np.testing.assert_allclose(graph.nodes["positions"][:N], real, rtol=1e-12)


def test_errors():
    u, box = points(np.float32), jfrnn.Box(SKEWED, fractional=True)
    with pytest.raises(TypeError, match="fractional must be True or False, known while tracing, got 'yes'"):
        jfrnn.Box(SKEWED, fractional="yes")
    nbrs = jfrnn.search(u, 0.3, box=box)
    with pytest.raises(ValueError, match=r"of the kind with which the list was made \(.*matrix, fractional\), got .*matrix\."):
        nbrs.update(u, box=jfrnn.Box(SKEWED))
    with pytest.raises(ValueError, match="positions that are lengths: spread positions @ vectors"):
        mesh = jax.make_mesh((1,), ("x",))
        jfrnn.distributed.scatter(np.asarray(u), 0.3, mesh=mesh, box=jfrnn.Box([1.0, 1.0, 1.0], fractional=True))
    lost = jfrnn.search(u.at[3].set(jnp.nan), 0.3, box=box, capacity=64)
    assert jfrnn.Status(int(lost.status)) == jfrnn.Status.NONFINITE and lost.count[3] == 0
