"""Fused pair sums in periodic boxes: the pairs and images of the oracle, and derivatives in the lattice vectors."""

import functools

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slow
from marked import assert_marks, marks
from test_pair_sum import CUTOFF, assert_same, everything, oracle, scene, smooth, smooth_slopes, tangents_of

import jfrnn
from jfrnn.cases.batches import BATCH_CASES
from jfrnn.cases.periodic import PERIODIC_CASES

fused = functools.partial(jfrnn.pair_sum, backend="warp")
NEAREST = ["outside_100", "faces", "ulp_across_100"]
NAMES = [*NEAREST, "thin_slab", "skewed_3_small", "queries_many_images"]


def marked(given, box, alone, **options):
    """Return the marks of a case, lengthened so that cases share programs; `alone` it has its own, which knows the box."""
    ids = np.arange(300, dtype=given.positions.dtype)
    if given.queries is not None:
        options |= {"queries": checked.padded(given.queries, 300), "query_values": ids}

    def sums(x, options):
        return fused(marks, x, given.cutoff, ids, box=box, **options, **static)

    static = {name: options.pop(name) for name in ("closed", "include_self") if name in options}
    return (jax.jit(sums) if alone else sums)(checked.padded(given.positions, 300), options)


def assert_case(name, dtype, dim, **options):
    given = PERIODIC_CASES[name].build(dtype, dim)
    found = marked(given, jfrnn.Box(given.matrix, given.periodic), name not in NEAREST, **options)
    kind = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries}
    pairs = reference.reference_images(given.positions, given.cutoff, **kind, **options)
    assert_marks(found, pairs, given.positions, given.queries, given.matrix)


@pytest.mark.parametrize("name", NAMES)
def test_cases(name):
    assert_case(name, np.float32, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 2), (np.float64, 2), (np.float32, 3), (np.float64, 3)])
@pytest.mark.parametrize("name", PERIODIC_CASES)
def test_every_case(name, dtype, dim):
    assert_case(name, dtype, dim)


def marks_at_work(r, i, j):
    """Take more operations than are done for candidates that are no pairs, so that pairs are packed first."""
    return marks(r, i, j) | {"more": jnp.exp(jnp.sin(r)).sum() + jnp.cos(i * j)}


@pytest.mark.parametrize("fn", [marks, slow(marks_at_work)])
def test_where_no_pair_crosses_the_box(fn):
    """Within a box pairs have no shift, and coordinates are those of the candidates; but not where particles lie outside.

    In the boxes beside it is a shift of the image alone, between wrapped positions; farther away turns are read.
    """
    lengths, ids = np.array([8.0, 9.0]), np.arange(600, dtype=np.float32)
    x = (np.random.default_rng(0).random((600, 2)) * lengths).astype(np.float32)
    outside = x + np.where(ids[:, None] == 7, 2 * lengths, 0).astype(np.float32)
    beside = x + ((ids[:, None] % 3 - 1) * lengths).astype(np.float32)
    sums = jax.jit(lambda x: fused(fn, x, 0.5, ids, box=jfrnn.Box(lengths)))
    for at in (x, outside, beside):
        pairs = reference.reference_images(at, 0.5, matrix=np.diag(lengths), periodic=(True, True))
        assert_marks(sums(at), pairs, at, matrix=lengths)


@pytest.mark.slow
def test_options():
    """Closed, with themselves, where it decides something."""
    given = PERIODIC_CASES["crystal_integer"].build(np.float32, 3)
    kind = {"matrix": given.matrix, "periodic": given.periodic}
    few, all_of_them = (
        reference.reference_images(given.positions, given.cutoff, closed=flag, include_self=flag, **kind) for flag in (False, True)
    )
    assert len(all_of_them) > len(few) + len(given.positions)
    assert_case("crystal_integer", np.float32, 3, closed=True, include_self=True)


@pytest.mark.parametrize("name", ["periodic", slow("periodic_images")])
def test_batches(name):
    """In a box that is traced: its image is the nearest one, or how many are looked at is said."""
    given = BATCH_CASES[name].build(np.float64, 2)
    n, images = len(given.positions), None if name == "periodic" else 1
    batch = np.concatenate([given.batch, np.zeros(300 - n, np.int32)])

    @jax.jit
    def sums(x, lengths):
        ids = np.arange(300, dtype=x.dtype)
        return fused(marks, x, given.cutoff, ids, box=jfrnn.Box(lengths, images=images), batch=batch)

    found = sums(checked.padded(given.positions, 300), given.lengths)
    pairs = reference.reference_images(given.positions, given.cutoff, matrix=given.lengths, periodic=(True, True))
    together = {(i, j, s) for i, j, s in pairs if given.batch[i] == given.batch[j]}
    assert_marks(found, together, given.positions, matrix=given.lengths)


# --- derivatives -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_derivatives_with_queries():
    """The reversed pairs have their own turns."""
    (x, m), q = scene(1), jnp.asarray(np.asarray(scene(2)[0])[:23] - np.array([3.0, 0.0]))
    args = (x, q, m, jnp.linspace(0.3, 0.6, 23), jnp.array([1.3, 1.0]))

    def sums(x, q, m, w, lengths):
        given = {"queries": q, "query_values": {"m": w}, "box": jfrnn.Box(lengths, (True, False))}
        return fused(functools.partial(smooth, 0.7), x, CUTOFF, {"m": m}, **given)

    along, pairs = tangents_of(args), reference.reference_images(x, CUTOFF, matrix=args[-1], periodic=(True, False), queries=q)
    expected = oracle(smooth_slopes, pairs, dict(zip(("x", "q", "m", "w", "lengths"), args)), along, scale=0.7)
    assert_same(everything(sums)(args, along), expected)


# --- where there is no answer ----------------------------------------------------------------------------------


def test_where_a_search_cannot_answer_nothing_looks_like_an_answer():
    x, m = scene(1, dim=3)

    @jax.jit
    def sums(x, lengths):
        return fused(lambda r, i, j: j, x, 0.3, m, box=jfrnn.Box(lengths, (True, False, False)))

    lengths, far = np.array([2.0, 1.0, 1.0]), np.array(x)
    far[0, 0] = 1e12
    assert np.isfinite(sums(x, lengths)).all()
    for wrong in ((x, 0.1 * lengths), (far, lengths)):
        assert np.isnan(sums(*wrong)).all()
