from fractions import Fraction
from itertools import combinations, product

import numpy as np
import pytest
from checked import refuses

from experiments import _compare, _oracle
from experiments.methods import Found


def brute_keys(positions, cutoff):
    """Decide every pair in fractions."""
    points = [[Fraction(float(x)) for x in row] for row in positions]
    limit = Fraction(float(positions.dtype.type(cutoff))) ** 2
    size = len(points)
    return [
        i * size + j
        for i, j in combinations(range(size), 2)
        if sum((b - a) ** 2 for a, b in zip(points[i], points[j], strict=True)) < limit
    ]


def lattice(shape, spacing, offset, dtype):
    return (np.array(list(product(*map(range, shape))), np.float64) * spacing + offset).astype(dtype)


@pytest.mark.parametrize("offset", [0.0, -3.0, 1e4], ids="at {}".format)
@pytest.mark.parametrize("spacing", [1e-4, 0.1, 1.0, 1e6], ids="dx {}".format)
@pytest.mark.parametrize("shape", [(9, 8), (5, 4, 5)], ids=["2d", "3d"])
def test_lattices_full_of_ties(shape, spacing, offset, dtype):
    positions = lattice(shape, spacing, offset * spacing / 1e-4, dtype)
    for ratio in (1.0, 3.0, np.sqrt(5)):
        cutoff = ratio * spacing
        assert _oracle.find_pairs(positions, cutoff).tolist() == brute_keys(positions, cutoff)


def test_cutoffs_one_ulp_around_a_distance(dtype):
    positions = np.random.default_rng(3).uniform(-1, 1, (40, 3)).astype(dtype)
    sizes = set()
    for distance in np.linalg.norm(positions[1:20] - positions[0], axis=1).astype(dtype):
        for cutoff in (np.nextafter(distance, dtype(0)), distance, np.nextafter(distance, dtype(9))):
            found = _oracle.find_pairs(positions, float(cutoff)).tolist()
            assert found == brute_keys(positions, cutoff)
            sizes.add(len(found))
    assert len(sizes) > 19


def test_coincident_points_are_pairs_and_one_alone_has_none(dtype):
    assert _oracle.find_pairs(np.zeros((1, 3), dtype), 1.0).tolist() == []
    positions = np.array([[0.5, 0.5], [0.5, 0.5], [2.0, 0.5], [0.5, 0.5]], dtype)
    assert _oracle.find_pairs(positions, 1e-3).tolist() == [0 * 4 + 1, 0 * 4 + 3, 1 * 4 + 3]


def lattice_pairs(shape, ratio):
    """Count the pairs of a lattice of spacing 1 by their offsets."""
    reach = range(-int(ratio), int(ratio) + 1)
    inside = [offset for offset in product(reach, repeat=3) if 0 < sum(step**2 for step in offset) < ratio**2]
    return sum(np.prod([n - abs(step) for n, step in zip(shape, offset, strict=True)]) for offset in inside) // 2


def test_a_lattice_too_large_for_fractions():
    shape = (25, 50, 25)
    assert len(_oracle.find_pairs(lattice(shape, 1.0, 0.0, np.float64), 3.0)) == lattice_pairs(shape, 3)


@pytest.mark.slow
def test_the_full_lattice_of_the_thesis():
    shape = (50, 100, 50)
    assert lattice_pairs(shape, 3) == 21_841_744 // 2
    assert len(_oracle.find_pairs(lattice(shape, 1.0, 0.0, np.float64), 3.0)) == lattice_pairs(shape, 3)


def test_a_cutoff_that_float64_cannot_square():
    refuses(ValueError, r"cutoff 1e-200 is outside .*not safe in float64", _oracle.find_pairs, np.zeros((2, 3)), 1e-200)


def test_neighbor_counts_are_those_of_the_pairs():
    positions = np.random.default_rng(4).uniform(0, 1, (60, 2))
    closer = np.linalg.norm(positions[:, None] - positions, axis=2) < 0.2
    counts = _oracle.count_neighbors(_oracle.find_pairs(positions, 0.2), 60)
    assert counts.tolist() == (closer.sum(axis=1) - 1).tolist()


def test_pairs_of_a_sample_are_found_once_per_folder(tmp_path, monkeypatch):
    positions, rows = np.random.default_rng(5).uniform(0, 1, (50, 3)), np.arange(0, 50, 3)
    first = _oracle.load_sample(positions, 0.3, rows, tmp_path)
    assert first.size
    assert np.array_equal(first, _oracle.find_sample(positions, 0.3, rows))
    monkeypatch.setattr(_oracle, "find_sample", lambda positions, cutoff, rows: np.array([7]))
    assert np.array_equal(_oracle.load_sample(positions, 0.3, rows, tmp_path), first)
    for changed in ((positions, 0.3, rows[1:]), (positions[::-1], 0.3, rows), (positions, 0.31, rows)):
        assert _oracle.load_sample(*changed, tmp_path).tolist() == [7]


def test_pairs_are_found_once_per_folder(tmp_path, monkeypatch):
    positions = np.random.default_rng(5).uniform(0, 1, (50, 3))
    first = _oracle.load_pairs(positions, 0.3, tmp_path / "oracle")
    assert first.tolist() == brute_keys(positions, 0.3)
    monkeypatch.setattr(_oracle, "find_pairs", lambda positions, cutoff: np.array([7]))
    assert _oracle.load_pairs(positions, 0.3, tmp_path / "oracle").tolist() == first.tolist()
    others = [(positions[::-1], 0.3), (positions, 0.31), (positions.astype(np.float32), 0.3), (positions.reshape(75, 2), 0.3)]
    for changed, cutoff in others:
        assert _oracle.load_pairs(changed, cutoff, tmp_path / "oracle").tolist() == [7]
    assert len(list((tmp_path / "oracle").iterdir())) == 5


SIZE = 10
EXACT = np.array([0 * SIZE + 1, 0 * SIZE + 4, 3 * SIZE + 7])
TRUE = [(0, 1), (0, 4), (3, 7)]
BOTH = [*TRUE, (1, 0), (4, 0), (7, 3)]


def compared(pairs, directed):
    i, j = np.array(pairs, np.int32).reshape(-1, 2).T
    row = _compare.compare(Found(0, (i, j), directed), EXACT, SIZE)
    assert row["compared"] == "pairs"
    assert row["exact_pairs"] == 3
    return row["pairs"], row["missing"], row["extra"]


@pytest.mark.parametrize(
    ("pairs", "directed", "expected"),
    [
        (TRUE, False, (3, 0, 0)),
        ([(4, 0), (7, 3), (1, 0)], False, (3, 0, 0)),
        (TRUE[:2], False, (2, 1, 0)),
        ([*TRUE, (2, 3)], False, (4, 0, 1)),
        ([*TRUE, (4, 0)], False, (4, 0, 1)),  # twice
        ([*TRUE[:2], (8, 8)], False, (3, 1, 1)),
        ([], False, (0, 3, 0)),
        (BOTH, True, (3, 0, 0)),
        (BOTH[::-1], True, (3, 0, 0)),
        (BOTH[:5], True, (3, 1, 0)),  # one direction lacks
        ([*BOTH, (5, 6)], True, (4, 0, 1)),  # one direction too many
        ([*BOTH, (5, 6), (6, 5)], True, (4, 0, 1)),
        ([*BOTH, (7, 3)], True, (3, 0, 1)),
        ([*BOTH, (2, 2)], True, (3, 0, 1)),
        ([], True, (0, 3, 0)),
    ],
)
def test_errors_of_a_list_of_pairs(pairs, directed, expected):
    assert compared(pairs, directed) == expected


def test_errors_of_counts():
    right = np.array([2, 1, 0, 1, 1, 0, 0, 1, 0, 0])
    wrong = right + np.array([0, 0, 1, -1, 0, 0, 1, -1, 0, 1])
    for counts, errors in ((right, (0, 0)), (wrong, (1, 2))):
        row = _compare.compare(Found(0, counts=counts), EXACT, SIZE)
        assert (row["missing"], row["extra"], row["compared"]) == (*errors, "counts")
        assert row["pairs"] == 3


def test_an_adapter_that_gives_nothing():
    refuses(ValueError, "neither pairs nor counts", _compare.compare, Found(0), EXACT, SIZE)
