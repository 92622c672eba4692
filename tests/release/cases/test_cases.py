import math
from itertools import pairwise

import numpy as np
import pytest
from checked import refuses
from scipy.spatial import KDTree

from jfrnn import cases

SITES = {3: (50, 100, 50), 2: (50, 100)}
SIZED = [name for name in cases.LAYOUTS if name != "full"]
ON_SITES = ["full", "clusters2", "clusters7", "corners", "diagonal", "sheet", "filament"]
DRAWN = ["random", "jitter", "clump"]


def site_indices(scene):
    """Lattice sites [n, d], after checking that every position is one."""
    sites = np.rint(scene.positions / scene.spacing).astype(int)
    assert np.array_equal(scene.positions, sites * scene.spacing)
    return sites


def occupied(sites, n):
    mask = np.zeros(n, bool)
    mask[tuple(sites.T)] = True
    return mask


def runs(marks):
    """Start and length of every run of True in a 1D mask."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marks.astype(int), [0]])))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


@pytest.mark.parametrize(
    ("name", "fill", "points"),
    [
        ("full", None, 250_000),
        *[(f"clusters{n}", 0.11, 27_648) for n in (2, 4, 6)],
        *[(f"clusters{n}", 0.51, 128_000) for n in (5, 10, 20)],
        ("corners", 0.02, 7_200),
        ("corners", 0.11, 28_158),
        ("corners", 0.14, 37_044),
        ("diagonal", 0.11, 29_168),
        *((f"{kind}{tiles}", 0.11, 27_648) for kind in ("turned", "tumbled", "cut", "grown") for tiles in (2, 4, 6)),
    ],
)
def test_points_of_the_thesis(name, fill, points):
    scene = cases.scene(name, fill=fill)
    if (name, fill) not in (("corners", 0.02), ("corners", 0.14)):
        assert np.array_equal(scene.positions, cases.scene(name).positions)  # what the thesis has is the default
    assert scene.positions.shape == (points, 3)
    assert scene.fill == points / 250_000
    assert len(np.unique(scene.positions, axis=0)) == points
    assert scene.lengths == (0.005, 0.01, 0.005)
    assert scene.cutoff == 3.0 * 1e-4


@pytest.mark.parametrize("spacing", [1e-4, 2e-4, 5e-5, 3e-5])
def test_full_resolves_the_same_domain(spacing):
    scene = cases.scene("full", spacing=spacing, dim=2, dtype="float64")
    n = (round(0.005 / spacing), round(0.01 / spacing))
    expected = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    assert np.array_equal(scene.positions, expected)
    assert scene.lengths == (0.005, 0.01)
    assert scene.fill == 1.0
    assert scene.spacing == spacing
    assert (scene.positions.max(axis=0) < scene.lengths).all()


@pytest.mark.parametrize(("n", "size", "fill"), [(2, 12, 0.11), (4, 6, 0.11), (6, 4, 0.11), (5, 8, 0.51), (10, 4, 0.51)])
def test_clusters_are_boxes_inside_their_tiles(n, size, fill):
    sites = site_indices(cases.scene(f"clusters{n}", fill=fill, dtype="float64"))
    for axis, (total, edge) in enumerate(zip(SITES[3], (size, 2 * size, size), strict=True)):
        found = runs(np.bincount(sites[:, axis], minlength=total) > 0)
        assert [length for _, length in found] == [edge] * n
        for tile, (start, length) in enumerate(found):
            assert start >= math.floor(tile * total / n)
            assert start + length <= math.floor((tile + 1) * total / n)
            assert abs(start + length / 2 - (tile + 0.5) * total / n) <= 1
        assert all(b - (a + edge) >= 1 for (a, _), (b, _) in pairwise(found))
    assert len(sites) == (n * size) ** 2 * 2 * n * size


def test_twenty_clusters_touch_in_pairs():
    sites = site_indices(cases.scene("clusters20", dtype="float64"))
    assert runs(np.bincount(sites[:, 0], minlength=50) > 0) == [(5 * k, 4) for k in range(10)]
    assert [length for _, length in runs(np.bincount(sites[:, 1]) > 0)] == [4] * 20


@pytest.mark.parametrize("n", [1, 3, 7, 13, 50])
@pytest.mark.parametrize("fill", [0.0001, 0.03, 0.26, 0.75, 0.97, 1.0])
def test_any_clusters_hold_what_they_say(n, fill):
    sites = site_indices(cases.scene(f"clusters{n}", fill=fill, dtype="float64"))
    expected = [max(n, math.floor(fill ** (1 / 3) * total + 0.5)) for total in SITES[3]]
    assert [len(np.unique(sites[:, axis])) for axis in range(3)] == expected
    assert len(sites) == math.prod(expected)
    for axis, total in enumerate(SITES[3]):
        tile = (np.arange(total)[:, None] >= np.arange(1, n) * total // n).sum(axis=1)
        held = np.bincount(tile[np.unique(sites[:, axis])], minlength=n)
        assert held.min() >= 1
        assert held.max() - held.min() <= 1


@pytest.mark.parametrize(("fill", "a", "b"), [(0.02, 12, 25), (0.11, 19, 39), (0.14, 21, 42)])
def test_corners_touch_opposite_corners(fill, a, b):
    mask = occupied(site_indices(cases.scene("corners", fill=fill, dtype="float64")), SITES[3])
    expected = np.zeros_like(mask)
    expected[:a, :b, :a] = expected[-a:, -b:, -a:] = True
    assert np.array_equal(mask, expected)


@pytest.mark.parametrize("fill", [0.3, 0.6, 0.95])
def test_large_corners_overlap_and_are_counted_once(fill):
    scene = cases.scene("corners", fill=fill, dtype="float64")
    mask = occupied(site_indices(scene), SITES[3])
    assert mask.sum() == scene.n
    assert mask[[0, -1, 25], [0, -1, 50], [0, -1, 25]].all()
    assert not mask[[0, -1], [-1, 0], [0, -1]].any()
    assert np.array_equal(mask, mask[::-1, ::-1, ::-1])


def test_diagonal_follows_its_formula():
    i, j, k = np.indices(SITES[3])
    depth = np.minimum(i, 49 - i) + np.minimum(j, 99 - j) + np.minimum(k, 49 - k)
    mask = occupied(site_indices(cases.scene("diagonal", dtype="float64")), SITES[3])
    assert np.array_equal(mask, depth < 27)
    assert (depth < 26).sum() < 0.11 * 250_000 <= mask.sum()
    assert cases.scene("diagonal", fill=mask.mean()).n == mask.sum()  # a full shell is not followed by the next


def test_filament_is_a_thread_between_opposite_corners():
    scene = cases.scene("filament", fill=0.005, dtype="float64")
    axis = np.array([49, 99, 49]) / np.linalg.norm([49, 99, 49])
    sites = np.argwhere(np.ones(SITES[3], bool))
    distance = np.linalg.norm(np.cross(sites - 0.0, axis), axis=1)
    mask = occupied(site_indices(scene), SITES[3]).ravel()
    assert distance[mask].max() < 2.1
    assert distance[mask].max() < distance[~mask].min() + 1e-9
    assert mask[[0, -1]].all()
    assert 1250 <= scene.n < 1300


@pytest.mark.parametrize(("fill", "layers"), [(0.001, 1), (0.02, 1), (0.11, 6), (0.5, 25)])
def test_sheet_is_thin(fill, layers):
    sites = site_indices(cases.scene("sheet", fill=fill, dtype="float64"))
    assert len(sites) == layers * 5000
    assert np.ptp(sites, axis=0).tolist() == [layers - 1, 99, 49]
    assert abs(sites[:, 0].mean() - 24.5) <= 0.5


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("n", "separation"), [(2, 5.0), (7, 2.5), (432, 40.0), (301, 1e4)])
def test_blobs_are_their_separation_apart(dim, n, separation):
    scene = cases.scene("two-blobs", n=n, separation=separation, dim=dim, dtype="float64")
    first, second = np.split(scene.positions, [n - n // 2])
    gaps = np.linalg.norm(first[:, None] - second[None], axis=-1)
    assert gaps.min() == pytest.approx(separation * scene.cutoff, rel=1e-12)
    side = math.ceil((n - n // 2) ** (1 / dim))
    for blob in (first, second):
        assert np.ptp(blob, axis=0).max() <= (side - 1 + 1e-6) * scene.spacing
        assert len(np.unique(np.rint((blob - blob.min(axis=0)) / scene.spacing), axis=0)) == len(blob)
    assert scene.positions.min() == 0.0
    assert scene.lengths == pytest.approx(scene.positions.max(axis=0) + scene.spacing)
    assert scene.fill == n / math.prod(SITES[dim])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("density", [4.0, 50.0])
def test_clump_is_a_ball_of_its_density(dim, density):
    scene = cases.scene("clump", n=4000, density=density, dim=dim, dtype="float64", spacing=5e-5)
    distance = np.linalg.norm(scene.positions - np.array(scene.lengths) / 2, axis=1)
    ball = math.pi if dim == 2 else 4 / 3 * math.pi
    radius = scene.spacing * (4000 / density / ball) ** (1 / dim)
    assert 0.99 * radius < distance.max() <= radius * (1 + 1e-12)
    assert (distance < radius / 2).mean() == pytest.approx(0.5**dim, abs=0.03)
    assert np.abs(scene.positions.mean(axis=0) - np.array(scene.lengths) / 2).max() < 0.05 * radius


@pytest.mark.parametrize("dim", [2, 3])
def test_random_is_uniform_in_the_domain(dim):
    scene = cases.scene("random", n=4096, dim=dim, dtype="float64")
    unit = scene.positions / np.array(scene.lengths)
    assert 0 <= unit.min() < unit.max() < 1
    for axis in range(dim):
        assert np.histogram(unit[:, axis], 8, (0, 1))[0] == pytest.approx(512, abs=110)
    assert np.abs(np.corrcoef(unit.T) - np.eye(dim)).max() < 0.08


@pytest.mark.parametrize("amplitude", [0.1, 1.0])
def test_jitter_stays_in_the_cell_of_its_site(amplitude):
    scene = cases.scene("jitter", fill=0.3, amplitude=amplitude, dtype="float64")
    base = site_indices(cases.scene("clusters1", fill=0.3, dtype="float64"))
    moved = scene.positions / scene.spacing - base
    assert moved.min() >= -1e-9
    assert 0.99 * amplitude < moved.max() <= amplitude + 1e-9
    assert np.abs(moved.mean(axis=0) - amplitude / 2).max() < 0.02 * amplitude


@pytest.mark.parametrize("spacing", [3e-4, 3.1e-3, 1.37e-4])
def test_jitter_keeps_to_a_domain_that_is_no_multiple_of_the_spacing(spacing):
    scene = cases.scene("jitter", spacing=spacing, fill=0.9, amplitude=1.0, dtype="float64", dim=2)
    assert (scene.positions >= 0).all() and (scene.positions <= scene.lengths).all()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", SIZED)
def test_more_fill_is_more_points_and_close_to_it(name, dim):
    fills = np.linspace(0.02, 1.0, 20)
    reached = np.array([cases.scene(name, fill=fill, dim=dim).fill for fill in fills])
    assert (np.diff(reached) >= 0).all()
    assert reached[0] < reached[-1] == 1.0
    half_layers = 0.5 * sum(1 / n for n in SITES[dim])
    excess = reached - fills
    if name in ("random", "two-blobs", "clump"):
        assert np.abs(excess).max() <= 0.5 / math.prod(SITES[dim]) + 1e-12
    elif name in ("diagonal", "filament"):
        assert excess.min() > -1e-12
        assert excess.max() < 0.03
    elif name == "corners":
        assert np.abs(excess).max() <= 2 * half_layers + 0.01
    else:
        above = fills >= (0.16 if name == "clusters20" else 0)  # 20 clusters of one site each are the least
        assert np.abs(excess[above]).max() <= half_layers


@pytest.mark.parametrize("fill", [0.005, 0.03, 0.11, 0.4, 0.8])
@pytest.mark.parametrize("name", ["clusters3", "corners", "diagonal", "sheet", "filament", "jitter"])
def test_a_finer_lattice_comes_closer_to_the_fill(name, fill):
    target = fill + (1 - fill) ** 2 * min(0.01, 25 * fill**2) * (name == "corners")
    assert abs(cases.scene(name, fill=fill, dim=2, spacing=1e-5).fill - target) < 0.004


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", SIZED)
def test_the_smallest_fill_still_has_points(name, dim):
    scene = cases.scene(name, fill=1e-9, dim=dim)
    assert 1 <= scene.n <= (20**dim if name.startswith("clusters") else 5000)
    assert scene.fill == scene.n / math.prod(SITES[dim])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", [*cases.LAYOUTS, "clusters7"])
def test_rounded_once_from_float64(name, dim):
    single, double = (cases.scene(name, dim=dim, dtype=dtype) for dtype in ("float32", np.float64))
    assert single.positions.shape == (single.n, dim)
    assert len(single.lengths) == len(single.origin) == single.dim == dim
    assert single.fill == single.n / math.prod(SITES[dim])
    assert single.positions.dtype == np.float32
    assert double.positions.dtype == np.float64
    assert np.array_equal(single.positions, double.positions.astype(np.float32))
    assert np.array_equal(single.exact, double.positions)
    assert np.isfinite(double.positions).all()
    assert (double.positions >= 0).all()
    assert (double.positions <= double.lengths).all()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", ON_SITES)
def test_sites_come_in_lexicographic_order(name, dim):
    sites = site_indices(cases.scene(name, dim=dim, dtype="float64"))
    assert (np.diff(np.ravel_multi_index(tuple(sites.T), SITES[dim])) > 0).all()


@pytest.mark.parametrize("name", cases.LAYOUTS)
def test_the_seed_decides_what_is_drawn(name):
    first, again, other = (cases.scene(name, dim=2, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.positions, again.positions)
    assert np.array_equal(first.positions, other.positions) is (name not in DRAWN)


def test_spacing_scales_constructions_with_the_lattice():
    coarse = cases.scene("corners", fill=0.02, spacing=2e-4, dtype="float64")
    assert site_indices(coarse).max(axis=0).tolist() == [24, 49, 24]
    assert coarse.n == 2 * 6 * 12 * 6
    assert coarse.cutoff == pytest.approx(6e-4)
    assert cases.scene("clusters2", fill=0.11, spacing=5e-5).n == 8 * 24 * 48 * 24
    single = cases.scene("clusters2", spacing=np.float32(2e-4), cutoff_ratio=2.7)
    assert float(single.cutoff) == 2.7 * float(np.float32(2e-4))


def test_shuffle_permutes_and_repeats():
    scene = cases.scene("corners", fill=0.01)
    mixed, again, other = (cases.shuffle(scene, seed) for seed in (1, 1, 2))
    assert np.array_equal(mixed.positions, again.positions)
    assert not np.array_equal(mixed.positions, scene.positions)
    assert not np.array_equal(mixed.positions, other.positions)
    order = np.lexsort(mixed.positions.T[::-1])
    assert np.array_equal(mixed.positions[order], scene.positions)
    assert np.array_equal(mixed.exact.astype(np.float32), mixed.positions)
    assert (mixed.cutoff, mixed.fill, mixed.name) == (scene.cutoff, scene.fill, scene.name)
    refuses(ValueError, r"seed must lie in \[0, 2147483647\], got -2", cases.shuffle, scene, -2)


@pytest.mark.parametrize("offset", [1000.0, (-3.0, 0.0, 17.5)])
def test_moved_is_rounded_once(offset):
    scene = cases.scene("random", n=500)
    assert scene.exact is not None
    moved = scene.moved(offset, scale=1e4)
    assert moved.positions.dtype == np.float32
    assert np.array_equal(moved.positions, (1e4 * scene.exact + np.array(offset)).astype(np.float32))
    assert moved.cutoff == pytest.approx(3.0)
    assert moved.spacing == pytest.approx(1.0)
    assert moved.lengths == pytest.approx((50.0, 100.0, 50.0))
    assert moved.origin == pytest.approx(tuple(np.broadcast_to(offset, 3)))
    back = moved.moved(offset=-np.array(offset)).moved(scale=1e-4)
    assert np.allclose(back.positions, scene.positions, rtol=0, atol=1e-9)
    assert np.array_equal(scene.moved().positions, scene.positions)


def test_a_scene_can_be_built_by_hand():
    positions = np.array([[0.1, 0.2], [0.3, 0.4]], np.float32)
    scene = cases.Scene("pair", positions, 0.5, 0.1, (1.0, 1.0), 0.02)
    assert scene.origin == (0.0, 0.0)
    assert np.array_equal(scene.moved(1.0).positions, (positions.astype(np.float64) + 1).astype(np.float32))
    assert np.array_equal(np.sort(cases.shuffle(scene).positions, axis=0), positions)


def test_layout_functions_give_the_positions_of_their_scene():
    domain = cases.Domain(dim=2)
    assert (domain.sites, domain.size) == ((50, 100), 5000)
    for function in (cases.full, cases.corners, cases.diagonal, cases.random, cases.jitter, cases.clump, cases.sheet):
        expected = cases.scene(function.__name__, dim=2, dtype="float64").positions
        assert np.array_equal(function(domain), expected), function
    clusters, blobs = (cases.scene(name, dim=2, fill=0.3, dtype="float64") for name in ("clusters4", "two-blobs"))
    assert np.array_equal(cases.clusters(domain, 4, fill=0.3), clusters.positions)
    assert np.array_equal(cases.two_blobs(domain, fill=0.3), blobs.positions)
    assert np.array_equal(cases.filament(domain), cases.scene("filament", dim=2, dtype="float64").positions)


@pytest.mark.parametrize(
    ("name", "options", "error", "match"),
    [
        ("ful", {}, ValueError, "name must be a known layout, got 'ful': take one of full, clusters2,.*filament"),
        ("clusters0", {}, ValueError, "got 'clusters0'"),
        (3, {}, ValueError, "known layout, got 3"),
        ("clusters51", {}, ValueError, "tiles must not exceed the 50 lattice sites.*got 51: take fewer"),
        ("full", {"fill": 0.5}, ValueError, "fill must be 1 for the layout 'full', got 0.5"),
        ("corners", {"fill": 11}, ValueError, "got 11: pass a share such as 0.11"),
        ("random", {"fill": float("nan")}, ValueError, r"fill must lie in \(0, 1\], got nan"),
        ("sheet", {"fill": "0.1"}, TypeError, "fill must be a number, got '0.1' of type str"),
        ("full", {"spacing": 0.0}, ValueError, "spacing must be finite and above 0, got 0.0"),
        ("full", {"spacing": True}, TypeError, "spacing must be a number, got True of type bool"),
        ("full", {"spacing": 1.0}, ValueError, "spacing must not exceed the shortest side.*0.005 m, got 1.0"),
        ("full", {"spacing": 1e-6}, ValueError, "250000000000 lattice sites.*pass a spacing above 4.88e-06 m"),
        ("full", {"cutoff_ratio": -3}, ValueError, "cutoff_ratio must be finite and above 0, got -3"),
        ("full", {"dim": 1}, ValueError, r"dim must lie in \[2, 3\], got 1"),
        ("full", {"dim": 2.0}, TypeError, "dim must be an integer, got 2.0 of type float"),
        ("full", {"dtype": "int32"}, ValueError, "dtype must be float32 or float64, got 'int32'"),
        ("full", {"dtype": "single precision"}, ValueError, "dtype must be float32 or float64, got 'single"),
        ("full", {"dtype": None}, ValueError, "dtype must be float32 or float64, got None"),
        ("full", {"seed": -1}, ValueError, r"seed must lie in \[0, 2147483647\], got -1"),
        ("full", {"n": 5}, ValueError, "n=5 is not an argument of the layout 'full', which takes fill: drop it"),
        ("random", {"density": 2.0}, ValueError, "'random', which takes fill, n, seed"),
        ("random", {"fill": 0.1, "n": 5}, ValueError, "fill=0.1 and n=5 both set the number of points"),
        ("random", {"n": 0}, ValueError, r"n must lie in \[1, 2147483647\], got 0"),
        ("random", {"n": True}, TypeError, "n must be an integer, got True of type bool"),
        ("two-blobs", {"n": 1}, ValueError, r"n must lie in \[2, 2147483647\], got 1"),
        ("two-blobs", {"separation": 0.0}, ValueError, "separation must be finite and above 0, got 0.0"),
        ("jitter", {"amplitude": 1.5}, ValueError, r"amplitude must lie in \(0, 1\], got 1.5"),
        ("clump", {"density": -1.0}, ValueError, "density must be finite and above 0, got -1.0"),
        ("clump", {"fill": 0.9, "density": 1.0}, ValueError, "more than half the shortest side.*raise density"),
        ("turned4", {"fill": 0.3}, ValueError, r"fill=0.3 makes cubes of 8 sites .* of 12.5 sites: take 0.11 at most, or fewer"),
        ("turned4", {"angle": float("nan")}, ValueError, "angle must be finite, got nan"),
        ("tumbled4", {"angle": 3.0}, ValueError, "angle=3.0 is not an argument of .*'tumbled4', which takes fill, seed: drop it"),
        ("grown4", {"growth": 0.5}, ValueError, "growth must be at least 1, got 0.5"),
        ("turnedN", {}, ValueError, "name must be a known layout, got 'turnedN': .* clustersN, turnedN, tumbledN, cutN, grownN"),
    ],
)
def test_scene_says_what_is_wrong(name, options, error, match):
    refuses(error, match, cases.scene, name, **options)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"scale": 0.0}, ValueError, "scale must be finite and above 0, got 0.0"),
        ({"scale": "2"}, TypeError, "scale must be a number, got '2'"),
        ({"offset": (1.0, 2.0)}, ValueError, r"one per axis, shape \[3\], got shape \[2\]"),
        ({"offset": float("nan")}, ValueError, "offset must be finite, got nan"),
        ({"scale": 1e45}, ValueError, "scale=1e\\+45 leaves the range of float32: pass smaller"),
    ],
)
def test_moved_says_what_is_wrong(options, error, match):
    refuses(error, match, cases.scene("corners", fill=0.001).moved, **options)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"positions": np.zeros((2, 2), int)}, "dtype of positions must be float32 or float64"),
        ({"positions": np.zeros(3)}, r"positions must have shape \[n, d\], got \[3\]"),
        ({"lengths": (1.0,)}, "lengths must have one entry per axis, 2, got 1"),
        ({"origin": (0.0, 0.0, 0.0)}, "origin must have one entry per axis, 2, got 3"),
        ({"exact": np.zeros((3, 2))}, r"exact must have the shape of positions, \[2, 2\], got \[3, 2\]"),
    ],
)
def test_a_scene_by_hand_says_what_is_wrong(changes, match):
    fields = {"positions": np.zeros((2, 2)), "cutoff": 0.5, "spacing": 0.1, "lengths": (1.0, 1.0), "fill": 0.1}
    refuses(ValueError, match, cases.Scene, "pair", **fields | changes)


DOMAIN = cases.Domain()


def pairs_at(positions, radius):
    return len(KDTree(positions).query_pairs(radius, output_type="ndarray"))


@pytest.mark.parametrize("angle", [0.0, 10.0, 45.0, 90.0])
def test_turned_cubes_keep_their_pairs(angle):
    straight, turned = cases.turned(DOMAIN, 4, angle=0.0), cases.turned(DOMAIN, 4, angle=angle)
    radius = 3.05 * DOMAIN.spacing  # between the distances of lattice sites: no ties
    assert pairs_at(turned, radius) == pairs_at(straight, radius)
    assert (turned >= 0).all()
    assert (turned <= DOMAIN.lengths).all()
    middle = turned.reshape(128, 216, 3).mean(axis=1)
    assert np.allclose(middle, straight.reshape(128, 216, 3).mean(axis=1), atol=1e-12)
    edges = np.linalg.norm(np.diff(turned.reshape(128, 6, 6, 6, 3), axis=1), axis=-1)
    assert np.allclose(edges, DOMAIN.spacing)
    direction = np.diff(turned.reshape(128, 6, 6, 6, 3), axis=1)[0, 0, 0, 0] / DOMAIN.spacing
    assert np.allclose(direction, [math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0], atol=1e-9)


def test_tumbled_cubes_are_each_turned_their_own_way():
    tumbled = cases.tumbled(DOMAIN, 4, seed=3)
    assert pairs_at(tumbled, 3.05e-4) == pairs_at(cases.turned(DOMAIN, 4, angle=0.0), 3.05e-4)
    cubes = tumbled.reshape(128, 6, 6, 6, 3) / DOMAIN.spacing
    frames = np.stack([cubes[:, 1, 0, 0], cubes[:, 0, 1, 0], cubes[:, 0, 0, 1]], axis=2) - cubes[:, 0, 0, 0][:, :, None]
    assert np.allclose(frames.transpose(0, 2, 1) @ frames, np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(frames), 1.0)
    assert np.abs(frames.mean(axis=0)).max() < 0.25  # no direction is preferred
    assert np.array_equal(tumbled, cases.tumbled(DOMAIN, 4, seed=3))
    assert not np.array_equal(tumbled, cases.tumbled(DOMAIN, 4, seed=4))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0])
def test_cut_keeps_the_lattice_and_the_number(dim, angle):
    domain = cases.Domain(dim=dim)
    cut = cases.cut(domain, 2, angle=angle)
    sites = np.rint(cut / domain.spacing).astype(int)
    assert np.array_equal(cut, sites * domain.spacing)
    assert (sites >= 0).all()
    assert (sites < domain.sites).all()
    assert len(np.unique(sites, axis=0)) == len(cut) == len(cases.turned(domain, 2))
    clusters = sites.reshape(2 * 4 * 2 ** (dim - 2), -1, dim)
    assert np.array_equal(clusters[0] - clusters[0].min(axis=0), clusters[-1] - clusters[-1].min(axis=0))
    extent = np.ptp(clusters[0], axis=0) + 1
    side = round(clusters.shape[1] ** (1 / dim))
    assert (extent[:2] == side).all() if angle == 0 else (extent[:2] > side).all()


@pytest.mark.parametrize("growth", [1.0, 10.0, 1e6])
def test_grown_draws_the_cubes_apart(growth):
    scene = cases.scene("grown4", growth=growth, dtype="float64")
    assert scene.n == 27_648
    assert scene.fill == pytest.approx(27_648 / 250_000 / growth)
    assert pairs_at(scene.positions, 3.05e-4) == pairs_at(cases.turned(DOMAIN, 4, angle=0.0), 3.05e-4)
    middle = scene.positions.reshape(128, 216, 3).mean(axis=1)
    assert np.ptp(middle, axis=0) == pytest.approx(growth ** (1 / 3) * np.array([3 / 4, 7 / 8, 3 / 4]) * DOMAIN.lengths)
