"""Octaves of cutoffs: each pair belongs to one part, whose cells are as wide as its cutoff, and no wider than they have to be."""

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jfrnn._geometry.cutoffs import RULES, Radii, make_cutoffs
from jfrnn._geometry.octaves import OCTAVES, parts_of

NUMBER, QUERIES = 60, 40


def some_cutoffs(rng, number, largest):
    """Return cutoffs over more octaves than there are, some of which are powers of two, or 0."""
    drawn = largest * 2.0 ** -rng.uniform(0, OCTAVES + 4, number)
    drawn[:10] = largest * 2.0 ** -rng.integers(0, OCTAVES, 10)
    drawn[10:12] = 0
    return drawn.astype(np.float32)


@pytest.mark.parametrize("rule", [checked.slow(rule) if rule in ("gather", "scatter", "both") else rule for rule in RULES])
def test_each_pair_belongs_to_one_part(rule):
    rng = np.random.default_rng(5)
    sources, queries = some_cutoffs(rng, NUMBER, 3.0), some_cutoffs(rng, QUERIES, 2.0)
    used = [None if rule == "gather" else jnp.asarray(sources), None if rule == "scatter" else jnp.asarray(queries)]
    cutoffs = make_cutoffs(Radii(*used, rule), False)
    there = rng.random(NUMBER) < 0.9, rng.random(QUERIES) < 0.9
    parts = parts_of(cutoffs, *map(jnp.asarray, there))
    decisive = {
        "gather": np.broadcast_to(queries[:, None], (QUERIES, NUMBER)),
        "scatter": np.broadcast_to(sources, (QUERIES, NUMBER)),
        "either": np.maximum(queries[:, None], sources),
        "both": np.minimum(queries[:, None], sources),
        "mean": np.maximum(queries[:, None], sources),
    }[rule]
    met, number, scales = np.zeros((QUERIES, NUMBER), int), parts.after(-1), []
    part = jax.jit(lambda number: parts.part(number, np.dtype(np.float32)))
    while number < parts.end:
        found = part(number)
        held = np.asarray(found.queries)[:, None] & np.asarray(found.sources)
        width = cutoffs.largest * found.scale
        assert (decisive[held] <= width).all()
        assert (decisive[held] > 0.499 * width).all() or float(found.scale) == 2.0 ** (1 - OCTAVES)
        met += held
        scales.append(float(found.scale))
        number = parts.after(number)
    np.testing.assert_array_equal(met, there[1][:, None] & there[0])
    assert scales == sorted(scales, reverse=True)


def test_cutoffs_within_a_factor_of_two_are_one_part():
    some = np.random.default_rng(6).uniform(0.5, 1, 50)
    radii = jnp.asarray(np.append(some, [np.nextafter(np.float32(0.5), np.float32(0)), 1]), jnp.float32)
    for rule in RULES:
        used = [None if rule == "gather" else radii, None if rule == "scatter" else radii]
        parts = parts_of(make_cutoffs(Radii(*used, rule), False), *[jnp.ones(52, bool)] * 2)
        assert parts.after(-1) == 0
        assert parts.after(0) == parts.end
