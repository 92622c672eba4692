"""`include_self`: every particle that is there is its own neighbor, also where its own cutoff, or that of its species, is 0."""

from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow

import jfrnn

N, CAPACITY = 48, 64
BOXES = {
    "open": None,
    "nearest": jfrnn.Box([2.0, 2.5, 3.0]),
    "images": jfrnn.Box([0.7, 1.1, 0.8]),
    "skewed": jfrnn.Box([[2.0, 0.0, 0.0], [0.5, 2.0, 0.0], [-0.3, 0.4, 2.2]]),
    "systems": jfrnn.Box([[2.0, 2.5, 3.0], [0.7, 1.1, 0.8]], per_system=True),
}
WHO = ("gather", "scatter", "either", "both", "species")


def scene(who, dtype):
    """Return positions with one that is not finite, and cutoffs: a third of them 0, or a species that has no neighbors."""
    rng = np.random.default_rng(5)
    x = rng.random((N, 3)).astype(dtype)
    x[1] = x[0]
    x[7] = np.nan
    if who == "species":
        table = np.array([[0.0, 0.0, 0.0], [0.0, 0.25, 0.3], [0.0, 0.3, 0.0]], dtype)
        return x, table, {"species": rng.integers(0, 3, N).astype(np.int32)}
    return x, np.where(rng.random(N) < 0.4, 0, rng.uniform(0.1, 0.3, N)).astype(dtype), {"radius_rule": who}


def each_pair(who, x, cutoff, more, kind, batch, closed):
    """Return the pairs of the oracle, and every finite particle with itself."""
    box, found = BOXES[kind], {(i, i, (0, 0, 0)) for i in range(N) if np.isfinite(x[i]).all()}
    for system in range(2 if kind == "systems" else 1):
        members = np.flatnonzero(batch == system) if kind == "systems" else np.arange(N)
        vectors = None if box is None else np.asarray(box.vectors)
        vectors = vectors[system] if kind == "systems" else vectors
        matrix = np.diag([9.0] * 3) if box is None else vectors if vectors.ndim == 2 else np.diag(vectors)
        options = {"matrix": matrix.astype(x.dtype), "periodic": (box is not None,) * 3}
        of = more["species"][members] if who == "species" else None
        for reach in np.unique(cutoff[cutoff > 0]):  # pairs with each cutoff, by the oracle of one
            near = reference.reference_images(x[members], float(reach), closed=closed, **options)
            for i, j, shift in near:
                own, other = (of[i], of[j]) if who == "species" else (cutoff[members[i]], cutoff[members[j]])
                rules = {"gather": own, "scatter": other, "either": max(own, other), "both": min(own, other)}
                mine = cutoff[own, other] if who == "species" else rules[who]
                if mine == reach:
                    found.add((int(members[i]), int(members[j]), shift))
    return found


ALL = {"half", "edges", "sums", "sums of a list"}
OFTEN = {
    ("either", "systems", "warp", np.float32): {"sums"},
    ("species", "images", "warp", np.float32): {"half", "sums of a list"},
    ("both", "open", "jax", np.float64): {"sums"},
}


def each_kind():
    """Yield who, box, engine and dtype, and what is asked besides a list: by default something in each case, by hand everything."""
    for who, kind, backend, dtype in product(WHO, BOXES, ("warp", "jax", "brute"), (np.float32, np.float64)):
        name = f"{who}-{kind}-{backend}-{dtype.__name__}"
        if (who, kind, backend, dtype) in OFTEN:
            yield pytest.param(who, kind, backend, dtype, OFTEN[who, kind, backend, dtype], id=name)
        parts = ALL - {"half"} if who in ("gather", "scatter") else ALL
        yield slow(who, kind, backend, dtype, parts, id=f"{name}-all")


def one(r, i, j):
    return jnp.ones((), r.dtype)


@pytest.mark.parametrize(("who", "kind", "backend", "dtype", "parts"), list(each_kind()))
def test_everyone_is_its_own_neighbor(who, kind, backend, dtype, parts):
    x, cutoff, more = scene(who, dtype)
    batch = np.arange(N, dtype=np.int32) % 2
    given = {"box": BOXES[kind], "include_self": True, "backend": backend} | more
    given |= {"batch": batch} if kind == "systems" else {}
    expected = each_pair(who, x, cutoff, more, kind, batch, False)
    counts, total = np.bincount([i for i, *_ in expected], minlength=N), len(expected)

    def listed(x, cutoff, **options):
        nbrs = jfrnn.search(x, cutoff, capacity=CAPACITY, **options, **given)
        return nbrs, nbrs.shifts(x), nbrs.vectors(x)[1]

    def edges(x, cutoff):
        return jfrnn.search_edges(x, cutoff, total=total + 5, **given).edges(x).pair_count

    @jax.jit
    def find(x, cutoff):
        full = listed(x, cutoff)
        each = {
            "half": lambda: listed(x, cutoff, half=True),
            "edges": lambda: edges(x, cutoff),
            "sums": lambda: jfrnn.pair_sum(one, x, cutoff, **given),
            "sums of a list": lambda: jfrnn.pair_sum(one, x, None, neighbors=full[0]),
        }
        return full, {name: each[name]() for name in parts}

    (nbrs, shifts, mask), found = find(x, cutoff)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE
    for held in (mask, np.asarray(nbrs.idx) < N):
        assert checked.slots_as_set(nbrs.idx, held, shifts) == expected
    np.testing.assert_array_equal(nbrs.count, counts)
    there = np.isfinite(x).all(axis=1)
    for name in parts & {"sums", "sums of a list"}:
        np.testing.assert_array_equal(np.asarray(found[name])[there], counts[there])
    if "edges" in parts:
        assert found["edges"] == total
    if "half" in parts:
        half, shifts, mask = found["half"]
        mirrored = {(i, j, s) for i, j, s in expected if i < j or (i == j and s >= (0, 0, 0))}
        assert checked.slots_as_set(half.idx, mask, shifts) == mirrored


@pytest.mark.parametrize(("who", "flat"), [("gather", False), *(slow(*k) for k in product(WHO, (False, True)))])
def test_a_list_with_a_skin_keeps_them(who, flat):
    x, cutoff, more = scene(who, np.float32)
    given = {"include_self": True, "skin": 0.05, **more}
    nbrs = jfrnn.search_edges(x, cutoff, total=24 * N, **given) if flat else jfrnn.search(x, cutoff, capacity=24, **given)

    @jax.jit
    def updated(nbrs, x):
        nbrs = nbrs.update(x)
        return nbrs, nbrs.edges(x) if flat else nbrs.vectors(x)[1]

    for moved in (x, x + np.float32(0.001) * np.random.default_rng(1).normal(size=x.shape).astype(np.float32)):
        expected = {pair[:2] for pair in each_pair(who, moved, cutoff, more, "open", None, False)}
        after, found = updated(nbrs, moved)
        if flat:
            ends = (np.asarray(part)[np.asarray(found.mask)] for part in (found.receivers, found.senders))
            assert checked.as_set(*ends) == expected
        else:
            assert checked.slots_as_set(after.idx, found) == expected


def test_separate_queries_have_no_self():
    x, cutoff, _ = scene("gather", np.float32)
    refuses(ValueError, "include_self=True", jfrnn.search, x, cutoff, queries=x, include_self=True)
    assert jfrnn.count(x[:1], np.zeros(1, np.float32), queries=x[2:3])[0] == 0
