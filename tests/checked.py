"""Search, and compare what came back with the oracle as a set of pairs. Shapes and dtypes are checked on the way.

And which parameters of a test are for runs by hand.
"""

import jax
import numpy as np
import pytest
import reference
from beartype import beartype
from jax import Array
from jaxtyping import Bool, Int32, jaxtyped

import jfrnn


def slow(*values, **more):
    """Return parameters of a test that runs by hand."""
    return pytest.param(*values, marks=pytest.mark.slow, **more)


def slowly(*cases):
    """Return parameters of tests that all run by hand."""
    return [slow(*case) for case in cases]


def sparing(cases, often):
    """Return parameters of tests, of which only those that stand in `often` run by default."""
    often = list(often)
    return [case if case in often else slow(*case) for case in map(tuple, cases)]


def refuses(error, match, call, /, *given, **options):
    """Fail unless a call raises an error that says this."""
    with pytest.raises(error, match=match):
        call(*given, **options)


@jaxtyped(typechecker=beartype)
def assert_shapes(
    idx: Int32[Array, "m k"],
    count: Int32[Array, " m"],
    status: Int32[Array, ""],
    required: Int32[Array, ""],
    overflow: Bool[Array, ""],
) -> None:
    """Fail where a field of a list has another shape or dtype than documented."""


def found_pairs(nbrs):
    """Return the pairs of a list after checking its fields, its padding and its counts."""
    assert_shapes(nbrs.idx, nbrs.count, nbrs.status, nbrs.required, nbrs.overflow)
    assert not nbrs.overflow
    assert int(nbrs.required) == int(np.max(nbrs.count, initial=0))
    return reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), nbrs.source_count)


def assert_exact(nbrs, positions, cutoff, *, queries=None, **options):
    """Fail unless the list holds exactly the oracle's pairs."""
    assert_pairs(nbrs, reference.reference_pairs(positions, cutoff, queries=queries, **options))


def assert_pairs(nbrs, expected):
    """Fail unless the list holds exactly these pairs, a set."""
    assert_same(set(found_pairs(nbrs)), expected)  # which holds none twice


def assert_same(found, expected):
    """Fail unless two sets are the same, and tell how they differ."""
    missing, extra = expected - found, found - expected
    assert (len(missing), len(extra)) == (0, 0), f"missing {sorted(missing)[:5]}, extra {sorted(extra)[:5]} of {len(expected)}"


def as_set(i, j, shifts=None):
    """Return pairs (i, j), or images (i, j, S) with shifts [e, d], as a set; fail where one stands there twice."""
    columns = [np.asarray(i).tolist(), np.asarray(j).tolist()]
    columns += [] if shifts is None else [map(tuple, np.asarray(shifts).astype(int).tolist())]
    listed = list(zip(*columns, strict=True))
    assert len(set(listed)) == len(listed)
    return set(listed)


def slots_as_set(idx, mask, shifts=None):
    """Return the pairs, or the images, of those slots [m, capacity] that a mask names."""
    i, k = np.nonzero(np.asarray(mask))
    return as_set(i, np.asarray(idx)[i, k], None if shifts is None else np.asarray(shifts)[i, k])


def padded(points, length):
    """Lengthen points with NaN rows, which take part in no pair, so that inputs of many sizes share one compiled program."""
    fill = np.full((length - len(points), points.shape[1]), np.nan, points.dtype)
    return np.concatenate([points, fill])


def search_padded(hard_input, length, capacity, **options):
    """Search a hard case with sources and queries padded to `length` rows."""
    queries = None if hard_input.queries is None else padded(hard_input.queries, length)
    return jfrnn.search(padded(hard_input.positions, length), hard_input.cutoff, queries=queries, capacity=capacity, **options)


def with_sums(found, points):
    """Return the sums of rows of points, 0 where a point is not finite, after checking that those, and the padding, have none."""
    lost = ~np.isfinite(np.asarray(points)).all(axis=1)

    def of_points(leaf):
        leaf = np.asarray(leaf)
        none = np.isnan(leaf) if np.issubdtype(leaf.dtype, np.floating) else leaf == np.iinfo(leaf.dtype).min
        assert none[: len(lost)][lost].all()
        assert none[len(lost) :].all()
        return np.where(lost.reshape(-1, *[1] * (leaf.ndim - 1)), 0, leaf[: len(lost)])

    return jax.tree.map(of_points, found)
