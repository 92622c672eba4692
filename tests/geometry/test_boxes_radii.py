"""Cutoffs that differ, per particle or per pair of species, in systems with boxes of their own: the pairs of the oracle."""

import functools
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import in_order
from checked import slow, sparing
from test_box import image_pairs, masked_images, pull_back
from test_boxes import box_of, system_by_system
from test_search_edges import edges_as_set

import jfrnn
from jfrnn._geometry.cutoffs import RULES
from jfrnn.cases.crystals import CRYSTAL_CASES

SLOW = pytest.mark.slow
CAPACITY = {2: 96, 3: 256}
TABLE = np.array([[0.75, 0, 0.5], [0, 0, 0.875], [0.5, 0.875, 0.375]])  # the second species has no neighbors of its own


def oracle(who, boxes, x, batch, given, periodic=None, queries=None, query_batch=None, table=TABLE, **options):
    """Return (i, j, S) of all pairs, system by system; `given` are the radii or species of sources and of queries."""
    of_sources, of_queries = given

    def find(ends, starts, **kind):
        own = {} if queries is None else {"query_species" if who == "table" else "query_radii": of_queries[starts]}
        if who == "table":
            return reference.reference_species(x[ends], table.astype(x.dtype), of_sources[ends], **own, **kind, **options)
        return reference.reference_radii(x[ends], of_sources[ends], who, **own, **kind, **options)

    return system_by_system(find, boxes, x, batch, periodic, queries, query_batch)


class Scene:
    """A case of `jfrnn.cases.crystals`, with radii or species; half of the radii are such that pairs are at exactly the cutoff."""

    def __init__(self, name, dtype, dim, who):
        self.given, self.who, random = CRYSTAL_CASES[name].build(dtype, dim), who, np.random.default_rng(1)
        sizes = [len(self.given.positions), 0 if self.given.queries is None else len(self.given.queries)]
        if who == "table":
            self.of_points = [random.integers(0, len(TABLE), n).astype(np.int32) for n in sizes]
        else:
            self.of_points = [np.where(np.arange(n) % 2, 0.75, random.uniform(0, 0.9, n)).astype(dtype) for n in sizes]
        self.x = self.given.positions
        self.queries = {} if self.given.queries is None else {"queries": jnp.asarray(self.given.queries)}
        self.batch = self.given.batch if self.given.queries is None else (self.given.batch, self.given.query_batch)
        self.own = self.given.queries is None

    @property
    def cutoff(self):
        if self.who == "table":
            return TABLE.astype(self.x.dtype)
        if self.own:
            return self.of_points[0]
        return {"gather": self.of_points[1], "scatter": self.of_points[0]}.get(self.who, tuple(self.of_points))

    @property
    def options(self):
        if self.who == "table":
            return {"species": self.of_points[0] if self.own else tuple(self.of_points)}
        return {"radius_rule": self.who}

    def pairs(self, **options):
        given = self.given
        of_queries = {"queries": given.queries, "query_batch": given.query_batch}
        return oracle(self.who, given.boxes, self.x, given.batch, self.of_points, given.periodic, **of_queries, **options)

    def search(self, backend, search=jfrnn.search, **options):
        given = self.queries | self.options | {"box": box_of(self.given), "batch": self.batch, "backend": backend} | options
        return search(jnp.asarray(self.x), self.cutoff, **given)


@functools.lru_cache(maxsize=32)
def scene(name, dtype, dim, who):
    return Scene(name, dtype, dim, who)


KINDS = list(product(CRYSTAL_CASES, (*RULES, "table"), (np.float32, np.float64), (2, 3), ("warp", "jax", "brute")))
OFTEN = [("queries", "mean", np.float32, 3, "warp")]  # others take long to compile


@pytest.mark.parametrize(("name", "who", "dtype", "dim", "backend"), sparing(KINDS, OFTEN))
def test_case(name, who, dtype, dim, backend):
    given = scene(name, dtype, dim, who)
    nbrs = given.search(backend, capacity=CAPACITY[dim])
    nbrs.check()
    expected = given.pairs()
    assert image_pairs(nbrs, given.x, **given.queries) == expected
    assert masked_images(nbrs, given.x, **given.queries) == expected
    np.testing.assert_array_equal(given.search(backend, jfrnn.count), nbrs.count)
    assert len(expected) > 0 and nbrs.backend == backend


@pytest.mark.parametrize("backend", ["warp", slow("jax"), slow("brute")])
@pytest.mark.parametrize("who", ["table", slow("either")])
def test_options_and_flat_lists(who, backend):
    given = scene("mixed", np.float32, 2, who)
    exclude = np.random.default_rng(2).integers(0, len(given.x), (40, 2))
    expected = reference.without_excluded(given.pairs(half=True, closed=True), exclude)
    flat = given.search(backend, jfrnn.search_edges, half=True, closed=True, exclude=exclude, total=1024)
    flat.check()
    edges = jax.jit(lambda flat, x: flat.edges(x))(flat, given.x)
    assert edges_as_set(edges) == expected
    if backend == "warp" and who == "either":
        nbrs = given.search(backend, half=True, exclude=exclude)
        assert masked_images(nbrs, given.x) == reference.without_excluded(given.pairs(half=True), exclude)
        closed = given.search(backend, closed=True)
        assert masked_images(closed, given.x) == given.pairs(closed=True)


@SLOW
@pytest.mark.parametrize(("who", "backend"), [("table", "warp"), ("mean", "warp"), ("table", "jax")])
def test_skin_while_cutoffs_and_boxes_change(who, backend):
    """Room is made, particles drift, boxes breathe and cutoffs grow: every step holds exactly the pairs of that step."""
    given, random = scene("mixed", np.float32, 2, who), np.random.default_rng(0)
    x, boxes, cutoff, batch = given.x, given.given.boxes, given.cutoff, given.given.batch
    options = given.options | {"box": jfrnn.Box(boxes), "batch": batch, "skin": 0.08, "backend": backend}
    small = jfrnn.search(x, cutoff, capacity=1, **options)
    assert small.overflow
    nbrs = small.grow(x, box=jfrnn.Box(boxes), cutoff=cutoff, slack=1.5)
    update = jax.jit(lambda nbrs, x, boxes, cutoff: nbrs.update(x, box=jfrnn.Box(boxes), cutoff=cutoff))

    def expected(scale):
        if who == "table":
            return oracle(who, boxes, x, batch, given.of_points, table=TABLE.astype(np.float32) * scale)
        return oracle(who, boxes, x, batch, [given.of_points[0] * scale, None])

    for step in range(6):
        scale = np.float32(1 + 0.002 * step)
        x = x + random.normal(scale=0.004, size=x.shape).astype(x.dtype)
        boxes = boxes * np.float32(1 + 0.001 * np.sin(step))
        nbrs = update(nbrs, x, boxes, cutoff * scale)
        assert masked_images(nbrs, x) == expected(scale)
    assert 0 < int(nbrs.rebuild_count) < 6
    nbrs.check()


def weight(r, i, j):
    return (1 + i["m"]) * j["m"] * (1 - r @ r) ** 2 + r[0]


WAYS = [("mean", "warp", "search")]
MORE = [(who, backend, way) for who in (*RULES, "table") for backend in ("warp", "jax", "brute") for way in ("search", "list")]


@pytest.mark.parametrize(("who", "backend", "way"), [*WAYS, *(slow(*x) for x in MORE if x not in WAYS)])
def test_sums_and_derivatives_in_positions_and_boxes(who, backend, way):
    """Sums over the oracle's pairs, their gradient, and with a table that of its norm, by a complex step."""
    given = scene("mixed", np.float64, 2, who)
    x, boxes, batch, m = given.x, given.given.boxes, given.batch, np.random.default_rng(4).uniform(0, 1, len(given.x))
    i, j, shifts = pairs = in_order(given.pairs(), 2)
    reach, weights = box_of(given.given).images_for(float(np.max(given.cutoff))), np.arange(1.0, len(x) + 1)
    nbrs = given.search(backend, capacity=CAPACITY[2]) if way == "list" else None

    def in_numpy(x, boxes):
        r = x[j] - x[i] + np.einsum("ps,psd->pd", shifts, boxes[batch[i]])
        square, factor = (r**2).sum(axis=1), (1 + m[i]) * m[j]
        forces = -4 * (factor * (1 - square))[:, None] * r + np.eye(2)[0]
        sums = np.zeros(len(x), r.dtype)
        np.add.at(sums, i, factor * (1 - square) ** 2 + r[:, 0])
        return sums, pull_back(weights[i, None] * forces, x, boxes, pairs, batch)

    def of_library(x, boxes):
        box = jfrnn.Box(boxes, images=reach)
        if way == "list":
            return jfrnn.pair_sum(weight, x, None, {"m": m}, neighbors=nbrs, box=box)
        options = given.options | {"box": box, "batch": batch, "backend": backend}
        return jfrnn.pair_sum(weight, x, given.cutoff, {"m": m}, **options)

    def slopes(x, boxes):
        sums, back = jax.vjp(of_library, x, boxes)
        return sums, back(jnp.asarray(weights))

    def size(x, boxes):
        return sum((part**2).sum() for part in slopes(x, boxes)[1])

    @jax.jit
    def everything(x, boxes):
        return slopes(x, boxes), jax.grad(size, (0, 1))(x, boxes) if who == "table" else ()

    found, second = everything(x, boxes)
    for part, right in zip(jax.tree.leaves(found), jax.tree.leaves(in_numpy(x, boxes)), strict=True):
        np.testing.assert_allclose(part, right, rtol=1e-9, atol=1e-9 * np.abs(right).max())
    if who == "table":
        step, ways = 1e-30, [np.random.default_rng(5).normal(size=part.shape) for part in (x, boxes)]
        ahead = in_numpy(x + 1j * step * ways[0], boxes + 1j * step * ways[1])[1]
        right = sum((part**2).sum() for part in ahead).imag / step
        along = sum((np.asarray(part) * way).sum() for part, way in zip(second, ways, strict=True))
        np.testing.assert_allclose(along, right, rtol=1e-9)


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_what_is_wrong_sets_bits_and_absent_particles_may_have_any_cutoff(backend):
    given = scene("absent", np.float32, 2, "either")
    gone, radii = given.given.batch < 0, given.cutoff.copy()
    assert gone.any()
    radii[gone] = -1
    box = jfrnn.Box(given.given.boxes, given.given.periodic, images=6)
    count = jax.jit(lambda radii: jfrnn.search(given.x, radii, capacity=96, box=box, batch=given.batch, **given.options))
    nbrs = count(radii)
    nbrs.check()
    assert image_pairs(nbrs, given.x) == given.pairs()
    radii[np.flatnonzero(~gone)[0]] = np.nan
    assert jfrnn.Status(int(count(radii).status)) == jfrnn.Status.INVALID_CUTOFF


def test_far_reaching_queries_among_sources_with_small_cutoffs():
    """The larger cutoff of a pair decides, so cells of a system are as wide as the largest of either."""
    rng, boxes = np.random.default_rng(3), np.array([[2.0, 2.2, 1.9], [1.7, 2.4, 2.1]], np.float32)
    x, q, batch, asking = rng.random((60, 3)), rng.random((20, 3)), np.repeat([0, 1], 30), np.repeat([0, 1], 10)
    x, q = (x * boxes[batch]).astype(np.float32), (q * boxes[asking]).astype(np.float32)
    radii = np.full(60, 0.1, np.float32), np.full(20, 0.7, np.float32)
    given = {"box": jfrnn.Box(boxes, per_system=True), "batch": (batch, asking), "queries": jnp.asarray(q)}
    nbrs = jfrnn.search(jnp.asarray(x), radii, radius_rule="either", capacity=32, backend="warp", **given)
    nbrs.check()
    expected = oracle("either", boxes, x, batch, radii, queries=q, query_batch=asking)
    assert image_pairs(nbrs, x, queries=q) == expected
    assert len(expected) > 60
