"""Fractional coordinates: the product with the lattice vectors, then searches, lists and sums as of positions that are lengths."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import in_order
from checked import as_set, refuses, slow
from test_box import image_pairs, masked_images, pull_back
from test_boxes import oracle as oracle_of_systems

import jfrnn
import jfrnn.distributed
from jfrnn._search.geometry import real_points

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


def test_second_derivatives_of_products():
    """Those of a sum of cubes of the product in one direction, by a complex step."""
    u, ways, step = np.asarray(points(np.float64)), (np.sin(points(np.float64)), np.cos(SKEWED)), 1e-30

    def cubes(u, vectors):
        return (real_points(u, None, jfrnn.Box(vectors, fractional=True), None, True)[0] ** 3).sum()

    def in_numpy(u, vectors):
        of_x = 3 * (u @ vectors) ** 2
        return of_x @ vectors.T, u.T @ of_x

    found, turned = jax.jit(lambda *given: jax.jvp(jax.grad(cubes, (0, 1)), given[:2], given[2:]))(u, SKEWED, *ways)
    ahead = in_numpy(*(given + 1j * step * way for given, way in zip((u, SKEWED), ways, strict=True)))
    for first, second, right, right_ahead in zip(found, turned, in_numpy(u, SKEWED), ahead, strict=True):
        np.testing.assert_allclose(first, right, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(second, right_ahead.imag / step, rtol=1e-12, atol=1e-12)


OFTEN = [("skewed", np.float32, "warp")]
ALL = [(name, dtype, backend) for name in BOXES for dtype in (np.float32, np.float64) for backend in ("warp", "jax", "brute")]


@pytest.mark.parametrize(("name", "dtype", "backend"), [*OFTEN, *(slow(*x) for x in ALL if x not in OFTEN)])
def test_lists_and_flat_lists(name, dtype, backend):
    (vectors, periodic, cutoff), u, q = BOXES[name], points(dtype), points(dtype, 1, 7)
    real, asking = exact(u, vectors, dtype), exact(q, vectors, dtype)
    flags = [periodic] * 3 if isinstance(periodic, bool) else periodic
    given = {"box": jfrnn.Box(vectors, periodic, fractional=True), "backend": backend}
    expected = reference.reference_images(real, cutoff, matrix=vectors, periodic=flags)
    nbrs = jfrnn.search(u, cutoff, capacity=CAPACITY, **given)
    nbrs.check()
    assert (masked_images if nbrs.images is None else image_pairs)(nbrs, u) == expected
    nodes = jax.jit(lambda nbrs, u: nbrs.to_jraph(u, 2048).nodes)(nbrs, u)
    np.testing.assert_array_equal(nodes["positions"][:N], real)
    flat = jfrnn.search_edges(u, cutoff, half=True, total=2048, **given)
    flat.check()
    edges = jax.jit(lambda flat, u: flat.edges(u))(flat, u)
    i, j, s, v = (np.asarray(x)[np.asarray(edges.mask)] for x in (edges.receivers, edges.senders, edges.shift, edges.displacement))
    assert as_set(i, j, s) == reference.reference_images(real, cutoff, matrix=vectors, periodic=flags, half=True)
    rows = np.diag(vectors) if vectors.ndim == 1 else vectors
    np.testing.assert_allclose(v, real[j] - real[i] + s @ rows, atol=1e-5)
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


def smooth_in_numpy(r):
    """Return `smooth` of each row of r, which may be complex, and its derivative."""
    s, factor = np.sqrt((r**2).sum(axis=1) + 0.01), 1 + r[:, 0]
    of_length = -3 * (0.7 - s) ** 2 * factor / s
    return (0.7 - s) ** 3 * factor, of_length[:, None] * r + ((0.7 - s) ** 3)[:, None] * np.eye(3)[0]


@pytest.mark.parametrize("per_system", [True, slow(False)])
@pytest.mark.parametrize("way", ["first", *(slow(way) for way in ("search", "list", "edges", "vectors", "jax"))])
def test_derivatives_in_coordinates_and_vectors_are_those_of_the_product(way, per_system):
    """Derivatives of sums over the oracle's pairs, after "first" also the second ones in one direction, by a complex step."""
    u, batch = np.asarray(points(np.float64, 4)), np.arange(N) % 3 if per_system else np.zeros(N, int)
    cells = CELLS if per_system else SKEWED[None]
    real = np.concatenate([exact(p[None], cells[k], np.float64) for p, k in zip(u, batch)])
    i, j, shifts = in_order(oracle_of_systems(cells, real, batch, 0.6), real.shape[1])
    images, weights = jfrnn.Box(CELLS if per_system else SKEWED).images_for(0.6), np.cos(np.arange(N))
    more = {"batch": batch} if per_system else {}

    def energy(u, cells):
        box = jfrnn.Box(cells if per_system else cells[0], images=images, fractional=True)
        if way in ("first", "search", "jax"):
            return jfrnn.pair_sum(smooth, u, 0.6, box=box, backend="jax" if way == "jax" else "warp", **more) @ weights
        nbrs = jfrnn.search(u, 0.6, box=box, capacity=CAPACITY, **more)
        if way == "list":
            return jfrnn.pair_sum(smooth, u, None, neighbors=nbrs, box=box) @ weights
        if way == "vectors":
            vectors, mask = nbrs.vectors(u, box=box)
            terms = jax.vmap(jax.vmap(lambda r: smooth(r, None, None)))(vectors)
            return jnp.where(mask, terms, 0).sum(axis=1) @ weights
        edges = nbrs.edges(u, len(i), box=box)
        terms = jax.vmap(lambda r: smooth(r, None, None))(edges.displacement)
        return jnp.where(edges.mask, terms * jnp.asarray(weights)[jnp.minimum(edges.receivers, N - 1)], 0).sum()

    def in_numpy(u, cells):
        whole, rows = u[j] - u[i] + shifts, cells[batch[i]]
        terms, forces = smooth_in_numpy(np.einsum("pd,pdk->pk", whole, rows))
        forces = weights[i, None] * forces
        of_u, _ = pull_back(np.einsum("pk,pdk->pd", forces, rows), u, cells, (i, j, shifts), batch)
        return terms @ weights[i], of_u, pull_back(forces, u, cells, (i, j, whole), batch)[1]

    slopes, ways, step = jax.value_and_grad(energy, (0, 1)), (np.sin(u), np.cos(cells)), 1e-30
    if way == "first":
        found = turned = jax.jit(slopes)(u, cells)
    else:
        found, turned = jax.jit(lambda *given: jax.jvp(slopes, given[:2], given[2:]))(u, cells, *ways)
    ahead = in_numpy(*(given + 1j * step * way for given, way in zip((u, cells), ways, strict=True)))
    for parts in zip(*map(jax.tree.leaves, (found, turned)), in_numpy(u, cells), ahead, strict=True):
        first, second, right, right_ahead = map(np.asarray, parts)
        np.testing.assert_allclose(first, right, rtol=1e-8, atol=1e-9 * np.abs(right).max())
        if way != "first":
            right = right_ahead.imag / step
            np.testing.assert_allclose(second, right, rtol=1e-8, atol=1e-9 * np.abs(right).max())


def test_errors():
    u, box = points(np.float32), jfrnn.Box(SKEWED, fractional=True)
    refuses(TypeError, "fractional must be True or False, known while tracing, got 'yes'", jfrnn.Box, SKEWED, fractional="yes")
    nbrs = jfrnn.search(u, 0.3, box=box, capacity=64)
    with pytest.raises(ValueError, match=r"of the kind with which the list was made \(.*matrix, fractional\), got .*matrix\."):
        nbrs.update(u, box=jfrnn.Box(SKEWED))
    with pytest.raises(ValueError, match="positions that are lengths: spread positions @ vectors"):
        mesh = jax.make_mesh((1,), ("x",))
        jfrnn.distributed.scatter(np.asarray(u), 0.3, mesh=mesh, box=jfrnn.Box([1.0, 1.0, 1.0], fractional=True))
    lost = jfrnn.search(np.where(np.arange(N)[:, None] == 3, np.nan, u).astype(u.dtype), 0.3, box=box, capacity=64)
    assert jfrnn.Status(int(lost.status)) == jfrnn.Status.NONFINITE and np.asarray(lost.count)[3] == 0
