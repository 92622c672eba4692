"""Order along curves: published keys, both key types, bijections, unit steps, and what a sort by cells promises."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses, slow

from jfrnn._geometry.curves import hilbert_decode, hilbert_encode, morton_decode, morton_encode
from jfrnn._geometry.order import CLASSES, order_for_tree, sort_order

CURVES = {"morton": (morton_encode, morton_decode), "hilbert": (hilbert_encode, hilbert_decode)}
MOST_BITS = {2: 31, 3: 21}
SORT_BITS = 21
PUBLISHED = [
    ("morton", 10, (1, 2, 3), 53),
    ("morton", 10, (5, 9, 1), 1095),
    ("morton", 10, (511, 512, 513), 824480333),
    ("morton", 10, (123, 456, 789), 642569997),
    ("morton", 21, (123456, 654321, 999999), 947864390891170086),
    ("hilbert", 10, (1, 0, 0), 7),
    ("hilbert", 10, (0, 1, 0), 3),
    ("hilbert", 10, (0, 0, 1), 1),
    ("hilbert", 10, (1, 2, 3), 36),
    ("hilbert", 10, (5, 9, 1), 1989),
    ("hilbert", 10, (1023, 0, 0), 1073741823),
    ("hilbert", 10, (123, 456, 789), 250792394),
    ("hilbert", 21, (123456, 654321, 999999), 1008055606062051326),
]


@pytest.fixture(params=[True, False], ids=["x64", "x32"])
def x64(request):
    with jax.enable_x64(request.param):
        yield request.param


@pytest.fixture(params=CURVES)
def curve(request):
    return request.param


def cube(bits, dim):
    return np.array(list(itertools.product(range(2**bits), repeat=dim)), np.int32)


def whole(keys, dim, bits, x64):
    """Return keys as uint64, after checking that their type is the documented one."""
    if dim * bits <= 32:
        assert keys.dtype == jnp.uint32
    elif x64:
        assert keys.dtype == jnp.uint64
    else:
        assert keys.dtype == jnp.uint32
        assert keys.shape[-1] == 2
        words = np.asarray(keys).astype(np.uint64)
        return words[..., 0] << np.uint64(32) | words[..., 1]
    return np.asarray(keys).astype(np.uint64)


def interleaved(c, bits):
    return sum(((int(v) >> bit) & 1) << (len(c) * bit + axis) for bit in range(bits) for axis, v in enumerate(c))


@pytest.mark.parametrize("bits, x64", [(10, True), (21, True), (21, False)])  # of 10 bits, both modes have the same keys
def test_published_keys(curve, bits, x64):
    encode, decode = CURVES[curve]
    coords, published = zip(*((c, key) for name, width, c, key in PUBLISHED if (name, width) == (curve, bits)))
    coords = np.resize(np.array(coords, np.int32), (20, 3))
    with jax.enable_x64(x64):
        keys = encode(coords, bits)
        np.testing.assert_array_equal(whole(keys, 3, bits, x64), np.resize(np.array(published, np.uint64), 20))
        np.testing.assert_array_equal(decode(keys, 3, bits), coords)


@pytest.mark.parametrize("bits", [11, 21])
def test_narrow_keys_keep_their_value_with_more_bits(bits, x64):
    coords, published = zip(*((c, key) for name, width, c, key in PUBLISHED if name == "morton" and width <= bits))
    coords = np.resize(np.array(coords, np.int32), (20, 3))
    np.testing.assert_array_equal(whole(morton_encode(coords, bits), 3, bits, x64), np.resize(np.array(published, np.uint64), 20))


def test_hilbert_visits_the_first_cube_as_published(x64):
    visited = hilbert_decode(jnp.arange(8, dtype=jnp.uint32), 3, 1)
    assert ["".join(map(str, c)) for c in visited.tolist()] == ["000", "001", "011", "010", "110", "111", "101", "100"]


def test_keys_number_the_cells_of_a_cube(curve, dim):
    bits, cells = 4, cube(4, dim)
    keys = whole(CURVES[curve][0](cells, bits), dim, bits, True)
    np.testing.assert_array_equal(np.sort(keys), np.arange(len(cells)))
    np.testing.assert_array_equal(CURVES[curve][1](keys.astype(np.uint32), dim, bits), cells)


@pytest.mark.parametrize(("bits", "dim"), [(5, 2), (4, 3)])
def test_hilbert_steps_to_a_cell_that_shares_a_face(bits, dim):
    visited = np.asarray(hilbert_decode(jnp.arange(2 ** (dim * bits), dtype=jnp.uint32), dim, bits))
    assert np.all(np.abs(np.diff(visited, axis=0)).sum(axis=1) == 1)
    np.testing.assert_array_equal(visited[0], 0)
    np.testing.assert_array_equal(visited[-1], [2**bits - 1, *[0] * (dim - 1)])


@pytest.mark.parametrize(("dim", "x64"), [(2, False), (3, True)], indirect=["x64"])
def test_hilbert_steps_across_the_words(dim, x64):
    """Keys around 2^32, and around every carry of a 2D or 3D curve of the highest order."""
    bits = MOST_BITS[dim]
    carries = np.array([2**k for k in range(4, dim * bits)], np.uint64)
    keys = (carries[:, None] + np.arange(-8, 8).astype(np.uint64)).reshape(-1)
    pairs = keys if x64 else np.stack([keys >> np.uint64(32), keys & np.uint64(2**32 - 1)], axis=-1).astype(np.uint32)
    visited = hilbert_decode(pairs, dim, bits)
    steps = np.abs(np.diff(np.asarray(visited).reshape(len(carries), 16, dim), axis=1)).sum(axis=2)
    assert np.all(steps == 1)
    np.testing.assert_array_equal(whole(hilbert_encode(visited, bits), dim, bits, x64), keys)


def test_low_hilbert_keys_stay_when_bits_grow_by_the_dimension(dim):
    cells = cube(3, dim)
    for more in (3 + dim, 3 + 2 * dim):
        np.testing.assert_array_equal(hilbert_encode(cells, more), hilbert_encode(cells, 3))


@pytest.fixture(params=[(10, 2, True), (10, 3, False), (17, 2, False), (17, 3, True), (31, 2, True), (21, 3, False)], ids=str)
def kind(request):
    """Return bits, the dimension and the mode, which is turned on."""
    with jax.enable_x64(request.param[2]):
        yield request.param


def test_decode_inverts_encode(curve, kind):
    bits, dim, x64 = kind
    encode, decode = CURVES[curve]
    coords = np.random.default_rng(1).integers(0, 2**bits, (20, 25, dim))
    coords[0, :3] = [[0] * dim, [2**bits - 1] * dim, [2**bits - 1] + [0] * (dim - 1)]
    keys = encode(coords, bits)
    assert keys.shape == ((20, 25, 2) if dim * bits > 32 and not x64 else (20, 25))
    back = decode(keys, dim, bits)
    assert back.dtype == jnp.int32
    np.testing.assert_array_equal(back, coords)
    values = whole(keys, dim, bits, x64)
    assert values.max() < 2 ** (dim * bits)
    if curve == "morton":
        assert values[0].tolist() == [interleaved(c, bits) for c in coords[0]]
        if bits == MOST_BITS[dim]:
            np.testing.assert_array_equal(morton_encode(coords), keys, strict=True)
            np.testing.assert_array_equal(morton_decode(keys, dim), coords)


def test_concrete_arguments_inside_jit_are_checked(curve):
    outside = jnp.array([0, 16], jnp.int32)
    refuses(ValueError, "got values from 0 to 16: give more bits", jax.jit(lambda: CURVES[curve][0](outside, 4)))
    np.testing.assert_array_equal(jax.jit(lambda: CURVES[curve][0](outside, 5))(), CURVES[curve][0](outside, 5))


@pytest.mark.parametrize(
    ("curve", "kind"),
    [
        *itertools.product(["morton"], [np.int8, np.int16, np.uint64]),
        *itertools.product(["hilbert"], [np.uint8, np.uint32, np.int64]),
    ],
)
def test_every_integer_type_gives_the_same_keys(curve, kind):
    coords = np.random.default_rng(3).integers(0, 32, (20, 3))
    expected = CURVES[curve][0](coords.astype(np.int32), 21)
    np.testing.assert_array_equal(CURVES[curve][0](coords.astype(kind), 21), expected, strict=True)


@pytest.mark.parametrize(("curve", "dim"), [("morton", 2), ("hilbert", 3)])
def test_traced_coordinates_count_by_their_lowest_bits(curve, dim):
    encode = CURVES[curve][0]
    coords = np.random.default_rng(4).integers(-(2**20), 2**20, (50, dim), np.int32)
    np.testing.assert_array_equal(jax.jit(lambda c: encode(c, 4))(coords), encode(coords & 15, 4))


@pytest.mark.parametrize(("curve", "dim", "x64"), [("morton", 3, True), ("hilbert", 2, False)], indirect=["x64"])
def test_empty_arrays(curve, dim, x64):
    keys = CURVES[curve][0](np.zeros((0, dim), np.int32), 21)
    assert CURVES[curve][1](keys, dim, 21).shape == (0, dim)


BAD_KEYS = [
    (lambda: morton_encode({1, 2}), TypeError, "coords must be a JAX or NumPy array of integers, got set"),
    (lambda: hilbert_encode(np.ones((4, 3)), 3), TypeError, "got float64: number the cells first"),
    (lambda: morton_encode(np.ones((4, 3), bool)), TypeError, "got bool"),
    (lambda: morton_encode(np.ones((3, 4), int)), ValueError, r"coords must have shape \[..., 2\] or .*got shape \[3, 4\]"),
    (lambda: morton_encode(np.int32(3)), ValueError, r"got shape \[\]"),
    (lambda: hilbert_encode(np.ones(3, int), None), TypeError, "bits must be a static int .*got NoneType"),
    (lambda: hilbert_encode(np.ones(3, int), 2.0), TypeError, "bits must be a static int .*got float"),
    (lambda: hilbert_encode(np.ones(3, int), 22), ValueError, "bits must be 1 to 21 per axis in 3D, got 22"),
    (lambda: morton_encode(np.ones(2, int), 0), ValueError, "bits must be 1 to 31 per axis in 2D, got 0"),
    (lambda: morton_encode(np.array([0, -1])), ValueError, r"coords must be in \[0, 2147483648\), got values from -1 to 0: "),
    (lambda: hilbert_encode(np.array([0, 16]), 4), ValueError, "got values from 0 to 16: give more bits"),
    (lambda: morton_encode(np.array([0, 2**40])), ValueError, "got values from 0 to 1099511627776"),
    (lambda: morton_decode(np.uint32(1), 4, 3), ValueError, "dim must be 2 or 3, a static int, got 4"),
    (lambda: hilbert_decode(np.uint32(1), 2, 32), ValueError, "bits must be 1 to 31 per axis in 2D, got 32"),
    (lambda: morton_decode(np.int32(1), 2, 3), TypeError, r"keys of dim=2 and bits=3 are uint32 of shape \[...\] .*got int32"),
    (lambda: morton_decode(5, 2, 3), TypeError, "are uint32 .*got int of shape"),
    (lambda: morton_decode(np.uint32(1), 3), TypeError, "keys of dim=3 and bits=21 are uint64 .*mode on, got uint32"),
    (lambda: morton_decode(np.uint32(64), 2, 3), ValueError, r"keys must be in \[0, 64\), got values from 64 to 64: decode with"),
]


@pytest.mark.parametrize("call, error, message", BAD_KEYS)
def test_bad_coordinates_keys_and_bits_are_refused(call, error, message):
    refuses(error, message, call)


def test_wide_coordinates_are_refused_in_either_mode():
    with jax.enable_x64(False):
        for far in (2**40, 2**32 + 5):
            refuses(ValueError, r"coords must be in \[0, 2147483648\)", morton_encode, np.array([[far, 0]]))
            refuses(ValueError, "got values from 0 to", hilbert_encode, np.array([[far, 0]], np.uint64), 10)


def test_keys_of_the_other_mode_are_refused():
    wide = np.asarray(morton_encode(np.array([1, 2, 3])))
    with jax.enable_x64(False):
        refuses(TypeError, r"uint32 of shape \[..., 2\] \(high, low\) .*mode off, got uint64 of shape \[\]", morton_decode, wide, 3)
        refuses(TypeError, r"got uint32 of shape \[4\]", hilbert_decode, np.zeros(4, np.uint32), 3, 21)
        with pytest.raises(ValueError, match=r"keys must be in \[0, 2147483648\), got values from 2147483648 to"):
            hilbert_decode(np.array([2**31, 0], np.uint32), 3, 21)
        words = np.asarray(morton_encode(np.array([1, 2, 3])))
    refuses(TypeError, r"are uint64 of shape \[...\] .*mode on, got uint32 of shape \[2\]", morton_decode, words, 3)


def expected_order(cells, curve):
    """Sort cells [n, d], counted from 0, by the keys of the encoders, with NumPy and Python integers."""
    if curve == "row":
        return np.lexsort(cells.T)
    keys = CURVES[curve][0](cells, SORT_BITS)
    return np.argsort(whole(keys, cells.shape[1], SORT_BITS, jax.config.read("jax_enable_x64")), kind="stable")


def lowest_first(cells):
    return (cells - cells.min(axis=0)).astype(np.int64)


@pytest.fixture(params=["row", "morton", "hilbert"])
def any_curve(request):
    return request.param


@pytest.fixture(params=[(np.float32, 3), (np.float64, 2)], ids=["f32-3d", "f64-2d"])
def points(request):
    """Return the dtype and the dimension of positions: 400 of them, as all tests have that share programs."""
    return request.param


def filled_up(x):
    """Add positions that are not finite, which come last, to make them 400."""
    return np.concatenate([x, np.full((400 - len(x), x.shape[1]), np.nan, x.dtype)])


# How far the particles reach, in cells: keys of one word, of two, and around the limit between them.
SCENES = {"few": 8, "one_word": 900, "limit": 2**11, "limit_2d": 2**16 + 1, "two_words": 2**20}


@pytest.mark.parametrize("reach", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("shift", [0, -(2**10), 2**21])
def test_order_is_that_of_the_keys(any_curve, reach, shift, points):
    """Positions are whole multiples of an eighth: float32 holds them exactly."""
    dtype, dim = points
    rng = np.random.default_rng(5)
    cells = rng.integers(0, reach, (400, dim)) - reach // 3 + shift
    cells[1], cells[2] = cells.min(axis=0), cells.min(axis=0) + reach
    cells[200:300] = cells[:100]  # same cells, later particles
    x = (cells * 0.25 + (rng.integers(0, 2, cells.shape) / 8 if shift < 2**20 else 0)).astype(dtype)
    order = sort_order(x, 0.25, curve=any_curve)
    assert order.dtype == jnp.int32
    np.testing.assert_array_equal(order, expected_order(lowest_first(cells), any_curve))


def test_last_cell_of_one_word_comes_before_non_finite(any_curve):
    """Its low word is the one that marks particles without a cell."""
    x = np.array([[np.nan, 0], [65535, 65535], [0, 0], [0, 65535], [65535, 0], [65534, 65535]]) + 0.5
    order = np.asarray(sort_order(filled_up(x), 1.0, curve=any_curve)).tolist()[:6]
    assert order[0] == 2
    assert order[-1] == 0
    if any_curve != "hilbert":
        assert order[-2] == 1


def test_order_without_x64_is_the_same(any_curve):
    rng = np.random.default_rng(6)
    for reach in (30, 3e5):
        x = rng.uniform(-reach, reach, (400, 3)).astype(np.float32)
        wide = np.asarray(sort_order(x, 0.7, curve=any_curve))
        with jax.enable_x64(False):
            np.testing.assert_array_equal(sort_order(x, 0.7, curve=any_curve), wide, strict=True)
            cells = lowest_first(np.floor(x / np.float32(0.7)))
            np.testing.assert_array_equal(wide, expected_order(cells, any_curve))


def test_cells_are_those_of_the_rounded_quotient():
    """A product with the reciprocal rounds twice, and the reciprocal of a large cell size is flushed to 0."""
    x = (np.random.default_rng(1).normal(size=(400, 2)) * 10 + 1e5).astype(np.float32)
    far = np.array([[3e38, 0], [-3e38, 0], [1.5e38, 0], [0, 0]], np.float32)
    for points, size in ((x, 0.01), (x, 0.001), (x, 0.3), (far, 1e38)):
        cells = np.floor(points / np.float32(size))
        np.testing.assert_array_equal(sort_order(points, size, curve="row"), np.lexsort((cells[:, 0], cells[:, 1])))


@pytest.mark.parametrize("excess", [0, 1, 5])
@pytest.mark.parametrize(("any_curve", "dim"), [("row", 2), ("morton", 2), ("hilbert", 2), ("hilbert", 3)])
def test_too_many_cells_are_merged_by_the_smallest_power_of_two(any_curve, excess, dim):
    """Float64 numbers these cells exactly."""
    rng = np.random.default_rng(7)
    cells = rng.integers(0, 2 ** (SORT_BITS + excess), (400, dim))
    cells[:200, 1:] //= 2**SORT_BITS // 8  # merged cells hold many particles
    cells[0], cells[1] = 0, 2 ** (SORT_BITS + excess) - 1
    order = sort_order(cells + 0.5, 1.0, curve=any_curve)
    np.testing.assert_array_equal(order, expected_order(cells >> excess, any_curve))
    far = sort_order(np.ldexp(cells + 0.5, 900), 2.0**900, curve=any_curve)
    np.testing.assert_array_equal(far, order)


@pytest.mark.parametrize("cell_size", ["smallest", 1e-3, 1.0, "largest"])
@pytest.mark.parametrize("axis", [0, 1])
def test_any_finite_positions_keep_their_order_on_an_axis(cell_size, axis, points):
    """With one coordinate other than 0, row and Morton order are that of this coordinate, but for particles of one cell."""
    dtype, dim = points
    finfo = np.finfo(dtype)
    size = {"smallest": float(finfo.tiny), "largest": float(finfo.max)}.get(cell_size, cell_size)
    high = np.array([finfo.max, finfo.max / 3, finfo.max / 2**12, 1e30, 1e7, 1.0, 1e-30, finfo.tiny, 0.0], dtype)
    values = np.random.default_rng(8).permutation(np.concatenate([high, -high]))
    for wanted in (abs(values) >= 0, values >= 0, values <= 0, values > 1e30, abs(values) <= 1e7, values == finfo.max):
        x = np.zeros((len(values), dim), dtype)
        x[:, axis] = np.where(wanted, values, np.nan)
        kept = x[wanted, axis].astype(np.longdouble)
        edge = max(np.longdouble(size), (kept.max() - kept.min()) / 2 ** (SORT_BITS - 1))  # merged cells may be this wide
        for curve in ("row", "morton"):
            order = np.asarray(sort_order(filled_up(x), size, curve=curve))[: len(x)]
            assert sorted(order[: len(kept)].tolist()) == np.flatnonzero(wanted).tolist()
            steps = np.diff(x[order[: len(kept)], axis].astype(np.longdouble))
            assert np.all(steps > -1.1 * edge)
            if np.ptp(kept) > 2 * edge:
                places = np.argsort(order)[wanted]
                assert places[kept.argmin()] < places[kept.argmax()]


def test_small_negatives_are_in_the_cell_below_zero(any_curve, points):
    dtype, dim = points
    x = np.zeros((3, dim), dtype)
    x[:, 1] = [1e-30, -1e-30, 1e-30]
    np.testing.assert_array_equal(np.asarray(sort_order(filled_up(x), 1e30, curve=any_curve))[:3], [1, 0, 2])


def test_far_axis_does_not_merge_cells_of_the_others(any_curve, points):
    """All particles share an x so large that x / cell_size overflows."""
    dtype, dim = points
    for size in (1e-3, 4 * float(np.finfo(dtype).tiny)):
        x = (np.random.default_rng(9).uniform(1, 1000, (400, dim)) * size).astype(dtype)
        x[:, 0] = 0
        near = sort_order(x, size, curve=any_curve)
        x[:, 0] = np.finfo(dtype).max
        np.testing.assert_array_equal(sort_order(x, size, curve=any_curve), near)


def test_non_finite_positions_come_last_and_change_nothing_else(any_curve, points):
    dtype, dim = points
    rng = np.random.default_rng(10)
    for scale in (1.0, 1e6):
        x = (rng.uniform(-20, 20, (400, dim)) * scale).astype(dtype)
        bad = rng.choice(400, 40, replace=False)
        x[bad, rng.integers(0, dim, 40)] = rng.choice([np.nan, np.inf, -np.inf], 40)
        order = np.asarray(sort_order(x, 1.0, curve=any_curve))
        np.testing.assert_array_equal(order[360:], np.sort(bad))
        kept = np.setdiff1d(np.arange(400), bad)
        np.testing.assert_array_equal(np.sort(order[:360]), kept)
        padded = np.concatenate([x[kept], x[kept[:40]]])  # whose order is that of the finite ones, with 40 twins
        twins = np.asarray(sort_order(padded, 1.0, curve=any_curve))
        np.testing.assert_array_equal(order[:360], kept[twins[twins < 360]])


@pytest.mark.parametrize(("any_curve", "n"), [("row", 0), ("morton", 1), ("hilbert", 0), ("hilbert", 5)])
def test_few_and_equal_positions_keep_their_order(any_curve, n):
    for fill in (0, -3e5, np.nan):
        x = np.full((n, 3), fill, np.float32)
        np.testing.assert_array_equal(sort_order(x, 0.1, curve=any_curve), np.arange(n))


@pytest.mark.parametrize("any_curve", ["row", "hilbert"])
def test_jit_and_vmap_order_as_eager_does(any_curve):
    rng = np.random.default_rng(11)
    x = (rng.uniform(-1, 1, (3, 400, 3)) * np.array([1, 1e3, 1e7])[:, None, None]).astype(np.float32)
    traces = []

    def order(x):
        traces.append(x)
        return sort_order(x, 0.3, curve=any_curve)

    eager = np.stack([sort_order(part, 0.3, curve=any_curve) for part in x])
    jitted = jax.jit(order)
    for k in range(3):
        np.testing.assert_array_equal(jitted(x[k]), eager[k], strict=True)
    assert len(traces) == 1
    np.testing.assert_array_equal(jax.vmap(order)(x), eager, strict=True)


@pytest.mark.parametrize("dim", [slow(2), 3])
def test_curves_bring_neighbors_together(dim):
    """Mean distance of particles that follow each other: Hilbert below Morton below a tenth of the input order."""
    x = np.random.default_rng(12).uniform(0, 1, (20_000, dim))
    edge = 20_000 ** (-1 / dim)

    def step(order):
        return float(np.mean(np.linalg.norm(np.diff(x[np.asarray(order)], axis=0), axis=1)))

    steps = {curve: step(sort_order(x, edge, curve=curve)) for curve in ("row", "morton", "hilbert")}
    assert steps["hilbert"] < steps["morton"] < 0.1 * step(np.arange(len(x)))
    assert steps["hilbert"] < 2 * edge


BAD_SORTS = [
    ((np.zeros((3, 3), int), 1.0), {}, TypeError, "positions must be float32 or float64, got int64"),
    ((np.zeros((3, 4)), 1.0), {}, ValueError, r"positions must have shape \[n, 2\] or \[n, 3\]"),
    ((np.zeros((3, 3)), "1"), {}, TypeError, r"cell_size must be one number, got str of shape \[\]"),
    ((np.zeros((3, 3)), True), {}, TypeError, "cell_size must be one number, got bool"),
    ((np.zeros((3, 3)), np.ones(3)), {}, TypeError, r"cell_size must be one number, got ndarray of shape \[3\]"),
    ((np.zeros((3, 3)), np.complex64(1 + 2j)), {}, TypeError, "cell_size must be one number, got complex64"),
    ((np.zeros((3, 3)), np.bool_(True)), {}, TypeError, "cell_size must be one number, got bool"),
    ((np.zeros((3, 3)), 0.0), {}, ValueError, "cell_size must be positive, finite and a normal float64 .*got 0.0"),
    ((np.zeros((3, 3)), -1), {}, ValueError, "cell_size must be positive, .*got -1.0"),
    ((np.zeros((3, 3)), np.nan), {}, ValueError, "cell_size must be positive, .*got nan"),
    ((np.zeros((3, 3), np.float32), 1e40), {}, ValueError, r"a normal float32 \[1.2e-38, 3.4e\+38\], got 1e\+40"),
    ((np.zeros((3, 3)), 1.0), {"curve": "peano"}, ValueError, "curve must be one of 'row', 'morton', 'hilbert', got 'peano'"),
    ((np.zeros((3, 3)), 1.0), {"curve": None}, ValueError, "curve must be one of .*got None"),
]


@pytest.mark.parametrize("arguments, options, error, message", BAD_SORTS)
def test_bad_arguments_of_a_sort_are_refused(arguments, options, error, message):
    refuses(error, message, sort_order, *arguments, **options)


def test_traced_cell_size_is_refused():
    refuses(TypeError, "cell_size must be a static number, got a traced value", jax.jit(sort_order), jnp.zeros((3, 2)), 1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_order_for_a_tree(dim):
    """By system, then by class, then along a curve; what is not finite comes last, and far points do no harm to the others."""
    random, n = np.random.default_rng(3), 600
    points = random.random((n, dim)).astype(np.float32)
    points[0], points[1], points[2, 0], points[3, 1] = 3e38, -3e38, np.nan, np.inf
    classes, systems = random.integers(0, CLASSES, n).astype(np.uint32), random.choice(np.array([0, 7, 2**32 - 1], np.uint32), n)
    order = np.asarray(order_for_tree(jnp.asarray(points), jnp.asarray(classes), jnp.asarray(systems)))
    assert np.array_equal(np.sort(order), np.arange(n))
    assert set(order[-2:].tolist()) == {2, 3}
    keys = CLASSES * systems[order[:-2]].astype(int) + classes[order[:-2]]
    assert np.all(np.diff(keys) >= 0)
    near = np.asarray(order_for_tree(jnp.asarray(points[4:]), None, None))
    steps = np.linalg.norm(np.diff(points[4:][near], axis=0), axis=1)
    assert steps.max() < 6 * (n - 4) ** (-1 / dim)  # a curve without jumps
