"""Periodic boxes: every case of `jfrnn.cases.periodic` against the oracle, then what boxes add to lists."""

import functools
from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import in_order
from checked import refuses, slow, sparing

import jfrnn
from jfrnn._geometry.images import images_of
from jfrnn._geometry.wrapping import unpack_turns
from jfrnn.cases.periodic import PERIODIC_CASES

CAPACITY = 400
LENGTH = 304


unpacked = jax.jit(unpack_turns, static_argnums=1)


def image_pairs(nbrs, positions, queries=None):
    """Return (i, j, S) of every used slot, after checking padding and counts; S is found without the library's vectors."""
    assert not nbrs.overflow
    idx, count = np.asarray(nbrs.idx), np.asarray(nbrs.count)
    if nbrs.box is None:
        return {(*pair, (0,) * np.shape(positions)[1]) for pair in reference.pairs_of(idx, count, nbrs.source_count)}
    used = np.arange(nbrs.capacity) < count[:, None]
    assert (idx[~used] == nbrs.source_count).all()
    i, k = np.nonzero(used)
    j, kind, dim = idx[i, k], nbrs.box_kind, nbrs.box.dim
    system = np.asarray(nbrs.batch.sources if queries is None else nbrs.batch.queries)[i] if kind.per_system else np.zeros_like(i)
    if nbrs.images is None:
        x = np.asarray(positions, np.float64)
        q = x if queries is None else np.asarray(queries, np.float64)
        vectors = np.asarray(nbrs.box.vectors, np.float64)
        vectors = vectors if kind.per_system else vectors[None]
        vectors = vectors[..., None] * np.eye(dim) if vectors.ndim == 2 else vectors
        periodic = np.array(kind.periodic) if nbrs.box.flags is None else np.asarray(nbrs.box.flags)
        inverse = np.linalg.pinv(np.where(periodic[..., None], vectors, 0))
        shifts = -np.rint(np.einsum("pd,pdk->pk", x[j] - q[i], inverse[system]))
    else:
        turns, of_rows = (None if t is None else np.asarray(unpacked(t, dim)) for t in nbrs.images[1:])
        shifts = kind.shifts[np.asarray(nbrs.images.codes)[i, k]] + (turns if of_rows is None else of_rows)[i] - turns[j]
        numbers = np.asarray(nbrs.box.numbers)[system] if kind.short else kind.numbers
        shifts = (shifts[:, None] @ numbers)[:, 0]  # of given vectors, where the list counts short ones
    return checked.as_set(i, j, shifts.astype(int))


@jax.jit
def shifts_and_mask(nbrs, positions, options):
    return nbrs.shifts(positions, **options), nbrs.vectors(positions, **options)[1]


def masked_images(nbrs, positions, found=None, **options):
    """Return (i, j, S) of every pair within the true cutoff, as the list's own geometry has them: `found`, or asked here."""
    assert not nbrs.overflow
    shifts, mask = shifts_and_mask(nbrs, positions, options) if found is None else found
    return checked.slots_as_set(nbrs.idx, mask, shifts)


@functools.lru_cache(maxsize=4)
def built(name, dtype, dim):
    return PERIODIC_CASES[name].build(dtype, dim)


@functools.lru_cache(maxsize=4)
def expected_images(name, dtype, dim, closed):
    given = built(name, dtype, dim)
    options = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries, "closed": closed}
    return reference.reference_images(given.positions, given.cutoff, **options)


# More images than a cutoff needs, in 3D, so that cases share a program.
IMAGES = dict.fromkeys(("thin_slab", "thin_wire"), (2, 2, 2))
IMAGES |= dict.fromkeys(("alone", "alone_ties", "cutoff_2.5_boxes"), (4, 4, 4))
IMAGES |= dict.fromkeys(("narrow", "nearly_parallel", "hexagonal", "fcc_primitive", "alone_skewed"), (5, 4, 4))
IMAGES |= dict.fromkeys(("cutoff_1.5_skewed", "skewed_3_small", "far_from_reduced_crowded"), (5, 4, 4))


def assert_case(name, dtype, dim, backend, *, closed=False, geometry=False, images=None):
    given = built(name, dtype, dim)
    box = jfrnn.Box(given.matrix, given.periodic, images=images) if any(given.periodic) else None
    queries = {} if given.queries is None else {"queries": jnp.asarray(checked.padded(given.queries, LENGTH))}
    x, expected = jnp.asarray(checked.padded(given.positions, LENGTH)), expected_images(name, dtype, dim, closed)
    nbrs = jfrnn.search(x, given.cutoff, box=box, backend=backend, capacity=CAPACITY, closed=closed, **queries)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE  # the padding
    checked.assert_same(image_pairs(nbrs, x, **queries), expected)
    if geometry and box is not None:
        checked.assert_same(masked_images(nbrs, x, **queries), expected)


TIED = [name for name in PERIODIC_CASES if any(word in name for word in ("ties", "crystal", "cutoffs", "residues", "_supercell"))]
# other axes than those of periodic_x, periodic_z, periodic_xz and periodic_yz, or of skewed_slab and skewed_wire, a program each
RARE = ("periodic_y", "periodic_xy", "skewed_slab_first")
OPTIMIZED = ("ties_across", "cutoff_1.5_boxes")  # nearest images, and several: kernels as users run them


def each_case():
    """Yield every case, kind, engine and comparison; by default each on Warp, in a kind whose programs they share, and few more."""
    often = [(name, np.float64, 2, "warp", True) for name in TIED[::3]]
    often += [("cutoff_1_boxes", np.float32, 2, "brute", False)]  # of "jax", a traced box tells
    kinds = product((np.float32, np.float64), (2, 3), ("warp", "jax", "brute"), (False, True))
    for (dtype, dim, backend, closed), name in product(kinds, PERIODIC_CASES):
        each, shared = (name, dtype, dim, backend, closed), (dtype, dim, backend, closed) == (np.float32, 3, "warp", False)
        by_default = each in often or (shared and name not in RARE)
        kind = name if shared else f"{name}-f{8 * dtype().itemsize}-{dim}d-{backend}-{'closed' if closed else 'open'}"
        marks = [pytest.mark.slow] * (not by_default) + [pytest.mark.kernels] * (shared and name in OPTIMIZED)
        yield pytest.param(*each, not by_default, IMAGES.get(name) if shared else None, id=kind, marks=marks)


@pytest.mark.parametrize(("name", "dtype", "dim", "backend", "closed", "geometry", "images"), list(each_case()))
def test_case(name, dtype, dim, backend, closed, geometry, images):
    assert_case(name, dtype, dim, backend, closed=closed, geometry=geometry, images=images)


# --- what boxes add to lists -----------------------------------------------------------------------------------------------

LENGTHS, SKEWED = np.array([1.0, 1.2, 0.9]), np.array([[1.0, 0.0, 0.0], [0.3, 1.1, 0.0], [-0.2, 0.25, 0.95]])
SMALL = np.array([0.5, 1.2, 0.45])  # several images within a cutoff of 0.3


def points(n, dtype=np.float64, seed=0, scale=3.0):
    return jnp.asarray(scale * (np.random.default_rng(seed).random((n, 3)) - 0.5), dtype)


def oracle(x, cutoff, vectors, periodic=(True,) * 3, **options):
    return reference.reference_images(np.asarray(x), cutoff, matrix=np.asarray(vectors, x.dtype), periodic=periodic, **options)


HALF, SELF = {"half": True}, {"include_self": True}
OFTEN = [(np.float32, vectors, options) for vectors in ("nearest", "images") for options in (HALF, HALF | SELF)]
OFTEN += [(np.float64, "images", SELF)]
ALL = product((np.float32, np.float64), ("nearest", "images"), (HALF, SELF, HALF | SELF))


@pytest.mark.parametrize(("dtype", "vectors", "options"), sparing(ALL, OFTEN), ids=str)
def test_options(options, vectors, dtype):
    """Of two opposite images of a particle itself, half lists have one."""
    x, (vectors, cutoff) = points(40, dtype), {"nearest": (LENGTHS, 0.3), "images": (SMALL, 0.6)}[vectors]
    nbrs = jfrnn.search(x, cutoff, box=jfrnn.Box(vectors), backend="warp", capacity=256, **options)
    assert image_pairs(nbrs, x) == oracle(x, cutoff, vectors, **options)
    np.testing.assert_array_equal(jfrnn.count(x, cutoff, box=jfrnn.Box(vectors), backend="warp", **options), nbrs.count)


def test_an_open_box_is_none():
    x = points(50)
    nbrs = jfrnn.search(x, 0.5, box=jfrnn.Box(LENGTHS, periodic=False))
    assert nbrs.box is None
    checked.assert_exact(nbrs, np.asarray(x), 0.5)


def test_memory_of_images():
    """Nothing where the nearest image is the only one; else a byte per slot, and four per particle."""
    x = points(64, np.float32)
    plain, nearest, images = (jfrnn.search(x, 0.3, box=box, capacity=200) for box in (None, jfrnn.Box(LENGTHS), jfrnn.Box(SMALL)))
    assert nearest.images is None
    assert images.images.codes.dtype == np.uint8
    size = [sum(leaf.nbytes for leaf in jax.tree.leaves(nbrs)) for nbrs in (plain, nearest, images)]
    assert size[1] - size[0] == sum(leaf.nbytes for leaf in jax.tree.leaves(nearest.box))
    assert size[2] - size[1] == images.idx.size + 4 * 64


@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_a_traced_box_may_change(backend):
    x = points(60, np.float32, scale=2.0)

    @jax.jit
    def neighbors(x, lengths):
        traces.append(lengths)
        return jfrnn.search(x, 0.3, box=jfrnn.Box(lengths), capacity=64, backend=backend)

    traces = []
    for stretch in (1.0, 0.9, 1.5):
        lengths = (stretch * LENGTHS).astype(np.float32)
        assert image_pairs(neighbors(x, jnp.asarray(lengths)), x) == oracle(x, 0.3, lengths)
    assert len(traces) == 1
    for lengths in ([1.0, 0.6, 1.0], [1.0, -1.0, 1.0], [1.0, 0.0, 1.0], [1.0, np.nan, 1.0]):
        nbrs = neighbors(x, jnp.asarray(lengths, jnp.float32))
        assert jfrnn.Status.BOX_TOO_SMALL in jfrnn.Status(int(nbrs.status))
        refuses(ValueError, "too small", nbrs.check)


def test_a_traced_box_with_images():
    x = points(30, scale=2.0)
    found = jax.jit(lambda x, v: jfrnn.search(x, 0.3, box=jfrnn.Box(v, images=(1, 1, 2)), capacity=128, backend="warp"))
    assert image_pairs(found(x, jnp.asarray(SMALL)), x) == oracle(x, 0.3, SMALL)
    assert jfrnn.Status.BOX_TOO_SMALL in jfrnn.Status(int(found(x, jnp.asarray(0.25 * LENGTHS)).status))


@pytest.mark.parametrize("backend", [slow("jax"), "warp"])
def test_out_of_range_positions_set_a_bit_and_spare_the_others(backend):
    x = points(30, np.float32).at[7, 1].set(1e7)
    nbrs = jfrnn.search(x, 0.3, box=jfrnn.Box(LENGTHS), backend=backend)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.OUT_OF_RANGE
    expected = {pair for pair in oracle(x, 0.3, LENGTHS) if 7 not in pair[:2]}
    assert image_pairs(nbrs, x) == expected
    refuses(ValueError, r"too far away", nbrs.check)


def pull_back(forces, x, boxes, pairs, systems):
    """Return the sums of `forces` [pairs, d] on the positions, and on the vectors of each box: derivatives of a sum over pairs."""
    (i, j, shifts), kind = pairs, np.result_type(forces)
    of_x, of_boxes = np.zeros(x.shape, kind), np.zeros(boxes.shape, kind)
    np.add.at(of_x, j, forces)
    np.add.at(of_x, i, -forces)
    np.add.at(of_boxes, systems[i], shifts[:, :, None] * forces[:, None, :])
    return of_x, of_boxes


def energy_and_slopes(x, boxes, pairs, systems, cutoff):
    """Return the sum of (cutoff - r)^3 over pairs, and its derivatives in positions and boxes; all may be complex."""
    i, j, shifts = pairs
    v = x[j] - x[i] + np.einsum("ps,psd->pd", shifts, boxes[systems[i]])
    r = np.sqrt((v**2).sum(axis=1))
    return ((cutoff - r) ** 3).sum(), *pull_back(-3 * ((cutoff - r) ** 2 / r)[:, None] * v, x, boxes, pairs, systems)


@pytest.mark.parametrize(
    "vectors", [slow(LENGTHS), slow(SKEWED), slow(SMALL), 0.6 * SKEWED], ids=["lengths", "skewed", "images", "skewed images"]
)
def test_gradients_in_positions_and_box(vectors):
    """First and second derivatives of a sum over the oracle's pairs; the second are those of a complex step."""
    x, rng, single = points(14, scale=1.0), np.random.default_rng(1), vectors.ndim == 1
    nbrs = jfrnn.search(x, 0.3, box=jfrnn.Box(vectors), backend="warp", capacity=64)
    directions = rng.normal(size=x.shape), rng.normal(size=vectors.shape)

    def energy(x, vectors):
        r, mask = nbrs.distances(x, box=jfrnn.Box(vectors))
        return jnp.sum(jnp.where(mask, (0.3 - r) ** 3, 0))

    def in_numpy(x, vectors):
        box = np.diag(vectors) if single else vectors
        total, of_x, (of_box,) = energy_and_slopes(x, box[None], pairs, np.zeros(14, int), 0.3)
        return total, (of_x, np.diag(of_box) if single else of_box)

    pairs, step = in_order(oracle(x, 0.3, vectors), 3), 1e-30
    slopes = jax.value_and_grad(energy, argnums=(0, 1))
    (total, found), (_, second) = jax.jit(lambda *given: jax.jvp(slopes, given[:2], given[2:]))(x, vectors, *directions)
    ahead = [given + 1j * step * way for given, way in zip((np.asarray(x), vectors), directions, strict=True)]
    np.testing.assert_allclose(total, in_numpy(np.asarray(x), vectors)[0], rtol=1e-12)
    for parts in zip(found, second, in_numpy(np.asarray(x), vectors)[1], in_numpy(*ahead)[1], strict=True):
        first, turn, right, right_turn = map(np.asarray, parts)
        np.testing.assert_allclose(first, right, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(turn, right_turn.imag / step, rtol=1e-10, atol=1e-12)
        assert np.abs(right).max() > 0.01


LONG = np.array([[1.0, 0.0, 0.0], [30.3, 1.1, 0.0], [-17.2, 21.1, 0.9]]) @ np.linalg.qr(SKEWED + 1)[0]


@pytest.mark.parametrize(
    ("backend", "kind", "options"),
    [
        slow("warp", np.float32, {}),
        ("warp", np.float32, {"half": True}),
        ("warp", np.float64, {"queries": 5}),
        slow("jax", np.float32, {"half": True}),
        slow("brute", np.float64, {"periodic": (True, True, False)}),
        slow("jax", np.float64, {}),
    ],
    ids=str,
)
def test_lattices_far_from_reduced(backend, kind, options):
    rng, periodic = np.random.default_rng(0), options.get("periodic", (True,) * 3)
    whole = rng.integers(-3, 4, (12, 3)) * periodic
    fractions = rng.uniform(0, 1, (12, 3)) * np.where(periodic, 1, 0.5)  # all of the open vector is 600 of the first one away
    x = ((fractions + whole) @ LONG).astype(kind)
    given = {"half": True} if "half" in options else {"queries": x[:5] + 0.25} if "queries" in options else {}
    box = jfrnn.Box(LONG, periodic)
    nbrs = jfrnn.search(x, 0.9, box=box, backend=backend, capacity=64, **given)
    nbrs.check()
    expected = oracle(x, 0.9, LONG, periodic, **given)
    asked = {name: given[name] for name in ("queries",) if name in given}
    assert masked_images(nbrs, x, **asked) == expected
    assert int(np.asarray(nbrs.count).sum()) == len(expected) > (50 if given else 100)
    assert (nbrs.box_kind.basis is not None) == all(periodic)


def test_derivatives_in_a_lattice_far_from_reduced_are_those_in_the_given_vectors():
    x = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (6, 3)) @ LONG)
    nbrs = jfrnn.search(x, 0.9, box=jfrnn.Box(LONG), backend="warp", capacity=64)

    def squares(v):
        vectors = nbrs.vectors(x, box=jfrnn.Box(v))[0]
        return (vectors**2).sum(), (vectors, nbrs.shifts(x))

    found, (vectors, shifts) = jax.jit(jax.grad(squares, has_aux=True))(LONG)
    np.testing.assert_allclose(found, 2 * np.einsum("nkl,nkd->ld", shifts, vectors), rtol=1e-9, atol=1e-9)


DIAMOND = 3.567 / 2 * np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    ("cell", "cutoff", "counts"),
    [
        ([[3.0, 0.0, 0.0], [900.0, 3.0, 0.0], [0.0, 0.0, 3.0]], 6.0, [26]),
        slow(DIAMOND, 95 * 0.529177210903, [94004, 94004]),  # at 95 bohr
    ],
    ids=["one particle in a skewed cell", "diamond"],
)
def test_known_numbers_of_neighbors_at_long_cutoffs(cell, cutoff, counts):
    atoms = 3.567 / 4 * np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert jfrnn.count(atoms[: len(counts)], cutoff, box=jfrnn.Box(cell)).tolist() == counts


X = np.zeros((4, 3), np.float32)


@pytest.mark.parametrize(
    ("error", "match", "make"),
    [
        (ValueError, r"lengths_or_matrix must have shape \[d\].*got shape \[4\]", lambda: jfrnn.Box([1.0] * 4)),
        (ValueError, r"got shape \[\]: a cube is Box\(\[length\] \* 3\)", lambda: jfrnn.Box(1.0)),
        (TypeError, r"lengths_or_matrix must be real numbers, got str", lambda: jfrnn.Box("1")),
        (ValueError, r"lengths of periodic axes must be positive, got \[1.0, 0.0\]", lambda: jfrnn.Box([1.0, 0.0])),
        (ValueError, r"lengths_or_matrix must be finite, got \[1.0, nan\]", lambda: jfrnn.Box([1.0, np.nan])),
        (ValueError, r"linearly independent, got the rows", lambda: jfrnn.Box([[1.0, 2.0], [2.0, 4.0]])),
        (ValueError, r"periodic must be one bool or one per axis \(2\), got 3", lambda: jfrnn.Box([1.0, 1.0], (True,) * 3)),
        (TypeError, r"periodic must be one bool or one per axis.*got 1", lambda: jfrnn.Box([1.0, 1.0], 1)),
        (ValueError, r"origin must be a number or have shape \[2\], got shape \[3\]", lambda: jfrnn.Box([1.0, 1.0], origin=X[0])),
        (TypeError, r"images must be one int >= 0 or one per axis", lambda: jfrnn.Box([1.0, 1.0], images=-1)),
        (TypeError, r"box must be a jfrnn.Box, got list.*write e.g. jfrnn.Box", lambda: jfrnn.search(X, 1.0, box=[1.0, 1.0, 1.0])),
        (ValueError, r"box has 2 axes, but positions have 3 columns", lambda: jfrnn.search(X, 1.0, box=jfrnn.Box([1.0, 1.0]))),
        (ValueError, r"'hashgrid' knows no periodic box", lambda: jfrnn.count(X, 0.1, box=jfrnn.Box(LENGTHS), backend="hashgrid")),
        (ValueError, r"box is too small for this cutoff.*Replicate", lambda: jfrnn.search(X, 99.0, box=jfrnn.Box([1.0] * 3))),
        (ValueError, r"without a periodic box: leave box out", lambda: jfrnn.search(X, 1.0).update(X, box=jfrnn.Box([9.0] * 3))),
        (
            ValueError,
            r"box must be of the kind with which the list was made",
            lambda: jfrnn.search(X, 1.0, box=jfrnn.Box([9.0] * 3)).update(X, box=jfrnn.Box(np.diag([9.0] * 3))),
        ),
    ],
)
def test_bad_boxes_say_what_is_wrong(error, match, make):
    refuses(error, match, make)


def test_a_box_without_a_periodic_axis_may_be_given_again():
    """To a list that was made with it, as code does whose axes are those of data."""
    box = jfrnn.Box(LENGTHS, periodic=False)
    nbrs = jfrnn.search(X, 1.0, box=box)
    np.testing.assert_array_equal(nbrs.update(X, box=box).count, nbrs.count)
    assert jfrnn.pair_sum(lambda r, i, j: 1.0, X, None, neighbors=nbrs, box=box).shape == (len(X),)


# --- how many images -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vectors", "cutoff", "dtype"),
    [
        (LENGTHS, 0.3, np.float32),
        slow(LENGTHS, 0.5, np.float64),
        (SMALL, 0.3, np.float64),
        (SKEWED, 0.6, np.float32),
        (LENGTHS, 3.1, np.float32),
    ],
)
def test_images_can_be_asked_for(vectors, cutoff, dtype):
    """A traced box with so many images finds all pairs, and nothing says it is too small; with one less it says so."""
    x, images = points(12, dtype, scale=1.0), jfrnn.Box(vectors).images_for(cutoff)
    assert all(isinstance(k, int) for k in images)
    expected = np.bincount([i for i, _, _ in oracle(x, cutoff, vectors)], minlength=12)

    def count(images):
        return jax.jit(lambda v: jfrnn.count(x, cutoff, box=jfrnn.Box(v, images=images)))(vectors.astype(dtype))

    np.testing.assert_array_equal(count(images), expected)
    if any(images):
        fewer = tuple(k - (k == max(images)) for k in images)
        assert (np.asarray(count(fewer)) == np.iinfo(np.int32).min).all()


def test_images_are_as_many_as_int32_numbers():
    box, most = jfrnn.Box([1.0, 1.0, 1.0]), (2**31 - 1) // 27
    assert images_of(box, 0.6, np.dtype(np.float32), most).total == 27
    for sources in (most + 1, 2**27):
        with pytest.raises(ValueError, match=f"{sources} of them with 27 images each are more than int32 can number"):
            images_of(box, 0.6, np.dtype(np.float32), sources)
    assert images_of(box, 0.4, np.dtype(np.float32), 2**27).nearest  # such lists number no images


def test_images_of_nothing_known():
    refuses(TypeError, "traced", jax.jit(lambda v: jfrnn.Box(v).images_for(0.3)), LENGTHS)
    for wrong in (0.0, -1.0, np.inf):
        refuses(ValueError, "positive and finite", jfrnn.Box(LENGTHS).images_for, wrong)
    refuses(TypeError, "must be a number, got str", jfrnn.Box(LENGTHS).images_for, "far")


def test_sums_in_the_box_of_a_list_have_its_images_and_chunks_raise_both():
    """A cell shrinks in a chunk until pairs have several images: `run_chunk` takes more, for the list and for sums in its box.

    Positions count the edges of the cell, and so stay as they are.
    """
    u = points(20, scale=1.0) + 0.5

    @jax.jit
    def chunk(state, nbrs):
        def step(_, carry):
            (size, _), nbrs = carry
            size = size * 0.95
            nbrs = nbrs.update(u, box=cell(size))
            return (size, jfrnn.pair_sum(lambda r, i, j: jnp.ones((), r.dtype), u, 0.4, box=nbrs.box)), nbrs

        return jax.lax.fori_loop(0, 20, step, (state, nbrs))

    def cell(size):
        return jfrnn.Box(size * jnp.ones(3), fractional=True)

    state = jnp.asarray(1.0), jnp.zeros(20)
    nbrs = jfrnn.search(u, 0.4, skin=0.02, box=jfrnn.Box([1.0] * 3, fractional=True), capacity=192)
    assert nbrs.box.images_of_list == (0, 0, 0)
    (size, sums), nbrs = jfrnn.run_chunk(chunk, state, nbrs, lambda s: u, box=lambda s: cell(s[0]))
    assert nbrs.box.images_of_list == (2, 2, 2)
    found = oracle(u * size, 0.4, size * np.ones(3))
    np.testing.assert_array_equal(sums, np.bincount([i for i, _, _ in found], minlength=20))
    assert int(jfrnn.count(u, 0.9, box=nbrs.box)[0]) > int(sums[0])  # a box that is known has as many as a cutoff needs


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_a_box_beyond_the_numbers_of_its_dtype(backend):
    """A reciprocal of an edge that is not a normal number is flushed to 0."""
    x = np.array([[0.1, 0.5], [0.9, 0.5]], np.float32)
    for name, box in (
        ("lengths_or_matrix", jfrnn.Box([2.0**126, 1.0])),
        ("lengths_or_matrix", jfrnn.Box([[1e39, 0.0], [0.0, 1.0]])),
        ("origin", jfrnn.Box([1.0, 1.0], origin=[1e39, 0.0])),
    ):
        refuses(
            ValueError, f"{name} must not exceed 4.3e\\+37, as positions are float32", lambda box=box: jfrnn.count(x, 0.3, box=box)
        )
    assert jfrnn.count(x, 0.3, box=jfrnn.Box([2.0**124, 1.0]), backend=backend).tolist() == [0, 0]


def test_cells_from_lengths_and_angles():
    """As ASE makes them; right angles are exact, in 2D, too, and traced ones alike."""
    Cell = pytest.importorskip("ase.cell").Cell
    for parameters in ([3.0, 4.0, 5.0, 80.0, 70.0, 110.0], [1.0, 2.0, 3.0, 90.0, 90.0, 90.0], [1.0, 1.0, 1.0, 60.0, 60.0, 60.0]):
        box = jfrnn.Box.from_parameters(parameters[:3], parameters[3:], periodic=(True, True, False), images=1)
        np.testing.assert_allclose(box.vectors, Cell.fromcellpar(parameters)[:], atol=1e-12)
        assert box.periodic == (True, True, False)
        traced = jax.jit(lambda a, b: jfrnn.Box.from_parameters(a, b).vectors)(*np.split(np.array(parameters), 2))
        np.testing.assert_allclose(traced, box.vectors, atol=1e-12)
    np.testing.assert_array_equal(jfrnn.Box.from_parameters([1.0, 2.0], 90.0).vectors, np.diag([1.0, 2.0]))
    for error, match, make in (
        (ValueError, "Box.from_parameters", lambda: jfrnn.Box([1.0, 2.0, 3.0, 90.0, 90.0, 90.0])),
        (ValueError, "less than the sum of the others", lambda: jfrnn.Box.from_parameters([1.0, 2.0, 3.0], [10.0, 20.0, 150.0])),
        (ValueError, "less than the sum of the others", lambda: jfrnn.Box.from_parameters([1.0] * 3, [60.0, 60.0, 120.0])),  # flat
        (ValueError, "less than the sum of the others", lambda: jfrnn.Box.from_parameters([1.0] * 3, np.float32([85, 60, 145]))),
        (ValueError, "between 0 and 180", lambda: jfrnn.Box.from_parameters([1.0, 2.0, 3.0], [10.0, 20.0, 180.0])),
        (ValueError, r"lengths and angles must have shape \[3\] each", lambda: jfrnn.Box.from_parameters([1.0, 2.0, 3.0], 90.0)),
    ):
        refuses(error, match, make)
