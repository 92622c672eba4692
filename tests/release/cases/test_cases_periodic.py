"""The periodic cases have the properties that they claim, by the oracle."""

import dataclasses
import functools
from collections import Counter
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from checked import slow
from reference import reference_images

from jfrnn.cases.periodic import PERIODIC_CASES

DTYPES = (np.float32, np.float64)
DIMS = (2, 3)
BUILDS = list(product(DTYPES, DIMS))
OFTEN = [*BUILDS[1:3], *(slow(*each) for each in BUILDS[::3])]  # either width, either dimension
ULP_CASES = [name for name in PERIODIC_CASES if name.startswith("ulp_")]
TIE_CASES = [name for name in PERIODIC_CASES if name.startswith("ties_")]
EMPTY = {"alone_wide", "n_0", "n_1", "queries_none_in_reach", "queries_beside_slab", "no_queries", "no_sources"}
UNCROSSED = EMPTY | {"periodic_none", "skewed_open", "blob_at_origin", "blobs_one_axis"}  # no pair through a face
ONLY_TIES = {"alone_at_the_cutoff"}


@functools.lru_cache(maxsize=256)
def built(name, dtype, dim):
    return PERIODIC_CASES[name].build(dtype, dim)


@functools.lru_cache(maxsize=64)
def images_of(name, dtype, dim, closed=False):
    return images(built(name, dtype, dim), closed=closed)


def images(given, cutoff=None, **options):
    options = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries} | options
    return reference_images(given.positions, given.cutoff if cutoff is None else cutoff, **options)


def crossing(found):
    return {(i, j, shift) for i, j, shift in found if any(shift)}


def rows_of(given):
    return given.matrix if given.matrix.ndim == 2 else np.diag(given.matrix)


def cells_of(given):
    """Positions in units of the lattice vectors, in float64: good to judge where a case puts its points."""
    return np.linalg.solve(rows_of(given).T.astype(float), given.positions.T.astype(float)).T


def float_steps(value, dtype, steps):
    """The float so many floats above a value of that dtype."""
    for _ in range(abs(steps)):
        value = np.nextafter(dtype(value), dtype(np.inf if steps > 0 else 0))
    return float(value)


def exact_squared(given, image):
    (i, j, shift), asking = image, given.positions if given.queries is None else given.queries
    ends = zip(asking[i].tolist(), given.positions[j].tolist(), rows_of(given).T.tolist(), strict=True)
    moved = ((Fraction(b) - Fraction(a), zip(shift, column, strict=True)) for a, b, column in ends)
    return sum((apart + sum(s * Fraction(x) for s, x in steps)) ** 2 for apart, steps in moved)


# Every case


@pytest.mark.parametrize("builds", [BUILDS[1:3], slow(BUILDS[::3])], ids=["often", "rarely"])
@pytest.mark.parametrize("name", PERIODIC_CASES)
def test_case_has_the_pairs_it_is_about(name, builds):
    for dtype, dim in builds:
        found = images_of(name, dtype, dim, closed=True)
        given = built(name, dtype, dim)
        radius = Fraction(dtype(given.cutoff).item())
        assert bool(found) == (name not in EMPTY)
        assert any(exact_squared(given, image) < radius**2 for image in found) == (name not in EMPTY | ONLY_TIES)
        assert max(Counter(i for i, _, _ in found).values(), default=0) <= 400
        open_in_2d = name == "periodic_z" and dim == 2
        if name != "n_2":  # where two particles happen to be
            assert bool(crossing(found)) == (name not in UNCROSSED and not open_in_2d)


# Where the points are


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_open_axes_reach_beyond_the_box(dtype, dim):
    for letters in ("x", "y", "z", "xy", "xz", "yz", "none"):
        name = f"periodic_{letters}"
        given = built(name, dtype, dim)
        assert given.periodic == tuple(letter in letters for letter in "xyz")[:dim]
        cells = cells_of(given)
        for axis, periodic in enumerate(given.periodic):
            assert (cells[:, axis].min() < -0.3 and cells[:, axis].max() > 1.3) != periodic
        if not all(given.periodic):  # xy is all in 2D
            wrapped = images(given, periodic=(True,) * dim)
            assert len(wrapped) > 1.05 * len(images_of(name, dtype, dim))


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_points_lie_outside_as_far_as_said(dtype, dim):
    for name, low, high in (
        ("outside", -5, 6),
        ("outside_100", -100, 101),
        ("outside_negative", -3, 0),
        ("outside_all_by_100", 100, 101),
        ("outside_all_by_-100", -100, -99),
        ("outside_small_box", -5, 6),
        ("outside_skewed", -3, 4),
        ("outside_skewed_100", -100, 101),
        ("astride", -0.25, 1.25),
    ):
        cells = cells_of(built(name, dtype, dim))
        margin = 0.1 * (high - low) + 1e-3
        assert low - 1e-3 <= cells.min() < low + margin and high - margin < cells.max() <= high + 1e-3
    for name in ("outside_100", "outside_skewed_100"):
        assert max(abs(s) for _, _, shift in images_of(name, dtype, dim) for s in shift) > 127  # beyond int8


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_points_on_faces(dtype, dim):
    for name in ("faces", "faces_just_below_zero", "faces_denormal"):
        given = built(name, dtype, dim)
        for axis, length in enumerate(given.matrix):
            x = given.positions[:, axis]
            for at in (length, -length, 2 * length):
                for value in (at, np.nextafter(at, dtype(-np.inf)), np.nextafter(at, dtype(np.inf))):
                    assert value in x
            assert (x == 0).sum() == 2 and np.signbit(x[x == 0]).sum() == 1
            if name == "faces_just_below_zero":
                assert (np.mod(x, length) == length).any()
            if name == "faces_denormal":
                assert {*(x[(x != 0) & (np.abs(x) < np.finfo(dtype).tiny)] > 0).tolist()} == {False, True}
    given = built("corners", dtype, dim)
    assert len(given.positions) == len(np.unique(given.positions, axis=0)) == 4**dim
    place = np.rint(given.positions / given.matrix)
    assert np.abs(given.positions - place * given.matrix).max() <= np.spacing(dtype(8))
    assert len({(i, j) for i, j, _ in images(given, 1e-3)}) == 4**dim * (4**dim - 1)


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_blobs_touch_through_the_boundary(dtype, dim):
    for name in ("blobs", "unequal_1e6"):
        assert len({image for image in crossing(images_of(name, dtype, dim)) if (image[0] < 60) != (image[1] < 60)}) > 100
    for name, away in (("blobs", 9e3), ("unequal_1e6", 9e5)):
        given = built(name, dtype, dim)
        assert np.abs(given.positions[:60, 1].max() - given.positions[60:, 1].min()) > away * given.cutoff
    assert all((i < 60) == (j < 60) for i, j, _ in images_of("blobs_one_axis", dtype, dim))
    cells = cells_of(built("blob_at_origin", dtype, dim))
    assert 0.4 < (cells < 0).mean() < 0.6
    assert np.abs(built("far_open_axis", dtype, dim).positions).max() >= 1e6
    assert built("far_open_axis", dtype, dim).periodic == (False, True, True)[:dim]


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_points_that_are_not_finite(dtype, dim):
    for name in ("nonfinite", "nonfinite_slab"):
        x = built(name, dtype, dim).positions
        lost = ~np.isfinite(x).all(axis=1)
        assert 10 <= lost.sum() <= 30
        for axis in range(dim):
            only = np.isfinite(np.delete(x, axis, 1)).all(axis=1)
            assert (only & lost).any()
        assert np.isnan(x).any() and np.isposinf(x).any() and np.isneginf(x).any()
        assert not any(lost[i] or lost[j] for i, j, _ in images_of(name, dtype, dim))


# The box


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_boxes_in_cutoffs(dtype, dim):
    for name, ratio, step in (
        ("1", 1, 0),
        ("2", 2, 0),
        ("3", 3, 0),
        ("4", 4, 0),
        *((f"{side}_{k}", k, s) for k in (2, 3) for side, s in (("below", -1), ("above", 1))),
    ):
        given = built(f"box_{name}_cutoffs", dtype, dim)
        assert given.matrix.tolist() == [float_steps(ratio * given.cutoff, dtype, step)] * dim
        assert len(images(given, closed=True) - images_of(f"box_{name}_cutoffs", dtype, dim)) >= 30
    for name in ("1.3", "1.9", "2.5"):
        given = built(f"box_{name}_cutoffs", dtype, dim)
        assert given.matrix / given.cutoff == pytest.approx(float(name))
    for side, times in (("below", 2), ("above", 1)):
        counted = Counter((i, j) for i, j, _ in images_of(f"box_{side}_2_cutoffs", dtype, dim, True))
        assert max(counted.values()) == times
    given = built("box_0.3_cutoff_0.1", dtype, dim)
    assert Fraction(given.matrix[0].item()) != 3 * Fraction(dtype(given.cutoff).item())


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_several_images_of_a_pair(dtype, dim):
    for name, least_2d, least_3d in (
        ("outside_small_box", 2, 2),
        ("fcc_primitive", 40, 100),
        ("ulp_across_small_box", 6, 8),
        ("box_1_cutoffs", 4, 5),
        ("box_1.3_cutoffs", 3, 3),
        ("box_1.9_cutoffs", 2, 2),
        ("cutoff_0.6_boxes", 2, 2),
        ("cutoff_1_boxes", 4, 6),
        ("cutoff_1.5_boxes", 8, 15),
        ("cutoff_2.5_boxes", 20, 70),
        ("cutoff_1.5_skewed", 8, 15),
        ("alone", 20, 80),
        ("alone_skewed", 8, 20),
        ("thin_slab", 3, 3),
        ("thin_wire", 2, 6),
        ("unequal", 2, 2),
        ("flat", 1, 3),
        ("narrow", 3, 3),
        ("nearly_parallel", 3, 3),
        ("queries_many_images", 8, 15),
    ):
        counted = Counter((i, j) for i, j, _ in images_of(name, dtype, dim))
        assert max(counted.values()) >= (least_2d if dim == 2 else least_3d), name
    for name in ("cutoff_1_boxes", "cutoff_1.5_boxes", "cutoff_2.5_boxes", "cutoff_1.5_skewed"):
        found = images_of(name, dtype, dim)
        assert {i for i, j, _ in found if i == j} == set(range(len(built(name, dtype, dim).positions))) or name == "cutoff_1_boxes"
        assert any(max(map(abs, shift)) > 1 for _, _, shift in found) or name == "cutoff_1_boxes"


@pytest.mark.parametrize("dtype", DTYPES)
def test_one_particle_among_its_images(dtype):
    assert [len(images_of("alone_ties", dtype, dim, closed)) for dim in DIMS for closed in (False, True)] == [24, 28, 92, 122]
    assert [len(images_of("alone_at_the_cutoff", dtype, dim, closed)) for dim in DIMS for closed in (False, True)] == [0, 4, 0, 6]
    assert {len(built(name, dtype, 3).positions) for name in PERIODIC_CASES if name.startswith("alone")} == {1}


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_axes_differ(dtype, dim):
    for name in ("thin_slab", "thin_open"):
        given = built(name, dtype, dim)
        assert [length < given.cutoff for length in given.matrix] == [False, True, False][:dim]
        assert given.periodic == (True, name == "thin_slab", True)[:dim]
    wire = built("thin_wire", dtype, dim)
    assert [length < wire.cutoff for length in wire.matrix] == [True, False, True][:dim]


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_cells_are_skewed_as_said(dtype, dim):
    def measured(name):
        given = built(name, dtype, dim)
        rows = rows_of(given).astype(float)
        lengths = np.linalg.norm(rows, axis=1)
        cosine, heights = rows[0] @ rows[1] / (lengths[0] * lengths[1]), 1 / np.linalg.norm(np.linalg.inv(rows), axis=0)
        return np.sign(np.linalg.det(rows)), lengths / given.cutoff, heights / given.cutoff, np.arccos(cosine)

    for tilt in ("0.3", "0.5", "1", "3", "-0.5"):
        rows = built(f"skewed_{tilt}", dtype, dim).matrix
        assert rows[1, 0] / rows[1, 1] == pytest.approx(float(tilt))
    for name in ("left_handed", "left_handed_skewed", "negative_diagonal", "ties_across_skewed_far"):
        assert measured(name)[0] == -1
    assert measured("rotated")[0] == 1 and (built("rotated", dtype, dim).matrix != 0).all()
    assert np.count_nonzero(built("diagonal_matrix", dtype, dim).matrix) == dim
    assert built("diagonal_matrix", dtype, dim).matrix.ndim == 2
    _, lengths, heights, _ = measured("flat")
    assert lengths.min() > 9 and heights.min() < 0.71
    assert measured("narrow")[3] == pytest.approx(0.1, rel=1e-4)
    _, lengths, heights, angle = measured("nearly_parallel")
    assert angle == pytest.approx(0.01, rel=1e-3) and lengths.min() > 59 and heights.min() < 0.61
    assert any(i == j and shift[:2] == (-1, 1) for i, j, shift in images_of("nearly_parallel", dtype, dim))
    for name in ("skewed_slab", "skewed_slab_first", "skewed_wire", "skewed_open"):
        given = built(name, dtype, dim)
        assert np.count_nonzero(given.matrix) > dim
        assert len(images(given, periodic=(True,) * dim)) > len(images_of(name, dtype, dim)) or all(given.periodic)


# At the cutoff


@pytest.mark.parametrize(("dtype", "dim"), [*BUILDS[:3], slow(*BUILDS[3])])
def test_crystals_have_ties_through_faces(dtype, dim):
    cubic = [f"crystal_{kind}" for kind in ("integer", "half_box", "dyadic", "slab")]
    for name in (*cubic, "hexagonal", "fcc_supercell", "bcc_supercell"):
        ties = crossing(images_of(name, dtype, dim, True) - images_of(name, dtype, dim))
        assert len(ties) >= 48, name
    given = built("crystal_half_box", dtype, dim)
    ties = images_of("crystal_half_box", dtype, dim, True) - images_of("crystal_half_box", dtype, dim)
    assert max(Counter((i, j) for i, j, _ in ties).values()) == 2
    assert given.matrix.tolist() == [2 * given.cutoff] * dim
    for name in ("crystal_0.1", "crystal_0.1_outside"):
        given, found = built(name, dtype, dim), crossing(images_of(name, dtype, dim))
        slack = 1e-5 if dtype == np.float32 else 1e-13
        near = crossing(images(given, given.cutoff * (1 + slack)) - images(given, given.cutoff * (1 - slack)))
        assert len(near) > 100
        assert 0.1 * len(near) < len(near & found) < 0.95 * len(near)
        assert all(shape in (7, 6, 5, 14, 12) for shape in np.rint(given.matrix / 0.1).tolist())


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", TIE_CASES)
def test_ties_through_faces_are_exact(name, dtype, dim):
    given = built(name, dtype, dim)
    ties = crossing(images_of(name, dtype, dim, True) - images_of(name, dtype, dim))
    assert len(given.positions) == 160
    decided = []
    for first in range(0, 160, 4):
        assert any((first, first + 2) == (i, j) for i, j, _ in ties)
        beside = {shift for i, j, shift in ties if (i, j) == (first, first + 2)}
        decided += [any((first, first + k, shift) in images_of(name, dtype, dim) for shift in beside) for k in (1, 3)]
    assert 0.2 < np.mean(decided) < 0.8
    cells = np.floor(cells_of(given))
    assert np.abs(cells).max() > (95 if name.endswith("100") else 2 if name.endswith("far") else -1)


def partners(given):
    """Points 2k ask for points 2k + 1."""
    return dataclasses.replace(given, positions=given.positions[1::2], queries=given.positions[::2])


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", ULP_CASES)
def test_ulp_images_straddle_the_cutoff(name, dtype, dim):
    given = partners(built(name, dtype, dim))
    count = len(given.positions)
    assert count % 6 == 0 and count >= 30
    ulp = np.spacing(dtype(given.cutoff)).item()
    within = [crossing(images(given, float(dtype(given.cutoff)) + k * ulp)) for k in range(-3, 4)]
    for pair in range(count):
        inner, outer = within[pair % 6 : pair % 6 + 2]
        assert any(i == j == pair for i, j, _ in outer - inner)
    turns = 50 if name.endswith("100") else 3 if name.endswith("far") else 1
    assert max(abs(s) for i, j, shift in within[-1] if i == j for s in shift) >= turns


def working_precision(given, image):
    """|x_j - x_i + S A|² in the dtype, the images first."""
    i, j, shift = image
    steps = np.array(shift, given.positions.dtype) @ rows_of(given)
    return np.sum((given.positions[j] - given.positions[i] + steps) ** 2)


@pytest.mark.parametrize("dtype", DTYPES)
def test_ulp_images_are_beyond_the_working_precision(dtype):
    wrong = 0
    for name, dim in product(ULP_CASES, DIMS):
        given = partners(built(name, dtype, dim))
        radius, ulp, r2 = float(dtype(given.cutoff)), np.spacing(dtype(given.cutoff)).item(), dtype(given.cutoff) ** 2
        found = images(given)
        near = images(given, radius + 3 * ulp) - images(given, radius - 3 * ulp)
        wrong += sum(bool(working_precision(given, image) < r2) != (image in found) for image in near)
    assert wrong >= 100


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", ["residues_across", "residues_across_100", "residues_across_balanced"])
def test_residues_decide_through_images(name, dtype, dim):
    given = built(name, dtype, dim)
    eps = np.finfo(dtype).eps.item()
    near = crossing(images(given, 1 + eps) - images(given, 1 - eps))
    off = [exact_squared(given, image) - 1 for image in near]
    least = Fraction(eps) ** 2 / 16 if "balanced" in name else Fraction(1, 2**118)
    tiny = [x for x in off if 0 < abs(x) < least]
    assert {x > 0 for x in tiny} == {True, False}
    assert len(tiny) >= 10
    found = images_of(name, dtype, dim)
    assert sum(bool(working_precision(given, image) < 1) != (image in found) for image in near) >= 10
    assert max(abs(s) for _, _, shift in found for s in shift) > (100 if name.endswith("100") else 1)


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_pairs_half_a_box_apart(dtype, dim):
    given = built("half_box", dtype, dim)
    assert 2 * dtype(given.cutoff) == given.matrix[0]
    ties = images_of("half_box", dtype, dim, True) - images_of("half_box", dtype, dim)
    both = built("half_box_both", dtype, dim)
    assert both.positions.tobytes() == given.positions.tobytes()
    uneven = 0
    for first in range(0, 120, 4):
        # the middle partner is a tie through two images, those beside it a pair through one of the two
        assert sum((i, j) == (first, first + 2) for i, j, _ in ties) == 2
        for k, across in ((1, False), (3, True)):
            direct = [shift for i, j, shift in images_of("half_box", dtype, dim) if (i, j) == (first, first + k)]
            assert [any(shift) for shift in direct] == [across]
        assert all(sum((i, j) == (first, first + k) for i, j, _ in images_of("half_box_both", dtype, dim)) == 2 for k in (1, 2, 3))
        d = given.positions[first + 2] - given.positions[first]
        length, half = given.matrix, given.matrix / dtype(2)
        uneven += (np.mod(d + half, length) - half != -(np.mod(half - d, length) - half)).any()
    assert uneven > 25


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_distances_of_zero_through_images(dtype, dim):
    given = built("coincident", dtype, dim)
    same = images(given, 1e-3)
    assert len(crossing(same)) > 50 and all(exact_squared(given, image) == 0 for image in same)
    given = built("queries_coincident", dtype, dim)
    same = images(given, 1e-3)
    assert len(crossing(same)) > 40 and len(same - crossing(same)) >= 60
    assert all(exact_squared(given, image) == 0 for image in same)


@pytest.mark.parametrize("dim", DIMS)
def test_scales_leave_the_range(dim):
    with np.errstate(all="ignore"):
        assert np.square(np.float32(built("tiny_scale", np.float32, dim).cutoff)) == 0
        assert np.square(np.float32(built("large_scale", np.float32, dim).cutoff)) == np.inf


# Queries


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
def test_queries_are_where_they_should_be(dtype, dim):
    for name, reach in (("queries", 1), ("queries_outside", 4), ("queries_outside_skewed", 4)):
        given = built(name, dtype, dim)
        cells = np.linalg.solve(rows_of(given).T.astype(float), given.queries.T.astype(float))
        assert np.abs(cells).max() <= reach + 1e-3
        assert (np.abs(cells - 0.5).max() > 2) == (reach == 4)
    slab = built("queries_beside_slab", dtype, dim)
    assert not slab.periodic[0]
    assert {i for i, _, _ in images(slab, periodic=(True,) * dim)} == set(range(len(slab.queries)))
    apart = built("queries_none_in_reach", dtype, dim)
    assert len(apart.queries) and images(apart, periodic=(True,) * dim)
    assert len(built("no_queries", dtype, dim).queries) == len(built("no_sources", dtype, dim).positions) == 0
