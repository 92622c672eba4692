"""Lists with a skin in periodic boxes: wrapping is no motion, and the images of a list are the same before and after."""

import functools

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow
from test_box import masked_images, shifts_and_mask

import jfrnn

SKEWED = np.array([[1.0, 0.0, 0.0], [0.45, 0.9, 0.0], [-0.3, 0.35, 1.1]])


def oracle(x, cutoff, box, **options):
    rows = np.asarray(box.vectors)
    return reference.reference_images(np.asarray(x), cutoff, matrix=rows, periodic=box.periodic, **options)


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_positions_that_are_wrapped_in_every_step_cost_no_lists(backend, dtype):
    lengths, cutoff, skin = np.array([1.0, 1.3, 0.9]), 0.2, 0.05
    box, rng = jfrnn.Box(lengths), np.random.default_rng(0)
    x = jnp.asarray(rng.uniform(0, lengths, (200, 3)), dtype)
    speed = jnp.asarray(rng.normal(0, 1, (200, 3)), dtype)
    step = speed * dtype(0.11 * skin / np.linalg.norm(speed, axis=1).max())

    @jax.jit
    def run(x, nbrs):
        def advance(_, carry):
            free, x, nbrs, wrapped = carry
            free, x = free + step, jnp.mod(x + step, lengths.astype(dtype))
            return free, x, nbrs.update(free), wrapped.update(x)

        return jax.lax.fori_loop(0, 20, advance, (x, x, nbrs, nbrs))

    start = jfrnn.search(x, cutoff, skin=skin, box=box, capacity=48, backend=backend)
    _, end, nbrs, wrapped = run(x, start)
    wrapped.check()
    assert (np.floor(np.asarray(x + 20 * step) / lengths) != 0).any(axis=1).sum() > 5
    assert int(wrapped.rebuild_count) == int(nbrs.rebuild_count) == 4
    assert masked_images(wrapped, end) == oracle(end, cutoff, box)


LONG = np.array([[1.0, 0.0, 0.0], [30.3, 1.1, 0.0], [-17.2, 21.1, 0.9]]) @ np.linalg.qr(SKEWED + 1)[0]
KINDS = {
    "long": (jfrnn.Box(LONG), 0.8),
    "long, own images": (jfrnn.Box(LONG), 1.15),
    "orthogonal": (jfrnn.Box([0.7, 1.6, 1.1], origin=[-0.2, 0.1, 0.0]), 0.9),
    "skewed": (jfrnn.Box(SKEWED), 0.8),
    "slab": (jfrnn.Box(SKEWED, periodic=(True, False, True)), 0.8),
    "nearest": (jfrnn.Box(3 * SKEWED), 0.6),
}


EACH = [(np.float64, "slab", "queries"), (np.float32, "orthogonal", "half"), (np.float64, "long, own images", "half")]
UPDATED = ("long, own images",)  # in lists of other kinds, tests below ask whether wrapping is motion; by hand all
ALL = [(dtype, kind, asked) for dtype in (np.float32, np.float64) for kind in KINDS for asked in ("own", "half", "queries")]


@pytest.mark.parametrize(("dtype", "kind", "asked"), [*EACH, *(slow(*x) for x in ALL if x not in EACH)])
def test_images_of_a_kept_list_are_those_of_the_moved_particles(dtype, kind, asked):
    box, cutoff = KINDS[kind]
    rng, skin, rows = np.random.default_rng(1), 0.1, np.asarray(box.vectors, np.float64)
    rows = np.diag(rows) if rows.ndim == 1 else rows
    whole = lambda size, most: (rng.integers(-most, most + 1, (size, 3)) * box.periodic) @ rows  # noqa: E731
    before = (rng.uniform(0, 1, (24, 3)) @ rows + whole(24, 2)).astype(dtype)
    points = None if asked != "queries" else (rng.uniform(0, 1, (9, 3)) @ rows + whole(9, 2)).astype(dtype)
    options = {"half": asked == "half"}
    nbrs = jfrnn.search(before, cutoff, skin=skin, box=box, capacity=256, queries=points, **options)
    nbrs.check()
    assert (nbrs.images is None) == (kind == "nearest")

    def moved(x):
        return (x.astype(float) + whole(len(x), 3) + rng.uniform(-1, 1, x.shape) * 0.4 * skin / 3).astype(dtype)

    after, given = moved(before), {} if points is None else {"queries": moved(points)}

    def weight(r, i, j):
        return jnp.stack([r[0] ** 2, r[1] * r[2], jnp.ones_like(r[0])])

    @jax.jit
    def all_of(nbrs, x, **given):
        kept = nbrs.update(x, **given) if kind in UPDATED or (dtype, kind, asked) not in EACH else nbrs
        sums = None if (kind, asked) != ("skewed", "own") else jfrnn.pair_sum(weight, x, None, neighbors=kept)
        return kept, shifts_and_mask(kept, x, given), sums

    kept, found, sums = all_of(nbrs, after, **given)
    kept.check()
    assert int(kept.rebuild_count) == 0
    assert (np.floor(np.asarray(after, float) @ np.linalg.inv(rows)) != np.floor(before @ np.linalg.inv(rows))).any()
    expected = oracle(after, cutoff, box, **options, **given)
    assert masked_images(kept, after, found) == expected
    if sums is not None:
        pairs = by_numpy.in_order(expected, 3)
        r = by_numpy.vectors_of(pairs, after.astype(float), after.astype(float), rows.astype(dtype))
        terms = np.stack([r[:, 0] ** 2, r[:, 1] * r[:, 2], np.ones(len(r))], axis=1)
        np.testing.assert_allclose(sums, by_numpy.add_up(terms, pairs.i, len(after)), rtol=3e-5, atol=3e-5)


def test_short_motion_is_no_wrapping_in_a_box_that_is_far_from_reduced():
    """Fractional coordinates of a short motion are long there: rounded, they are no lattice vector that anybody moved by."""
    rows, cutoff, skin = np.array([[0.3, 0.0, 0.0], [3.0, 0.3, 0.0], [0.1, 0.2, 0.3]]), 0.2, 0.05
    box, rng = jfrnn.Box(rows), np.random.default_rng(0)
    before = (rng.uniform(0, 1, (24, 3)) @ rows).astype(np.float32)
    nbrs = jfrnn.search(before, cutoff, skin=skin, box=box, capacity=256)
    step = rng.normal(size=before.shape)
    step *= 0.4 * skin / np.linalg.norm(step, axis=1, keepdims=True)
    for whole in (0, rng.integers(-2, 3, before.shape) @ rows):
        after = (before + step + whole).astype(np.float32)
        assert masked_images(nbrs, after) == oracle(after, cutoff, box)


def test_a_box_that_changes_while_particles_are_wrapped():
    dtype, skin, cutoff, rng = np.float64, 0.1, 0.8, np.random.default_rng(2)
    x = rng.uniform(0, 1, (20, 3)) + rng.integers(-2, 3, (20, 3))
    nbrs = jfrnn.search(x @ SKEWED, cutoff, skin=skin, box=jfrnn.Box(SKEWED.astype(dtype)), capacity=160)
    made = []
    for size in (1.002, 1.004, 0.93):
        x = np.mod(x, 1) if size < 1.004 else x + rng.integers(-2, 3, x.shape)
        box = jfrnn.Box((size * SKEWED).astype(dtype))
        now = x @ (size * SKEWED)
        nbrs = nbrs.update(now, box=box)
        made.append(int(nbrs.rebuild_count))
        assert masked_images(nbrs, now) == oracle(now, cutoff, box)
    assert made == [0, 1, 2]


def test_motion_of_half_a_cell_is_never_taken_for_another_image():
    dtype, box, cutoff, skin, rng = np.float32, jfrnn.Box(0.3 * SKEWED), 0.5, 0.5, np.random.default_rng(3)
    x = rng.uniform(0, 0.3, (4, 3)).astype(dtype)
    start = jfrnn.search(x, cutoff, skin=skin, box=box, capacity=800)
    for step in (0.5, 0.4999999, 0.5000001, 0.6):
        now = x.copy()
        now[0] += (step * 0.3 * SKEWED[0]).astype(dtype)
        now[1] -= (step * 0.3 * SKEWED[2]).astype(dtype)
        nbrs = start.update(now)
        assert masked_images(nbrs, now) == oracle(now, cutoff, box)


def test_particles_that_leave_the_range_of_a_box_are_noticed():
    dtype, box = np.float32, jfrnn.Box([1.0, 1.0, 1.0])
    x = np.random.default_rng(4).uniform(0, 1, (10, 3)).astype(dtype)

    def beyond(step):
        return x + np.where(np.arange(30).reshape(10, 3) == 0, dtype(step), 0)

    nbrs = jfrnn.search(x, 0.3, skin=0.1, box=box, capacity=16)
    assert int(nbrs.update(beyond(500)).rebuild_count) == 0
    gone = nbrs.update(beyond(600))  # so far away, coordinates are rounded by more than the skin
    gone.check()
    assert masked_images(gone, beyond(600)) == oracle(beyond(600), 0.3, box)
    refuses(ValueError, r"too far away.*positions\[0\] lies", nbrs.update(beyond(1e7)).check)
    far = jfrnn.search(beyond(-500), 0.3, skin=0.1, box=box, capacity=16)
    assert masked_images(far, beyond(-500)) == oracle(beyond(-500), 0.3, box)


# --- boxes that change ----------------------------------------------------------------------------------------------------


@functools.cache
def shrinking(ratio, steps=20):
    """A chunk of steps in which a cell, and the particles in it, shrink to a ratio of their size; state: fractions and lengths."""

    @jax.jit
    def chunk(state, nbrs):
        def step(_, carry):
            (u, lengths), nbrs = carry
            lengths = lengths * ratio ** (1 / steps)
            return (u, lengths), nbrs.update(u * lengths, box=jfrnn.Box(lengths))

        return jax.lax.fori_loop(0, steps, step, (state, nbrs))

    return chunk


def by_run_chunk(chunk, state, nbrs):
    return jfrnn.run_chunk(chunk, state, nbrs, lambda s: s[0] * s[1], box=lambda s: jfrnn.Box(s[1]))


def by_the_loop_of_the_readme(chunk, state, nbrs):
    while True:
        after, seen = chunk(state, nbrs)
        if not seen.overflow:
            break
        nbrs = seen.grow(state[0] * state[1], box=jfrnn.Box(state[1]))
    state, nbrs = after, seen
    nbrs.check()
    return state, nbrs


def by_grow(chunk, state, nbrs):
    state, nbrs = chunk(state, nbrs)
    refuses(ValueError, r"too small for the images.*grow\(\) of a list.*needs images=\(1, 1, 1\)", nbrs.check)
    return state, nbrs.grow(state[0] * state[1])


@pytest.mark.parametrize(
    ("lengths", "cutoff", "skin", "ratio", "run"),
    [
        slow([25.75, 25.75, 25.75], 12.0, 0.5, 0.96, by_run_chunk),
        ([25.75, 25.75, 25.75], 12.0, 0.5, 0.96, by_grow),
        slow([10.0, 9.0, 11.0], 2.5, 0.0, 0.1, by_the_loop_of_the_readme),
    ],
    ids=["run_chunk", "grow", "loop"],
)
def test_a_box_that_shrinks_until_the_cutoff_needs_more_images(lengths, cutoff, skin, ratio, run):
    u, dtype = np.random.default_rng(5).uniform(0, 1, (5, 3)), np.float64
    state = u, np.array(lengths, dtype)
    nbrs = jfrnn.search(state[0] * state[1], cutoff, skin=skin, box=jfrnn.Box(lengths))
    assert nbrs.box_kind.nearest
    (u, now), nbrs = run(shrinking(ratio), state, nbrs)
    u, now = np.asarray(u), np.asarray(now)
    nbrs.check()
    assert not nbrs.box_kind.nearest
    np.testing.assert_allclose(now, np.array(lengths) * ratio)
    assert masked_images(nbrs, u * now) == oracle(u * now, cutoff, jfrnn.Box(now))


def test_a_box_that_was_too_small_in_between_takes_more_images_too():
    x = np.random.default_rng(6).uniform(0, 1, (6, 3))
    nbrs = jfrnn.search(x, 0.3, box=jfrnn.Box([1.0, 1.0, 1.0]), capacity=64)
    narrow = jfrnn.Box([1.0, 0.5, 1.0])
    seen = nbrs.update(x, box=narrow).update(x, box=jfrnn.Box([1.0, 1.0, 1.0]))
    assert seen.overflow
    grown = seen.grow(x)
    after = grown.update(x, box=narrow)
    after.check()
    assert masked_images(after, x) == oracle(x, 0.3, narrow)


def test_what_no_room_mends_is_raised():
    x = jnp.asarray(np.random.default_rng(6).uniform(0, 1, (6, 3)))
    nbrs = jfrnn.search(x, 0.3, box=jfrnn.Box([1.0, 1.0, 1.0]), capacity=64)
    lost = jax.jit(lambda x, n: (x, n.update(x.at[0].set(jnp.nan))))
    refuses(ValueError, "hold non-finite coordinates", jfrnn.run_chunk, lost, x, nbrs, lambda x: x)
    refuses(ValueError, "hold non-finite coordinates", nbrs.grow, x.at[0].set(jnp.nan))
    flat = jax.jit(lambda x, n: (x, n.update(x, box=jfrnn.Box(0 * x[0]))))
    with pytest.raises(ValueError, match=r"lengths of periodic axes must be positive, got \[0.0, 0.0, 0.0\]"):
        jfrnn.run_chunk(flat, x, nbrs, lambda x: x)
