"""Errors of sums over what a method found, and exact counts of a sample."""

import numpy as np
import pytest

from experiments import _accuracy, _compare, _oracle
from experiments.methods import Found, _padded

POSITIONS = np.random.default_rng(5).random((200, 3)).astype(np.float32)
CUTOFF = _oracle.round_cutoff(0.3, np.float32)
EXACT = _oracle.find_pairs(POSITIONS, CUTOFF)


def direct(i, j):
    """Sum over ordered pairs one by one."""
    total = np.zeros((200, 7))
    for a, b in zip(i, j, strict=True):
        r = (POSITIONS[b].astype(float) - POSITIONS[a]) / CUTOFF
        q = np.sqrt(r @ r)
        total[a] += [(1 - q * q) ** 3, *(6 * (1 - q * q) ** 2 * r), *(r / q)]
    return total


def errors(i, j, directed):
    found = Found(0, (i, j), directed=directed)
    return _accuracy.errors(found, _compare.compare(found, EXACT, 200), EXACT, POSITIONS, CUTOFF)


@pytest.mark.parametrize("directed", [False, True])
def test_errors_are_those_of_the_sums(directed):
    i, j = np.divmod(EXACT, 200)
    both = np.concatenate((i, j)), np.concatenate((j, i))
    found = both if directed else (i, j)
    assert errors(*found, directed) == {"density_error": 0, "gradient_error": 0, "jump_error": 0}
    kept = np.arange(len(found[0])) % 50 != 7
    wrong = found[0][kept], found[1][kept]
    mine = direct(*wrong) if directed else direct(np.concatenate(wrong), np.concatenate(wrong[::-1]))
    off = mine - direct(*both)
    density = direct(*both)[:, 0].mean()
    expected = {
        "density_error": np.abs(off[:, 0]).max() / density,
        "gradient_error": np.linalg.norm(off[:, 1:4], axis=1).max() / density,
        "jump_error": np.linalg.norm(off[:, 4:], axis=1).max() / (2 * len(EXACT) / 200),
    }
    assert errors(*wrong, directed) == pytest.approx(expected)


def test_pairs_that_are_too_many_count_and_so_do_repeats():
    i, j = np.divmod(EXACT, 200)
    far = next((a, b) for a in range(200) for b in range(a + 1, 200) if a * 200 + b not in set(EXACT))
    more = np.append(i, [far[0], i[0]]), np.append(j, [far[1], j[0]])
    found = Found(0, more)
    a, b, weight = _accuracy.difference(found, EXACT, 200)
    assert sorted(zip(a, b, weight, strict=True)) == sorted([(*far, 1.0), (i[0], j[0], 1.0)])
    assert errors(*more, False)["density_error"] > 0


def test_a_method_that_sums_itself_is_judged_by_its_sums():
    i, j = np.divmod(EXACT, 200)
    density = direct(np.concatenate((i, j)), np.concatenate((j, i)))[:, 0]
    density[3] += 0.5
    found = Found(0, counts=_oracle.count_neighbors(EXACT, 200), density=density)
    row = _compare.compare(found, EXACT, 200)
    error = _accuracy.errors(found, row, EXACT, POSITIONS, CUTOFF)
    assert error == {"density_error": pytest.approx(0.5 / density.mean(), rel=0.01)}
    assert _accuracy.errors(Found(0, counts=found.counts), row, EXACT, POSITIONS, CUTOFF) == {}


SITES = np.stack(np.meshgrid(*3 * [np.arange(9)], indexing="ij"), axis=-1).reshape(-1, 3)
LATTICE, SAMPLE = (SITES * 1e-4).astype(np.float32), np.arange(0, 729, 7)  # full of ties at three spacings


def sampled(found: Found) -> tuple[int, int, int]:
    exact = _oracle.find_sample(LATTICE, 3e-4, SAMPLE)
    row = _compare.compare_sample(found, exact, SAMPLE, 729)
    assert row["compared"] == "sample" and row["exact_pairs"] == len(exact) // 2
    return row["missing"], row["extra"], row["pairs"]


def test_a_sample_is_decided_exactly_on_a_lattice_full_of_ties():
    i, j = np.divmod(_oracle.find_pairs(LATTICE, 3e-4), 729)
    both = np.concatenate((i * 729 + j, j * 729 + i))
    assert np.array_equal(_oracle.find_sample(LATTICE, 3e-4, SAMPLE), np.sort(both[np.isin(both // 729, SAMPLE)]))


def test_counts_of_a_sample_are_compared():
    keys = _oracle.find_pairs(LATTICE, 3e-4)
    whole = _oracle.count_neighbors(keys, 729)
    assert sampled(Found(0, counts=whole)) == (0, 0, len(keys))
    assert sampled(Found(0, counts=whole + 1))[1] == -(-len(SAMPLE) // 2)
    assert sampled(Found(0, counts=whole - 1))[0] == -(-len(SAMPLE) // 2)


def test_of_a_large_padded_list_the_sample_alone_is_read(monkeypatch):
    i, j = np.divmod(_oracle.find_pairs(LATTICE, 3e-4), 729)
    rows = [sorted([*j[i == k], *i[j == k]]) for k in range(729)]
    count = np.array([len(row) for row in rows], np.int32)
    idx = np.full((729, count.max() + 2), 729, np.int32)
    for k, row in enumerate(rows):
        idx[k, : len(row)] = row
    whole = _padded.found_in_rows(idx, count, "cpu")
    assert (len(whole.pairs[0]), whole.total) == (2 * len(i), 2 * len(i))
    monkeypatch.setattr(_compare, "MOST_LISTED", 728)
    monkeypatch.setattr(_compare, "sample", lambda n: SAMPLE)
    part = _padded.found_in_rows(idx, count, "cpu")
    assert len(part.pairs[0]) == count[SAMPLE].sum() < part.total == count.sum()
    assert sampled(part) == sampled(whole) == (0, 0, len(i))
    idx[SAMPLE[3], 0] = SAMPLE[5]  # far away: a pair of two that are compared, and one that is lost
    assert sampled(_padded.found_in_rows(idx, count, "cpu"))[:2] == (1, 1)
    count[5] = idx.shape[1] + 1
    with pytest.raises(RuntimeError, match=f"a row has {idx.shape[1] + 1} neighbors and {idx.shape[1]} slots"):
        _padded.found_in_rows(idx, count, "cpu")


@pytest.mark.parametrize("directed", [False, True])
def test_lists_of_a_sample_are_compared_pair_by_pair(directed):
    keys = _oracle.find_pairs(LATTICE, 3e-4)
    i, j = np.divmod(keys, 729)
    if directed:
        i, j = np.concatenate((i, j)), np.concatenate((j, i))
    order = np.random.default_rng(0).permutation(len(i))
    i, j = i[order], j[order]
    assert sampled(Found(0, (i, j), directed)) == (0, 0, len(keys))
    one = np.flatnonzero((i == 7) & ~np.isin(j, SAMPLE))[:2]
    wrong = j.copy()
    wrong[one] = 727  # as many neighbors as before, two of them others, and those twice
    assert sampled(Found(0, (i, wrong), directed))[:2] == (1, 1)
    away = np.setdiff1d(np.arange(len(i)), one)
    assert sampled(Found(0, (i[away], j[away]), directed))[:2] == (1, 0)
    outside = np.flatnonzero(~np.isin(i, SAMPLE) & ~np.isin(j, SAMPLE))[0]
    wrong = j.copy()
    wrong[outside] = i[outside]
    assert sampled(Found(0, (i, wrong), directed))[:2] == (0, 0)
