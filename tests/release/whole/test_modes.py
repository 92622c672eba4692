"""Every public verb under each of JAX's own modes: the same bits as without it, but floats where nothing is compiled."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses
from jax.experimental.compilation_cache import compilation_cache

import jfrnn

SLOW = pytest.mark.slow
MODES = {
    "debug_nans": lambda: jax.debug_nans(True),
    "disable_jit": jax.disable_jit,
    "rank_promotion": lambda: jax.numpy_rank_promotion("raise"),
    "transfer_guard": lambda: jax.transfer_guard("disallow"),
    "enable_checks": lambda: jax.enable_checks(True),
    "dtype_promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "checking_leaks": jax.checking_leaks,
}
N, M, CUTOFF = 12, 7, 0.7


@functools.cache
def given():
    """Return what all cases share, on the device before any mode is on."""
    rng = np.random.default_rng(0)
    points = {name: rng.uniform(0, 2, (size, 3)) for name, size in (("x", N), ("queries", M))}
    sizes = {"radii": N, "query_radii": M, "mass": N, "query_mass": M}
    points |= {name: rng.uniform(0.3, 0.9, size) for name, size in sizes.items()}
    points |= {"vertices": 2 * np.concatenate([np.zeros((1, 3)), np.eye(3)]), "origin": np.zeros(3)}
    points |= {"lengths": np.full(3, 2.0), "small": np.ones(3), "skewed": np.array([[2.0, 0, 0], [0.3, 2, 0], [0, 0.2, 2]])}
    arrays = {name: jnp.asarray(value, np.float32) for name, value in points.items()}
    active = np.arange(N) % 4 != 1
    arrays |= {"active": jnp.asarray(active), "batch": jnp.asarray(np.arange(N) % 2), "query_batch": jnp.asarray(np.arange(M) % 2)}
    arrays["hidden"] = jnp.asarray(np.where(active[:, None], points["x"], np.nan), np.float32)
    arrays["faces"] = jnp.asarray([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    arrays["partners"] = jnp.asarray(np.arange(2 * N, dtype=np.int32).reshape(N, 2) % N)
    arrays["cells"] = jnp.asarray(rng.integers(0, 16, (N, 3)))
    return arrays


def options_of(names):
    """Return the keyword arguments that names stand for, separated by spaces."""
    g = given()
    table = {
        "box": {"box": lambda: jfrnn.Box(g["lengths"], origin=g["origin"])},
        "numbers": {"box": lambda: jfrnn.Box([2.0, 2.0, 2.0])},
        "images": {"box": lambda: jfrnn.Box(g["small"], origin=g["origin"])},
        "skewed": {"box": lambda: jfrnn.Box(g["skewed"], (True, True, False), origin=g["origin"])},
        "active": {"active": g["active"]},
        "skin": {"skin": 0.2},
        "half": {"half": True},
        "batch": {"batch": g["batch"]},
        "batches": {"batch": (g["batch"], g["query_batch"])},
        "queries": {"queries": g["queries"]},
    }
    chosen = {key: value for name in names.split() for key, value in table[name].items()}
    return {key: value() if key == "box" else value for key, value in chosen.items()}


def weight(r, i, j):
    return j * jnp.sum(r * r), i * r


def listed(names="", backend="warp", cutoff=CUTOFF, rule="gather", x="x"):
    """A list, and all that can be asked of it."""
    x, options = given()[x], options_of(names)
    nbrs = jfrnn.search(x, cutoff, backend=backend, radius_rule=rule, **options)
    nbrs.check()
    places = {key: options[key] for key in ("queries",) if key in options}
    now = places | {key: options[key] for key in ("active",) if key in options}
    total = 256
    asked = [nbrs.overflow, nbrs.pairs(), nbrs.csr(), nbrs.pairs(total), nbrs.csr(total), nbrs.require(total).status]
    asked += [nbrs.edges(x, total, **places), nbrs.pairs(total, positions=x, **places)]
    asked += [] if places or "active" in options else [nbrs.to_jraph(x, total)]  # hidden positions are not finite
    asked += [nbrs.vectors(x, **places), nbrs.distances(x, **places), nbrs.shifts(x, **places)]
    asked += [nbrs.rebuild_count] if "skin" in options else []
    return nbrs, nbrs.update(x, **now), nbrs.grow(x, **now), asked


def counted(names="", backend="warp", cutoff=CUTOFF, rule="gather", x="x"):
    return jfrnn.count(given()[x], cutoff, backend=backend, radius_rule=rule, **options_of(names))


def summed(names="", backend="warp", cutoff=CUTOFF, rule="gather", x="x", **options):
    options |= options_of(names) | ({"query_values": given()["query_mass"]} if "queries" in names else {})
    return jfrnn.pair_sum(weight, given()[x], cutoff, given()["mass"], backend=backend, radius_rule=rule, **options)


def differentiated(names="", backend="warp", cutoff=CUTOFF, rule="gather", **options):
    """Gradients of sums; in jit, because that of JAX alone makes a transfer of its own."""
    options |= options_of(names) | ({"query_values": given()["query_mass"]} if "queries" in names else {})

    def loss(x):
        total, along = jfrnn.pair_sum(weight, x, cutoff, given()["mass"], backend=backend, radius_rule=rule, **options)
        return jnp.sum(jnp.where(jnp.isfinite(total), total, 0)) + jnp.sum(jnp.where(jnp.isfinite(along), along, 0) ** 2)

    return jax.jit(jax.grad(loss))(given()["x"])


def over_a_list(names, **options):
    """Sums over a list, and the gradients of sums and of distances."""
    x, mass = given()["x"], given()["mass"]
    nbrs = jfrnn.search(x, CUTOFF, **options_of(names))

    def loss(x):
        total, along = jfrnn.pair_sum(weight, x, None, mass, neighbors=nbrs, **options)
        return jnp.sum(total) + jnp.sum(along**2) + jnp.sum(nbrs.distances(x)[0])

    return jfrnn.pair_sum(weight, x, None, mass, neighbors=nbrs, **options), jax.jit(jax.grad(loss))(x)


def in_chunks():
    x = given()["x"]
    nbrs = jfrnn.search(x, CUTOFF, skin=0.2)
    chunk = jax.jit(lambda x, nbrs: (x, nbrs.update(x)))
    return jfrnn.run_chunk(chunk, x, nbrs, lambda x: x)


def in_jit():
    """A list leaves a program with all that it remembers."""
    search = functools.partial(jfrnn.search, cutoff=CUTOFF, skin=0.2, capacity=16)
    return jax.jit(lambda x, active: search(x, active=active))(given()["hidden"], given()["active"])


def wall(backend):
    x, vertices = given()["x"], given()["vertices"]
    tri = jfrnn.search_triangles(x, vertices, given()["faces"], 0.4, backend=backend)
    tri.check()
    return tri, tri.update(x), tri.update(x, vertices=vertices), tri.grow(x), tri.overflow


def distances_to_wall(backend):
    x = given()["x"]
    tri = jfrnn.search_triangles(x, given()["vertices"], given()["faces"], 0.4, backend=backend)
    losses = (lambda x: jnp.sum(tri.closest(x)[1])), (lambda x: jnp.sum(tri.signed_distance(x).distance))
    slopes = [jax.jit(jax.grad(loss)) for loss in losses]
    return tri.closest(x), tri.contacts(x), tri.signed_distance(x), [slope(x) for slope in slopes]


def ordered(curve):
    return jfrnn.sort_order(given()["x"], 0.3, curve=curve)


def encoded():
    cells, results = given()["cells"], []
    for bits in (5, 21):  # a word, and two
        keys = jfrnn.hilbert_encode(cells, bits), jfrnn.morton_encode(cells, bits)
        results += [keys, jfrnn.hilbert_decode(keys[0], 3, bits), jfrnn.morton_decode(keys[1], 3, bits)]
    return results


def flat():
    g = given()
    options = options_of("box") | {"exclude": jfrnn.pairs_of_rows(g["partners"])}
    found = jfrnn.search_edges(g["x"], CUTOFF, total=128, backend="warp", **options)
    return found, found.edges(g["x"])


def planned():
    plans = jfrnn.memory_plan(N, CUTOFF, 8, backend="warp"), jfrnn.memory_plan(N, CUTOFF, backend="jax")
    return [np.array(plan.total_bytes) for plan in plans]


def with_radii(verb, rule, names="", backend="warp"):
    g = given()
    cutoff = (g["radii"], g["query_radii"]) if "queries" in names else g["radii"]
    return verb(names, backend, cutoff, rule)


CASES = {
    "search": listed,
    "search box skin active": lambda: listed("box skin active", x="hidden"),
    "count": counted,
    "pair_sum active": lambda: (summed("active", x="hidden"), differentiated("active")),
    "sort_order hilbert": lambda: ordered("hilbert"),
    "codes": encoded,
}
SLOW_CASES = {
    "search_edges box exclude": flat,
    "search numbers": lambda: listed("numbers"),
    "search skewed": lambda: listed("skewed"),
    "search images half": lambda: listed("images half"),
    "search batches of queries": lambda: listed("queries batches active", x="hidden"),
    "search radii": lambda: with_radii(listed, "either", "box skin active"),
    "search radii of queries": lambda: with_radii(listed, "mean", "queries"),
    "search jax": lambda: listed("skewed batch", "jax"),
    "search brute": lambda: listed("batch active", "brute"),
    "search hashgrid": lambda: listed("", "hashgrid"),
    "count box": lambda: counted("box"),
    "count radii": lambda: with_radii(counted, "gather", "images", "jax"),
    "pair_sum skewed": lambda: (summed("skewed"), differentiated("skewed")),
    "pair_sum batches of queries": lambda: (summed("queries batches"), differentiated("queries batches")),
    "pair_sum radii": lambda: (with_radii(summed, "both", "box"), with_radii(differentiated, "gather", "box")),
    "pair_sum jax": lambda: (summed("box", "jax"), differentiated("box", "jax")),
    "pair_sum max": lambda: (summed("box", reduce="max"), differentiated("box", reduce="max")),
    "pair_sum compensated": lambda: summed(compensated=True, symmetry=None),
    "pair_sum over a list": lambda: over_a_list("images half"),
    "pair_sum max over a list": lambda: over_a_list("box", reduce="min"),
    "run_chunk": in_chunks,
    "search in jit": in_jit,
    "triangles warp": lambda: wall("warp"),
    "triangles bvh": lambda: wall("bvh"),
    "triangles jax": lambda: wall("jax"),
    "distances to triangles": lambda: distances_to_wall("bvh"),
    "sort_order morton": lambda: ordered("morton"),
    "sort_order row": lambda: ordered("row"),
    "memory_plan": planned,
    "merge_vertices": lambda: jfrnn.merge_vertices(given()["vertices"], given()["faces"]),
}
BY_HAND = {"disable_jit": ("search", "search box skin active", "pair_sum active")}  # each primitive is a program of its own
FAST_TOO = {  # what failed in a mode, and costs little
    ("debug_nans", "search in jit"),
    ("debug_nans", "triangles warp"),
    ("transfer_guard", "search numbers"),
    ("transfer_guard", "triangles warp"),
    ("transfer_guard", "run_chunk"),
    ("rank_promotion", "count box"),
}


def products():
    for mode in MODES:
        for name in (*CASES, *SLOW_CASES):
            if (mode, name) == ("disable_jit", "memory_plan"):
                continue  # it asks the compiled program, which is another one in this mode
            fast = (name in CASES and name not in BY_HAND.get(mode, ())) or (mode, name) in FAST_TOO
            yield pytest.param(mode, name, marks=() if fast else SLOW, id=f"{mode}-{name}")


@pytest.fixture(scope="module", autouse=True)
def _programs_in_a_folder(tmp_path_factory):
    """Most modes are part of the key of JAX's cache in memory, but not of the program: it is compiled once for all of them."""
    names = {"jax_compilation_cache_dir": str(tmp_path_factory.mktemp("programs"))}
    names |= {"jax_persistent_cache_min_compile_time_secs": 0, "jax_persistent_cache_min_entry_size_bytes": -1}
    before = {name: getattr(jax.config, name) for name in names}
    for settings in (names, before):
        for name, value in settings.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        if settings is names:
            yield


@functools.cache
def plain(name):
    """Return what a case gives without a mode, where promotion is as JAX has it by itself."""
    with jax.numpy_dtype_promotion("standard"):
        return leaves_of((CASES | SLOW_CASES)[name]())


def leaves_of(result):
    return [(str(jax.tree_util.keystr(path)), np.asarray(leaf)) for path, leaf in jax.tree_util.tree_leaves_with_path(result)]


@pytest.mark.parametrize(("mode", "name"), list(products()))
def test_same_bits_in_a_mode(mode, name):
    expected = plain(name)
    given()
    with MODES[mode]():
        result = (CASES | SLOW_CASES)[name]()
    found = leaves_of(result)
    assert [path for path, _ in found] == [path for path, _ in expected]
    for (path, one), (_, other) in zip(found, expected):
        assert (one.dtype, one.shape) == (other.dtype, other.shape), path
        # A program may join products and sums, and add in another order, than primitives one by one.
        if mode == "disable_jit" and np.issubdtype(one.dtype, np.floating):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6, err_msg=path)
        else:
            assert one.tobytes() == other.tobytes(), path


def test_every_public_name_is_in_a_mode():
    """What this file knows of: a function that is new is added to a table above."""
    asked = {name.split()[0] for name in CASES | SLOW_CASES}
    asked |= {
        "pairs_of_rows",
        "search_triangles",
        *(f"{curve}_{way}code" for curve in ("hilbert", "morton") for way in ("en", "de")),
    }
    functions = {name for name in jfrnn.__all__ if not isinstance(getattr(jfrnn, name), type)}
    assert sorted(functions - asked) == []


@pytest.mark.parametrize(("guard", "x"), [("disallow", np.zeros((4, 3), np.float32)), ("disallow_explicit", given()["x"])])
def test_guards_against_transfers_are_kept(guard, x):
    """One still finds those of the caller, whose arrays of NumPy are his to move; one forbids explicit ones, too."""
    with jax.transfer_guard(guard), pytest.raises(Exception, match="Disallowed host-to-device transfer"):
        jfrnn.count(x, CUTOFF)


@pytest.mark.parametrize("dtype", [np.int8, np.uint32, np.int64])
def test_faces_of_any_integers(dtype):
    """On the device they stay there; what names no vertex is told, whatever the type."""
    faces = np.array(given()["faces"])
    faces[3] = [0, 1, 100]
    for kind in (np.asarray, jnp.asarray):
        tri = jfrnn.search_triangles(given()["x"], given()["vertices"], kind(faces.astype(dtype)), 0.4, capacity=4)
        np.testing.assert_array_equal(tri.faces[:3], faces[:3])
        refuses(ValueError, "faces", tri.check)
