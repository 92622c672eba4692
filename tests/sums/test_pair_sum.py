"""`pair_sum`: the pairs of the oracle, summed; its derivatives against those of the oracle's sum; and what must not matter."""

import functools
from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import add_up, in_order
from checked import refuses, slow, slowly, sparing
from marked import assert_compensated, assert_marks, cancelling
from marked import marks as marks_of_floats

import jfrnn
from jfrnn._engine import tuning as _tuning
from jfrnn._sums import relations as _relations
from jfrnn._sums import summation as _summation
from jfrnn.cases.batches import BATCH_CASES
from jfrnn.cases.hard import HARD_CASES

LENGTH = 704  # so that cases share compiled programs


def oracle_sum(fn, pairs, x, q, own, others):
    """Sum fn, which returns columns [pairs, c], over these pairs by NumPy, in float64."""
    i, j, _ = in_order(pairs, x.shape[1])
    x, q, own, others = (np.asarray(a, np.float64) for a in (x, q, own, others))
    return add_up(fn(x[j] - q[i], own[i], others[j]), i, len(q))


# --- the pairs are those of the oracle ---------------------------------------------------------------------------------------


def marks(r, i, j):
    """Tell pairs apart: whole numbers, which no order of summation rounds, and the displacement."""
    return {"count": 1, "ids": j, "squares": j * j, "rows": i, "r": r}


def marked_sums(x, cutoff, queries=None, length=LENGTH, **options):
    fn, kind = (marks_of_floats, x.dtype) if options["backend"] == "warp" else (marks, np.int32)  # kernels sum floats alone
    ids = np.arange(length, dtype=kind)
    x = jnp.asarray(checked.padded(np.asarray(x), length))
    if queries is not None:
        options |= {"queries": jnp.asarray(checked.padded(np.asarray(queries), length)), "query_values": ids}
    return jfrnn.pair_sum(fn, x, cutoff, ids, **options)


@jax.jit
def listed_marks(x, nbrs):
    return jfrnn.pair_sum(marks, x, None, jnp.arange(len(x), dtype=jnp.int32), neighbors=nbrs)


def has_no_sum(x):
    x = np.asarray(x)
    return np.isnan(x) if np.issubdtype(x.dtype, np.floating) else x == np.iinfo(x.dtype).min


HARD = ["lattice_1_at_1e4", "dyadic_ties", "ulp_negative", "mixed_exponents", "far_1e8", "all_coincident", "clumps_near_max", "n_1"]
LONG = {"mixed_exponents", "clumps_near_max"}  # for array programs: the one takes seconds to run, the other a program of its own
KINDS = [
    pytest.param("warp", np.float32, 3, HARD, id="warp-f32-3d"),
    pytest.param("warp", np.float64, 2, HARD, id="warp-f64-2d"),
    slow("warp", np.float32, 2, HARD, id="warp-f32-2d"),
    slow("warp", np.float64, 3, HARD, id="warp-f64-3d"),
    pytest.param("jax", np.float32, 3, [name for name in HARD if name not in LONG], id="jax-f32-3d"),
    slow("jax", np.float32, 3, sorted(LONG), id="jax-f32-3d-long"),
    slow("brute", np.float64, 2, HARD, id="brute-f64-2d"),
    slow("jax", np.float64, 2, HARD, id="jax-f64-2d"),
    slow("jax", np.float64, 3, HARD, id="jax-f64-3d"),
    slow("brute", np.float32, 3, HARD, id="brute-f32-3d"),
]


@pytest.mark.parametrize(("backend", "dtype", "dim", "names"), KINDS)
def test_hard_cases(backend, dtype, dim, names):
    for name in names:
        given = HARD_CASES[name].build(dtype, dim)
        sums = marked_sums(given.positions, given.cutoff, backend=backend)
        assert_marks(sums, reference.reference_pairs(given.positions, given.cutoff), given.positions)


@pytest.mark.parametrize("backend", ["warp", "brute", slow("jax")])
def test_options(backend):
    """Several systems, of particles that are active or not, closed, with themselves; each where it decides something."""
    given, options = BATCH_CASES["ties"].build(np.float32, 3), {"closed": True, "include_self": True}
    batch, n = given.batch, len(given.positions)
    active = np.arange(n) % 3 > 0
    sums = marked_sums(given.positions, given.cutoff, length=n, batch=batch, active=active, backend=backend, **options)
    pairs, found = (reference.reference_pairs(given.positions, given.cutoff, **kind) for kind in (options, {}))
    pairs = {(i, j) for i, j in pairs if active[i] and active[j]}
    together = {(i, j) for i, j in pairs if batch[i] == batch[j]}
    assert len(pairs) > len(together) > len(together & found) + active.sum()
    assert_marks(sums, together, given.positions)


@pytest.mark.parametrize("backend", ["warp", slow("brute"), slow("jax")])
def test_queries_of_active_particles(backend):
    given = HARD_CASES["queries_coincident"].build(np.float32, 3)
    active = np.arange(LENGTH) % 3 > 0
    sums = marked_sums(given.positions, given.cutoff, given.queries, active=active, backend=backend)
    pairs = reference.reference_pairs(given.positions, given.cutoff, queries=given.queries)
    assert_marks(sums, {(i, j) for i, j in pairs if active[j]}, given.positions, given.queries)


@pytest.mark.parametrize(("n", "m"), [(0, None), (0, 3), (3, 0), (1, None)])
def test_empty(n, m):
    """By array programs, which sum integers, too, and by kernels."""
    x, ids = np.zeros((n, 2), np.float32), np.arange(n, dtype=np.int32)
    options = {} if m is None else {"queries": np.zeros((m, 2), np.float32), "query_values": np.arange(m, dtype=np.int32)}

    @jax.jit
    def everything_of(x):
        low = jfrnn.pair_sum(lambda r, i, j: r[0], x, 1.0, ids, reduce="max", **options)
        slopes = jax.grad(lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 1.0, ids, **options).sum())(x)
        floats = jfrnn.pair_sum(lambda r, i, j: {"r": r, "j": j.astype(r.dtype)}, x, 1.0, ids, backend="warp", **options)
        return (jfrnn.pair_sum(marks, x, 1.0, ids, backend="brute", **options), floats), low, slopes

    sums, low, slopes = everything_of(x)
    assert {each["r"].shape for each in sums} == {(n if m is None else m, 2)}
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(sums))
    assert (np.asarray(low) == -np.inf).all()
    assert slopes.shape == x.shape


# --- derivatives -------------------------------------------------------------------------------------------------------------

N = 60
CUTOFF = 0.5
ENGINES = [("list", True), ("brute", False)]  # on the latter, second derivatives are made of the same parts, and compile slowly
ENGINES += [slow(*engine) for engine in (("jax", False), ("brute", True), ("jax", True))]


def scene(seed, dim=2):
    """Return points with pairs at exactly the cutoff, coincident and lonely ones, or (seed > 0) random ones; and their masses."""
    random = np.random.default_rng(seed)
    if seed == 0:
        lattice = np.stack(np.meshgrid(*[np.arange(4) * 0.25] * 2), axis=-1).reshape(-1, 2)
        x = np.concatenate([lattice, lattice[:8], 1 + random.random((N - 25, 2)), [[9.0, 9.0]]])
        x = np.concatenate([x, np.zeros((N, dim - 2))], axis=1)
    else:
        x = random.random((N, dim)) * 1.5
    return jnp.asarray(x), jnp.asarray(0.5 + random.random(N))


def smooth(scale, r, i, j):
    """A function of pairs without any symmetry, differentiable everywhere, not zero at the cutoff."""
    s = r @ r
    return {"a": scale * j["m"] * jnp.exp(-s), "b": i["m"] * j["m"] ** 2 * (scale + s) * r}


def smooth_slopes(scale, r, i, j):
    """Return what `smooth` is, in columns [pairs, c], and its derivatives by r [pairs, c, d], by i, by j and by scale."""
    s = (r * r).sum(1)[:, None]
    i, j, decay, axes = i[:, None], j[:, None], np.exp(-s), np.eye(r.shape[1])
    a, b = scale * j * decay, i * j**2 * (scale + s) * r
    of_b = (i * j**2)[..., None] * ((scale + s)[..., None] * axes + 2 * r[:, :, None] * r[:, None, :])
    by_r = np.concatenate([(-2 * a * r)[:, None], of_b], axis=1)
    others = (a, b), (0 * a, b / i), (scale * decay, 2 * b / j), (j * decay, i * j**2 * r)
    values, *by_numbers = (np.hstack(columns) for columns in others)
    return values, by_r, *by_numbers


def stepped(fn):
    """Return what a function of NumPy's numbers is, [pairs, c], and its derivatives by complex steps, which lose no digit."""
    step = 1e-30

    def slopes(scale, r, i, j):
        by_r = [fn(scale, r + 1j * step * axis, i, j).imag / step for axis in np.eye(r.shape[1])]
        others = (fn(*given).imag / step for given in ((scale, r, i + 1j * step, j), (scale, r, i, j + 1j * step)))
        return fn(scale, r, i, j), np.stack(by_r, axis=2), *others, fn(scale + 1j * step, r, i, j).imag / step

    return slopes


def oracle(slopes, pairs, args, along=None, *, scale=1.0):
    """Return what `everything` does, by NumPy in float64: value and gradient, and with `along` the Hessian-vector product.

    `args` are named: x, m, those of queries q and w (else x and m), scale, and of a box matrix or lengths.
    """

    def gradient(args):
        x, m = args["x"], args["m"]
        q, w = args.get("q", x), args.get("w", m)
        i, j, shifts = in_order(pairs, x.shape[1])
        matrix = np.diag(args["lengths"]) if "lengths" in args else args.get("matrix", np.zeros((x.shape[1],) * 2))
        values, by_r, by_i, by_j, by_scale = slopes(args.get("scale", scale), x[j] - q[i] + shifts @ matrix, w[i], m[j])
        sums, weight = add_up(values, i, len(q)), np.arange(1.0, 1 + len(q))[:, None] / N
        pull = (np.cos(sums) * weight)[i]
        of_r, of_i, of_j = np.einsum("pc,pck->pk", pull, by_r), (pull * by_i).sum(1), (pull * by_j).sum(1)
        found = {"x": add_up(of_r, j, len(x)), "q": add_up(-of_r, i, len(q)), "m": add_up(of_j, j, len(m))}
        found |= {"w": add_up(of_i, i, len(w)), "scale": (pull * by_scale).sum(), "matrix": shifts.T @ of_r}
        found["lengths"] = np.diag(found["matrix"])
        for own, other in (("q", "x"), ("w", "m")):
            found[other] = found[other] + (0 if own in args else found[own])
        return (np.sin(sums) * weight).sum(), tuple(found[name] for name in args)

    args = {name: np.asarray(x, np.float64) for name, x in args.items()}
    step = 1e-30
    product = None
    if along is not None:
        moved = {name: x + 1j * step * np.asarray(t) for (name, x), t in zip(args.items(), along, strict=True)}
        product = tuple(g.imag / step for g in gradient(moved)[1])
    return *gradient(args), product


def everything(sums, second=True):
    """Return a function of arguments and tangents: value, gradient and Hessian-vector product of sums, in all arguments."""

    def loss(*args):
        weight = jnp.arange(1.0, 1 + 2 * N) / N
        return sum(jnp.sum(jnp.sin(leaf).T * weight[: len(leaf)]) for leaf in jax.tree.leaves(sums(*args)))

    def derivatives(args, along):
        def slope(*args):
            return jax.jvp(loss, args, along)[1]

        value, gradient = jax.value_and_grad(loss, range(len(args)))(*args)
        return value, gradient, jax.grad(slope, range(len(args)))(*args) if second else None

    return jax.jit(derivatives)


def tangents_of(args, seed=5):
    random = np.random.default_rng(seed)
    return tuple(jnp.asarray(random.standard_normal(np.shape(x)), x.dtype) for x in args)


def moved(args, along, step):
    """Return arguments a step along their tangents, by NumPy."""
    return tuple(jnp.asarray(np.asarray(x) + step * np.asarray(t)) for x, t in zip(args, along, strict=True))


def assert_same(found, expected, tolerance=1e-12):
    for got, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert got.dtype == wanted.dtype
        np.testing.assert_allclose(got, wanted, rtol=0, atol=tolerance * max(1e-9, float(np.abs(wanted).max())))
        assert float(np.abs(wanted).max()) > 0


@pytest.mark.parametrize("backend", ["list", "warp", slow("brute"), slow("jax")])
def test_derivatives(backend):
    """Of coincident points, at ties, in empty rows; then of random points, where finite differences exist as well."""
    nbrs = [jfrnn.search(scene(seed)[0], CUTOFF, capacity=48, backend="warp") for seed in (0, 1)]
    options = {} if backend == "list" else {"backend": backend}

    def sums(nbrs):
        given = options or {"neighbors": nbrs}
        return lambda x, m, s: jfrnn.pair_sum(functools.partial(smooth, s), x, CUTOFF, {"m": m}, **given)

    found = jax.jit(lambda args, along, nbrs: everything(sums(nbrs))(args, along))
    for seed in (0, 1):
        args = (*scene(seed), jnp.asarray(1.3))
        along, pairs = tangents_of(args), reference.reference_pairs(args[0], CUTOFF)
        value, gradient, product = found(args, along, nbrs[seed])
        expected = oracle(smooth_slopes, pairs, dict(zip(("x", "m", "scale"), args)), along)
        assert_same((value, gradient, product), expected)
    step = 1e-6
    ahead, behind = (found(moved(args, along, s), along, nbrs[1]) for s in (step, -step))
    slope = sum(np.vdot(g, t) for g, t in zip(gradient, along, strict=True))
    assert float(ahead[0] - behind[0]) / (2 * step) == pytest.approx(slope, rel=1e-6)
    for up, down, wanted in zip(ahead[1], behind[1], product, strict=True):
        difference = (np.asarray(up) - np.asarray(down)) / (2 * step)
        np.testing.assert_allclose(difference, wanted, atol=1e-5 * float(np.abs(wanted).max()))


def test_third_derivatives():
    """By reverse over reverse over reverse, over a list, which compiles soon."""
    x, m = scene(1)
    nbrs = jfrnn.search(x, CUTOFF, backend="warp")
    weight, along = np.arange(1.0, 1 + N)[:, None], tangents_of((x,))[0]

    @jax.jit
    def third(x, nbrs):
        def first(x):
            sums = jfrnn.pair_sum(functools.partial(smooth, 1.3), x, None, {"m": m}, neighbors=nbrs)
            return (sums["b"] * weight).sum()

        def second(x):
            return jax.grad(lambda x: jnp.vdot(jax.grad(first)(x), along))(x)

        return jax.grad(lambda x: jnp.vdot(second(x), along))(x)

    i, j, _ = in_order(reference.reference_pairs(x, CUTOFF), 2)
    step, masses = np.asarray(along)[j] - np.asarray(along)[i], np.asarray(m)
    turned = 4 * step.sum(1, keepdims=True) * step + 2 * (step**2).sum(1, keepdims=True)  # of s r, summed over its components
    terms = (masses[i] * masses[j] ** 2)[:, None] * weight[i] * turned
    assert_same(third(x, nbrs), add_up(terms, j, N) - add_up(terms, i, N))


@pytest.mark.parametrize("rule", ["scatter", slow("gather"), slow("mean")])
@pytest.mark.parametrize(("backend", "second"), [slow(*ENGINES[0]), ENGINES[1]])
def test_derivatives_with_queries_and_radii(backend, second, rule):
    """The reversed pairs are those of the other rule; values of queries and of positions are apart."""
    (x, m), q = scene(1), jnp.asarray(np.asarray(scene(2)[0])[:23])
    h, of_queries = jnp.asarray(0.2 + 0.4 * np.asarray(m)), jnp.asarray(np.linspace(0.3, 0.6, 23))
    cutoff = {"scatter": h, "gather": of_queries}.get(rule, (h, of_queries))
    options = {"queries": q, "radius_rule": rule}
    fn = functools.partial(smooth, 0.7)
    nbrs = jfrnn.search(x, cutoff, backend="warp", **options) if backend == "list" else None
    searched = {"radius_rule": rule, "backend": backend}

    def sums(x, q, m, w):
        given = {"neighbors": nbrs} if backend == "list" else searched
        wanted = None if backend == "list" else cutoff
        return jfrnn.pair_sum(fn, x, wanted, {"m": m}, query_values={"m": w}, queries=q, **given)

    pairs = reference.reference_radii(x, h, rule, queries=q, query_radii=of_queries)
    args = (x, q, m, of_queries)
    along = tangents_of(args)
    expected = oracle(smooth_slopes, pairs, dict(zip("xqmw", args)), along if second else None, scale=0.7)
    assert_same(everything(sums, second)(args, along), expected)


MATRIX = np.array([[0.45, 0.1, 0.0], [-0.1, 1.1, 0.1], [0.0, 0.0, 9.0]])
PERIODIC = (True, True, False)


IN_A_BOX = [("warp", False), ("brute", False), *((way, True) for way in ("list", "half", "flat", "flat half", "jax", "warp"))]


@pytest.mark.parametrize(("backend", "second"), sparing(IN_A_BOX, IN_A_BOX[:1]))
def test_derivatives_in_a_box(backend, second):
    """Several images of a pair, own ones too, turns of particles; derivatives in the lattice vectors, and finite differences."""
    (x, m), fn, turns = scene(1, dim=3), functools.partial(smooth, 0.7), np.arange(N)[:, None]
    x = jnp.asarray(np.asarray(x) + (turns % 5 - 2) * MATRIX[0] - turns % 3 * MATRIX[1])
    pairs = reference.reference_images(x, CUTOFF, matrix=MATRIX, periodic=PERIODIC)
    assert any(i == j for i, j, _ in pairs)

    def sums(x, m, matrix):
        box = jfrnn.Box(matrix, PERIODIC, images=2)
        searched = {"backend": backend} if backend in ("warp", "brute", "jax") else {"neighbors": nbrs}
        return jfrnn.pair_sum(fn, x, CUTOFF, {"m": m}, box=box, **searched)

    find = jfrnn.search_edges if "flat" in backend else jfrnn.search
    longer = CUTOFF + 0.1 * ("flat" in backend)  # then some pairs of the list are none of the sum
    nbrs = find(x, longer, box=jfrnn.Box(MATRIX, PERIODIC, images=2), half="half" in backend, backend="warp")
    args = (x, m, jnp.asarray(MATRIX))
    along, found = (*tangents_of(args[:2]), jnp.asarray(MATRIX**2)), everything(sums, second)
    expected = oracle(smooth_slopes, pairs, dict(zip(("x", "m", "matrix"), args)), along if second else None, scale=0.7)
    value, gradient, product = found(args, along)
    assert_same((value, gradient, product), expected)
    ahead, behind = (found(moved(args, along, step), along)[0] for step in (1e-7, -1e-7))
    slope = sum(np.vdot(g, t) for g, t in zip(gradient, along, strict=True))
    assert float(ahead - behind) / 2e-7 == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("backend", ["jax", "list", slow("brute")])
def test_many_blocks(backend, monkeypatch):
    """Blocks of which the last reaches back, in sums over rows and over all pairs."""
    monkeypatch.setattr(_tuning, "CPU", _tuning.CPU._replace(words=64 * 25, few_pairs=0, plain_pairs=0))
    monkeypatch.setattr(_relations, "_LIST_SLOTS", 25 * 32 * 4)
    (x, m), weights = scene(0), np.arange(2.0)
    given = {"neighbors": jfrnn.search(x, CUTOFF, capacity=47, backend="brute")} if backend == "list" else {"backend": backend}

    def fn(weights, r, i, j):
        return j * jnp.tanh(weights @ r)

    def squares(x, weights):
        return (jfrnn.pair_sum(functools.partial(fn, weights), x, CUTOFF, m, **given) ** 2).sum()

    found = jax.jit(jax.grad(squares, (0, 1)))(x, weights)
    i, j, _ = in_order(reference.reference_pairs(x, CUTOFF), 2)
    positions, masses = np.asarray(x), np.asarray(m)
    r = positions[j] - positions[i]
    terms = masses[j] * np.tanh(r @ weights)
    pull = (2 * add_up(terms, i, N)[i] * masses[j] / np.cosh(r @ weights) ** 2)[:, None]
    expected = add_up(pull * weights, j, N) - add_up(pull * weights, i, N), (pull * r).sum(0)
    assert_same(found, expected)


def partly_active():
    """Return positions and masses, NaN where particles are not active, though some of these have positions, and who is active."""
    x, m = map(np.asarray, scene(1))
    active = np.arange(N) % 4 > 0
    x = np.where(active[:, None] | (np.arange(N) % 8 == 0)[:, None], x, np.nan)
    return jnp.asarray(x), jnp.asarray(np.where(active, m, np.nan)), active


@pytest.mark.parametrize("verb", ["sum", "distances", "update"])
def test_what_is_done_with_a_list_in_a_box_is_compiled_whole(verb, caplog):
    """Outside of `jax.jit`, operations that are called one by one took a sum over a list in a skewed box two seconds."""
    x = jnp.asarray(np.random.default_rng(7).random((40 + len(verb), 3)))
    nbrs = jfrnn.search(x, 0.2, skin=0.01, box=jfrnn.Box([[1.0, 0.0, 0.0], [0.2, 1.0, 0.0], [0.1, 0.1, 1.0]]))
    calls = {
        "sum": lambda: jfrnn.pair_sum(lambda r, i, j: r @ r, x, None, neighbors=nbrs),
        "distances": lambda: nbrs.distances(x),
        "update": lambda: nbrs.update(x),
    }
    with jax.log_compiles():
        jax.block_until_ready(calls[verb]())
    assert 1 <= caplog.text.count("Finished XLA compilation") <= 6


@pytest.mark.parametrize("backend", ["warp", slow("jax"), "brute"])
def test_sums_without_elements(backend):
    x = jnp.array([[0.0, 0], [0.5, 0], [-0.4, 0]])
    found = jfrnn.pair_sum(lambda r, i, j: {"none": jnp.zeros((2, 0), r.dtype), "r": r}, x, 1.0, backend=backend)
    assert found["none"].shape == (3, 2, 0)
    np.testing.assert_allclose(found["r"][:, 0], [0.1, -1.4, 1.3], rtol=1e-6)
    for reduce in ("sum", "max"):
        assert jfrnn.pair_sum(lambda r, i, j: jnp.zeros(0, r.dtype), x, 1.0, backend=backend, reduce=reduce).shape == (3, 0)


@pytest.mark.parametrize("backend", ["warp", slow("jax"), slow("brute")])
def test_particles_that_are_not_there_have_no_extreme(backend):
    """Nor have those of no system, where each system has a box."""
    x = np.random.default_rng(0).uniform(size=(6, 2))
    nowhere = np.array([False, False, True, False, False, True])
    in_boxes = {"box": jfrnn.Box(np.stack([np.eye(2)] * 2)), "batch": np.where(nowhere, -1, 0)}
    for given in ({"active": ~nowhere}, in_boxes):
        for reduce, none in (("max", -np.inf), ("min", np.inf)):
            found = jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.45, reduce=reduce, backend=backend, **given)
            np.testing.assert_array_equal(found[nowhere], none)
            others = found[~nowhere]
            assert np.all((others > 0) & (others < 0.45**2) | (others == none))


@pytest.mark.parametrize(
    ("backend", "second"), [("list", False), ("warp", False), *slowly(ENGINES[0], ("brute", False), ("jax", False))]
)
def test_what_is_no_pair_poisons_nothing(backend, second):
    """fn is NaN or infinite where there is no pair, and so are values and positions of inactive particles."""
    x, m, active = partly_active()
    given = {"active": active, "backend": backend}
    if backend == "list":
        given = {"neighbors": jfrnn.search(x, CUTOFF, active=active, capacity=50, backend="warp")}

    def fn(r, i, j):
        distance = jnp.sqrt(r @ r)
        term = jnp.log(distance) * jnp.sqrt(CUTOFF - distance)  # no number beyond the cutoff
        return i * j * term / (r[0] - CUTOFF / 2)  # infinite at the displacement that stands in for none

    def slopes(_, r, i, j):
        distance, away, i, j = np.sqrt((r * r).sum(1))[:, None], r[:, :1] - CUTOFF / 2, i[:, None], j[:, None]
        root, first = np.sqrt(CUTOFF - distance), np.array([1.0, 0.0])
        term, slope = np.log(distance) * root, root / distance - np.log(distance) / (2 * root)
        by_r = i * j * (slope * r / distance / away - term * first / away**2)
        return i * j * term / away, by_r[:, None], j * term / away, i * term / away, 0 * i

    pairs = {(i, j) for i, j in reference.reference_pairs(x, CUTOFF) if active[i] and active[j]}
    args, along = (x, m), tangents_of((x, m))
    found = everything(lambda x, m: jfrnn.pair_sum(fn, x, CUTOFF, m, **given), second)(args, along)
    assert_same(found, oracle(slopes, pairs, {"x": x, "m": m}, along if second else None), 1e-9)
    assert not np.asarray(found[1][0])[~active].any()


# --- symmetry, half lists, extremes, rounding --------------------------------------------------------------------------------


def one_sided(r, i, j):
    return r * i + jnp.sin(j)


def imposed(sign, pairs):
    """Return `one_sided` by NumPy, asked from the smaller index to the larger alone."""
    i, j, shifts = in_order(pairs, 3)
    ahead = ((i < j) | ((i == j) & np.array([tuple(s) >= (0, 0, 0) for s in shifts])))[:, None]

    def fn(_, r, i, j):
        i, j = i[:, None], j[:, None]
        return np.where(ahead, r * i + np.sin(j), sign * (np.sin(i) - r * j))

    return fn


@pytest.mark.parametrize(
    ("backend", "symmetry"),
    [
        *(("half", "antisymmetric"), ("list", "symmetric"), slow("brute", "antisymmetric")),
        *(slow(backend, "symmetric") for backend in ("half", "jax", "warp")),
    ],
)
def test_symmetry(backend, symmetry):
    x, m = scene(1, dim=3)
    box, options = jfrnn.Box(MATRIX, PERIODIC), {"include_self": True}
    pairs = reference.reference_images(x, CUTOFF, matrix=MATRIX, periodic=PERIODIC, include_self=True)
    options |= {"box": box, "backend": backend}
    if backend in ("list", "half"):
        nbrs = jfrnn.search(x, CUTOFF, box=box, half=backend == "half", include_self=True, capacity=128, backend="warp")
        options = {"neighbors": nbrs}
    args, along = (x, m), tangents_of((x, m))
    fn = stepped(imposed({"symmetric": 1, "antisymmetric": -1}[symmetry], pairs))
    found = everything(lambda x, m: jfrnn.pair_sum(one_sided, x, CUTOFF, m, symmetry=symmetry, **options), False)(args, along)
    value, gradient, _ = oracle(fn, pairs, {"x": x, "m": m, "matrix": MATRIX})
    assert_same(found, (value, gradient[:2]))


@pytest.mark.parametrize("options", [{"half": True}, {"half": True, "include_self": True}, {"skin": 0.2}], ids=str)
def test_lists_give_whole_sums(options):
    """Half lists, and one with a skin, which is cut at the cutoff."""
    x, _ = scene(0)
    nbrs = jfrnn.search(x + 0.01, CUTOFF, backend="warp", **options)
    sums = listed_marks(x, nbrs)
    assert_marks(sums, reference.reference_pairs(x, CUTOFF, include_self="include_self" in options), x)
    assert (int(nbrs.count.sum()) > int(sums["count"].sum())) == ("skin" in options)


@pytest.mark.parametrize(
    ("backend", "reduce"), sparing(product(("warp", "list", "brute", "jax"), ("min", "max")), [("warp", "min")])
)
def test_extremes(backend, reduce):
    """Of own images too; rows without neighbors; the derivative is that of the extreme pair."""
    x, m = scene(1, dim=3)
    x, m = np.asarray(x) * [1.0, 1.0, 3.0], np.asarray(m)
    x[7] = 0.1, 0.1, 30.0
    box = jfrnn.Box(np.array([2.0, 0.4, 9.0]), (False, True, False))
    matrix = np.diag([2.0, 0.4, 9.0])
    options = (
        {"neighbors": jfrnn.search(x, 0.39, box=box, backend="warp")} if backend == "list" else {"backend": backend, "box": box}
    )
    pairs = reference.reference_images(x, 0.39, matrix=matrix, periodic=(False, True, False))
    i, j, shifts = in_order(pairs, 3)
    assert len(set(i.tolist())) < N

    def fn(r, i, j):
        return {"signal": i * j - r @ jnp.array([1.0, 2.0, 3.0]), "r": jnp.sin(3 * r)}

    @jax.jit
    def finite(x, m):
        def loss(x, m):
            sums = jfrnn.pair_sum(fn, x, 0.39, m, reduce=reduce, **options)
            return sum(jnp.sum(jnp.where(jnp.isfinite(leaf), leaf, 0.0) ** 2) for leaf in jax.tree.leaves(sums)), sums

        return jax.grad(loss, (0, 1), has_aux=True)(x, m)

    found, sums = finite(x, m)
    r, pick, none = x[j] - x[i] + shifts @ matrix, {"max": np.argmax, "min": np.argmin}[reduce], {"max": -np.inf, "min": np.inf}
    terms = np.column_stack([m[i] * m[j] - r @ [1.0, 2.0, 3.0], np.sin(3 * r)])
    wanted, slopes = np.full((N, 4), none[reduce]), (np.zeros((N, 3)), np.zeros(N))
    for row, column in product(sorted(set(i.tolist())), range(4)):  # the extreme pair alone has a derivative
        pair = np.flatnonzero(i == row)[pick(terms[i == row, column])]
        wanted[row, column] = terms[pair, column]
        of_r = np.array([-1.0, -2.0, -3.0]) if column == 0 else 3 * np.cos(3 * r[pair]) * np.eye(3)[column - 1]
        slopes[0][j[pair]] += 2 * terms[pair, column] * of_r
        slopes[0][row] -= 2 * terms[pair, column] * of_r
        if column == 0:
            slopes[1][row] += 2 * terms[pair, 0] * m[j[pair]]
            slopes[1][j[pair]] += 2 * terms[pair, 0] * m[row]
    assert_same(found, slopes)
    np.testing.assert_allclose(np.column_stack([sums["signal"], sums["r"]]), wanted, rtol=1e-13)


@pytest.mark.parametrize("backend", ["list", "brute"])
def test_of_equal_extremes_the_smallest_index_counts(backend):
    x = np.zeros((50, 2))
    x[49] = 9.0
    given = {"neighbors": jfrnn.search(x, 1.0, backend="warp")} if backend == "list" else {"backend": backend}

    @jax.jit
    def largest(m):
        def total(m):
            rows = jfrnn.pair_sum(lambda r, i, j: j, x, 1.0, m, reduce="max", **given)
            return jnp.sum(rows[:49]), rows

        return jax.grad(total, has_aux=True)(m)

    gradient, rows = map(np.asarray, largest(np.array([1.0, 3.0, 2.0] * 16 + [2.0, 4.0])))
    assert rows[:49].tolist() == [3.0] * 49
    np.testing.assert_array_equal(np.nonzero(gradient)[0], [1, 4])  # 4 is what 1 itself has
    np.testing.assert_array_equal(gradient[[1, 4]], [48, 1])
    values = np.arange(50.0)
    values[48] = np.nan
    rows = np.asarray(largest(values)[1])
    assert np.isnan(rows[:48]).all()  # NaN is not hidden
    np.testing.assert_array_equal(rows[48:], [47, -np.inf])


@pytest.mark.parametrize("backend", ["list", slow("jax"), slow("brute")])
def test_rounding(backend):
    """Sums of many terms against exact ones: the bound of the docstring, and with compensation a far smaller one."""
    values, x = cancelling(500), np.zeros((500, 2), np.float32)
    options = {"backend": backend}
    if backend == "list":
        options = {"neighbors": jfrnn.search(x, 1.0, include_self=True, backend="warp")}
    else:
        options["include_self"] = True
    both = (jfrnn.pair_sum(lambda r, i, j: j, x, 1.0, values, compensated=c, **options) for c in (False, True))
    assert_compensated(*both, values)


@pytest.mark.parametrize("shared", [False, True])
def test_derivatives_of_compensated_sums_are_compensated(shared):
    """Those by factors of i are sums over j, in which almost all cancels. Those by what all pairs share are one sum over all
    pairs, which kernels add in parts: what these lost to rounding is not lost again.
    """
    values, x = cancelling(500), np.zeros((500, 2), np.float32)

    def slopes(compensated):
        def total(factor):
            options = {"include_self": True} if shared else {"queries": x[:3], "query_values": factor}
            fn = (lambda r, i, j: factor * j) if shared else (lambda r, i, j: i * j)
            return jfrnn.pair_sum(fn, x, 1.0, values, compensated=compensated, backend="warp", **options).sum()

        return jax.jit(jax.grad(total))(np.float32(1) if shared else np.ones(3, np.float32))

    assert_compensated(slopes(False), slopes(True), values, times=500 if shared else 1)


# --- transformations, memory, errors -----------------------------------------------------------------------------------------


def test_programs_are_used_again():
    """New positions and cutoffs trace and compile nothing; a function that changed is noticed."""
    traces, factor = [], 2.0

    def fn(r, i, j):
        traces.append(None)
        return factor * j

    x, m = scene(1)
    nbrs = [jfrnn.search(x + shift, CUTOFF, capacity=40, backend="warp") for shift in (0.0, 1.0)]
    jitted = jax.jit(lambda x, m, nbrs: jfrnn.pair_sum(fn, x, None, m, neighbors=nbrs))
    for shift, given in enumerate(nbrs):
        jitted(x + shift, m, given)
    assert len(traces) == 1
    first = jfrnn.pair_sum(fn, x, None, m, neighbors=nbrs[0])
    size = _summation._compiled.cache_size()
    np.testing.assert_array_equal(jfrnn.pair_sum(fn, x, None, m, neighbors=nbrs[0]), first)
    assert _summation._compiled.cache_size() == size
    factor = 2.0 + 1e-12
    assert (np.asarray(jfrnn.pair_sum(fn, x, None, m, neighbors=nbrs[0])) != np.asarray(first)).any()
    assert _summation._compiled.cache_size() == size + 1


@pytest.mark.parametrize("backend", ["list", slow("brute"), slow("jax")])
def test_vmap_and_scan(backend):
    """Both over a gradient; some operands have no batch."""
    x, m = scene(1)
    x = np.asarray(x)
    xs, scales = np.stack([x, 0.9 * x, x**2]), np.array([1.0, 2.0, 3.0])

    def gradient(x, scale):
        def loss(x, scale):
            given = {"backend": backend}
            if backend == "list":
                given = {"neighbors": jfrnn.search(jax.lax.stop_gradient(x), CUTOFF, capacity=64, backend="warp")}
            return (jfrnn.pair_sum(lambda r, i, j: scale * j * jnp.exp(-r @ r), x, CUTOFF, m, **given) ** 2).sum()

        return jax.grad(loss, (0, 1))(x, scale)

    one_by_one = jax.jit(gradient)
    expected = jax.tree.map(lambda *leaves: np.stack(leaves), *(one_by_one(x, s) for x, s in zip(xs, scales, strict=True)))
    assert_same(jax.jit(jax.vmap(gradient))(xs, scales), expected)
    scanned = jax.jit(lambda xs, scales: jax.lax.scan(lambda c, given: (c, gradient(*given)), 0, (xs, scales))[1])
    assert_same(scanned(xs, scales), expected)


def test_derivatives_of_vmap():
    x, m = scene(1)
    nbrs, pairs = jfrnn.search(x, CUTOFF, backend="warp"), reference.reference_pairs(x, CUTOFF)
    scales = np.array([1.0, 2.0])

    @jax.jit
    def gradient(x, scales):
        def loss(x, scales):
            def sums(x, scale):
                return jfrnn.pair_sum(functools.partial(smooth, scale), x, None, {"m": m}, neighbors=nbrs)

            return sum(jnp.sum(jnp.sin(leaf).T * weight) for leaf in jax.tree.leaves(jax.vmap(sums, (None, 0))(x, scales)))

        return jax.grad(loss, (0, 1))(x, scales)

    weight = np.arange(1.0, 1 + N)[:, None] / N
    (first, one), (second, two) = (oracle(smooth_slopes, pairs, {"x": x, "scale": scale, "m": m})[1][:2] for scale in scales)
    assert_same(gradient(x, scales), (first + second, np.array([one, two])))


@pytest.mark.parametrize(("backend", "dim", "most", "each"), [("warp", 3, 1e6, 250), slow("jax", 2, 64e6, 200)])
def test_memory_does_not_grow_with_pairs(backend, dim, most, each):
    """A million particles: gradient included, less than their neighbors alone would take, were they listed."""
    n = 1_000_000

    def loss(x, m):
        return (jfrnn.pair_sum(lambda r, i, j: j * jnp.exp(-r @ r), x, 0.1, m, backend=backend) ** 2).sum()

    shapes = jax.ShapeDtypeStruct((n, dim), np.float32), jax.ShapeDtypeStruct((n,), np.float32)
    memory = jax.jit(jax.grad(loss, (0, 1))).lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < most + each * n


@pytest.mark.parametrize("backend", [slow("brute"), "warp"])
def test_where_a_search_cannot_answer_nothing_looks_like_an_answer(backend):
    """Of array programs, which sum integers, too, and of kernels."""
    x, m = scene(1, dim=3)

    @jax.jit
    def sums(x, h, lengths):
        box = jfrnn.Box(lengths, (True, False, False))
        both = {"int": 1} if backend == "brute" else {}
        return jfrnn.pair_sum(lambda r, i, j: {"float": j} | both, x, h, m, box=box, backend=backend)

    h, lengths = np.full(N, 0.3), np.array([2.0, 1.0, 1.0])
    good = sums(x, h, lengths)
    i, j, _ = in_order(reference.reference_images(x, 0.3, matrix=lengths, periodic=(True, False, False)), 3)
    if backend == "brute":
        np.testing.assert_array_equal(good["int"], np.bincount(i, minlength=N))
    np.testing.assert_allclose(good["float"], np.bincount(i, np.asarray(m)[j], N), rtol=1e-12)
    negative, far = h.copy(), np.array(x)
    negative[3], far[0, 0] = -1.0, 1e12
    for wrong in ((x, negative, lengths), (x, h, 0.1 * lengths), (far, h, lengths)):
        bad = sums(*wrong)
        assert np.isnan(bad["float"]).all()
        assert backend == "warp" or (np.asarray(bad["int"]) < 0).all()


@functools.partial(jax.jit, static_argnames=("backend", "reduce"))
def sums_and_forces(x, m, nbrs, active, backend, reduce):
    """Return sums of floats and integers over a list or a search, and the derivatives of the former."""
    given = {"active": active, "backend": backend} if nbrs is None else {"neighbors": nbrs}

    def sums(x, m):
        found = jfrnn.pair_sum(lambda r, i, j: {"float": j * (r @ r)}, x, CUTOFF, m, reduce=reduce, **given)["float"]
        return jnp.where(jnp.isinf(found), 0, found).sum(), found

    integers = None if nbrs is None and backend == "warp" else jfrnn.pair_sum(lambda r, i, j: 1, x, CUTOFF, m, **given)
    (force, of_values), found = jax.grad(sums, (0, 1), has_aux=True)(x, m)
    return {"float": found, "integer": integers}, force, of_values


@pytest.mark.parametrize("reduce", ["sum", "max"])
@pytest.mark.parametrize("backend", ["warp", *(slow(name) for name in ("list", "brute", "jax"))])
def test_a_particle_that_is_nowhere_has_no_sum(backend, reduce):
    """Nor has it a force; the others have what they have without it, and inactive particles have 0 as everywhere."""
    x, m = scene(2)
    lost, asleep = np.array([3, 17]), np.array([5, 6])
    active = np.ones(N, bool)
    active[asleep] = False
    x = np.array(x)
    x[3, 1], x[17, 0], x[5] = np.nan, np.inf, np.nan
    nbrs = jfrnn.search(x, CUTOFF, active=active, capacity=50, backend="warp") if backend == "list" else None
    found, force, of_values = sums_and_forces(x, m, nbrs, active, "auto" if nbrs else backend, reduce)
    parked = x.copy()
    parked[lost] = [[1e3], [2e3]]
    if nbrs is not None:
        nbrs = jfrnn.search(parked, CUTOFF, active=active, capacity=50, backend="warp")
        asleep = asleep[1:]  # the list knows that some particle is nowhere, but not that the one with NaN is inactive
    expected, exact, of_others = sums_and_forces(parked, m, nbrs, active, "auto" if nbrs else backend, reduce)
    no_sum = jax.tree.map(has_no_sum, found)
    assert all(of_each[lost].all() and not of_each[asleep].any() for of_each in jax.tree.leaves(no_sum))
    assert np.isnan(np.asarray(force)[lost]).all()
    known = np.setdiff1d(np.arange(N), [*lost, 5])
    for got, wanted in zip(jax.tree.leaves((found, force, of_values)), jax.tree.leaves((expected, exact, of_others)), strict=True):
        np.testing.assert_allclose(np.asarray(got)[known], np.asarray(wanted)[known], rtol=1e-12, atol=1e-14)


def test_a_query_that_is_nowhere_has_no_sum():
    x, _ = scene(2)
    queries, active = np.array(x)[:9], np.arange(N) % 3 > 0
    queries[4, 0] = np.nan
    nbrs = jfrnn.search(x, CUTOFF, queries=queries, active=active, capacity=50, backend="warp")
    for given in ({"neighbors": nbrs}, {"active": active, "backend": "warp"}):
        sums = jfrnn.pair_sum(lambda r, i, j: r @ r, x, CUTOFF, queries=queries, **given)
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(sums)), [4])


@pytest.mark.parametrize("queries", [False, slow(True)])
@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_what_has_no_sum_has_no_derivative_in_its_position(backend, queries):
    """Of two orders; in positions alone, and where queries are given, in theirs."""
    x, m = scene(2)
    x = np.array(x)
    x[3, 1], x[18, 0] = np.nan, np.inf
    q = x[::3] if queries else x[:0]

    def sums(x, q, m):
        given = {"queries": q, "query_values": m[: len(q)]} if queries else {}
        return jfrnn.pair_sum(lambda r, i, j: i * j * (r @ r) * r, x, CUTOFF, m, backend=backend, **given)

    def pull(x, q, m, into):
        rows, back = jax.vjp(sums, x, q, m)
        return rows, back(into)

    @jax.jit
    def both(*given):
        (rows, pulled), back = jax.vjp(pull, *given)
        return rows, pulled, back(jax.tree.map(jnp.ones_like, (rows, pulled)))

    rows, pulled, again = both(x, q, m, np.ones((len(q) or len(x), 2)))
    lost, none = {len(x): [3, 18], len(q): [1, 6]}, []
    nowhere = [np.flatnonzero(np.isnan(a).all(axis=tuple(range(1, a.ndim)))).tolist() for a in (rows, *pulled, *again)]
    of_x = none if queries else lost[len(x)]
    assert nowhere == [lost[len(rows)], *2 * [of_x, lost[len(q)] if queries else none, none], lost[len(rows)]]
    assert all(np.isfinite(np.delete(a, which, axis=0)).all() for a, which in zip((rows, *pulled, *again), nowhere, strict=True))


@pytest.mark.parametrize(("half", "reduce"), [(False, "sum"), *slowly((True, "sum"), (False, "max"))])
def test_a_list_that_lacks_pairs_has_no_sums(half, reduce):
    """Outside jit, and where it is closed over, it raises; inside, no row looks like a sum, nor does a force."""
    x, m = scene(1)
    nbrs = jfrnn.search(x, CUTOFF, half=half, capacity=3, backend="warp")

    def sums(nbrs, x):
        return jfrnn.pair_sum(lambda r, i, j: j * (r @ r), x, None, m, neighbors=nbrs, reduce=reduce)

    @jax.jit
    def both(x, nbrs):
        def first(x):
            rows = sums(nbrs, x)
            return rows[0], rows

        return jax.grad(first, has_aux=True)(x)

    assert all(np.isnan(found).all() for found in both(x, nbrs))
    for call in (sums, lambda nbrs, x: jax.jit(lambda x: sums(nbrs, x))(x)):
        refuses(jfrnn.NeighborOverflowError, "capacity=3 is too small", call, nbrs, x)
    whole = nbrs.grow(x)
    i, j, _ = in_order(reference.reference_pairs(x, CUTOFF), 2)
    squares = ((np.asarray(x)[j] - np.asarray(x)[i]) ** 2).sum(1)
    expected = np.full(N, 0.0 if reduce == "sum" else -np.inf)
    (np.add if reduce == "sum" else np.maximum).at(expected, i, np.asarray(m)[j] * squares)
    np.testing.assert_allclose(sums(whole, x), expected, rtol=1e-12)


X, Q, M = np.zeros((4, 2), np.float32), np.ones((3, 2), np.float32), np.ones(4, np.float32)


def same(r, i, j):
    return r


def listed(x=X, **options):
    return jfrnn.search(x, 1.0, capacity=4, backend="warp", **options)


pair_sum = functools.partial(jfrnn.pair_sum, same, X, 1.0)


@pytest.mark.parametrize(
    ("error", "match", "call"),
    [
        (TypeError, r"fn must be a function of \(r, i, j\), got int", lambda: jfrnn.pair_sum(3, X, 1.0)),
        (TypeError, "fn must return floats or integers, got bool", lambda: jfrnn.pair_sum(lambda r, i, j: r[0] > 0, X, 1.0)),
        (TypeError, "fn must return floats for reduce='max'", lambda: jfrnn.pair_sum(lambda r, i, j: 1, X, 1.0, reduce="max")),
        (TypeError, "fn must return arrays, got None", lambda: jfrnn.pair_sum(lambda r, i, j: None, X, 1.0)),
        (TypeError, "fn must return floats or integers, got str", lambda: jfrnn.pair_sum(lambda r, i, j: "r", X, 1.0)),
        (ValueError, "reduce must be one of 'sum', 'max', 'min', got 'mean'", lambda: pair_sum(reduce="mean")),
        (ValueError, "symmetry must be None, 'symmetric' or", lambda: pair_sum(symmetry="odd")),
        (ValueError, "symmetry='symmetric' is about pairs without direction", lambda: pair_sum(symmetry="symmetric", queries=Q)),
        (ValueError, "symmetric' is about pairs without direction", lambda: jfrnn.pair_sum(same, X, M, symmetry="symmetric")),
        (TypeError, "compensated must be True or False", lambda: pair_sum(compensated=1)),
        (ValueError, "backend='hashgrid' cannot sum over pairs", lambda: pair_sum(backend="hashgrid")),
        (ValueError, "backend must be one of", lambda: pair_sum(backend="numpy")),
        (ValueError, r"values\['m'\] must have shape \[4, ...\], one row per particle, got \[3\]", lambda: pair_sum({"m": M[:3]})),
        (TypeError, r"values\['m'\] must be an array with a row per particle, got float", lambda: pair_sum({"m": 1.0})),
        (TypeError, r"values\['m'\] must hold numbers of a dtype that JAX has, got >f4", lambda: pair_sum({"m": M.astype(">f4")})),
        (ValueError, r"query_values must have shape \[3, ...\], one row per query", lambda: pair_sum(queries=Q, query_values=M)),
        (ValueError, "query_values belong to queries", lambda: pair_sum(query_values=M)),
        (ValueError, "cutoff must be given", lambda: jfrnn.pair_sum(lambda r, i, j: r, X, None)),
        (ValueError, "cutoff must be positive", lambda: jfrnn.pair_sum(lambda r, i, j: r, X, -1.0)),
        (TypeError, "neighbors must be a jfrnn.NeighborList or a jfrnn.EdgeList, got int", lambda: pair_sum(neighbors=3)),
        (ValueError, "closed was said when the list was made", lambda: pair_sum(neighbors=listed(), closed=True)),
        (ValueError, "backend was said when the list was made", lambda: pair_sum(neighbors=listed(), backend="jax")),
        (
            ValueError,
            "cutoff must be None or at most that of the list, which has cutoff=1.0, got 2.0",
            lambda: jfrnn.pair_sum(lambda r, i, j: r, X, 2.0, neighbors=listed()),
        ),
        (ValueError, "positions hold 4 particles, but the list was made for 3", lambda: pair_sum(neighbors=listed(X[:3]))),
        (ValueError, "made without queries", lambda: pair_sum(neighbors=listed(), queries=Q)),
        (ValueError, "made without a periodic box", lambda: pair_sum(neighbors=listed(), box=jfrnn.Box([3.0, 3.0]))),
        (ValueError, "neighbors must be a full list for reduce='max'", lambda: pair_sum(neighbors=listed(half=True), reduce="max")),
        (ValueError, "neighbors must be a full list", lambda: pair_sum(neighbors=listed(half=True), compensated=True)),
    ],
)
def test_errors(error, match, call):
    refuses(error, match, call)


def test_integers_that_do_not_fit_are_refused():
    """Of 64 bits, where JAX has 32: they wrapped around, 2^40 to 0."""
    with jax.enable_x64(False):
        for numbers in (np.full(4, 2**40), np.full(4, -(2**40)), np.full(4, 2**40, np.uint64)):
            refuses(ValueError, r"values\['id'\] holds u?int64 from .* wrap them around", pair_sum, {"id": numbers})


def test_unsigned_integers_are_marked_by_the_largest():
    """The smallest is 0, which a sum may be."""
    x = np.array([[0, 0], [1, 0], [np.nan, 0]], X.dtype)
    for dtype in (np.uint8, np.uint32):
        sums = jfrnn.pair_sum(lambda r, i, j: j, x, 2.0, np.ones(3, dtype))
        assert sums.dtype == dtype and sums.tolist() == [1, 1, np.iinfo(dtype).max]


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
@pytest.mark.parametrize(
    ("cutoff", "box"), [(0.9, jfrnn.Box([1.0, 1.0], images=0)), (np.array([0.5, -1.0, 0.5], np.float32), None)]
)
def test_what_data_say_is_raised_below_transformations_that_know_them(cutoff, box, backend):
    """Derivatives of known positions are no program: an error is told there, too."""

    def total(x):
        return jfrnn.pair_sum(lambda r, i, j: r @ r, x, cutoff, box=box, backend=backend).sum()

    x, match = jnp.asarray([[0.1, 0.2], [0.4, 0.3], [0.8, 0.9]], jnp.float32), "cutoff|box"
    refuses(ValueError, match, total, x)
    refuses(ValueError, match, jax.grad(total), x)
    refuses(ValueError, match, lambda x: jax.jvp(total, (x,), (x,)), x)
    refuses(ValueError, match, jax.jacfwd(jax.grad(total)), x)
    assert np.isnan(jax.jit(jax.grad(total))(x)).all()


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_a_list_with_a_shorter_cutoff(backend):
    """A list serves two cutoffs: its own pairs, and those of a shorter one, with derivatives."""
    x, short = jnp.asarray(np.random.default_rng(8).random((60, 3))), 0.2
    options = {"box": jfrnn.Box([1.0, 1.0, 1.0]), "backend": backend}
    nbrs, moved = jfrnn.search(x, 0.35, skin=0.05, **options), x + 0.01 * jnp.sin(40 * x)

    def total(x, **given):
        return jfrnn.pair_sum(lambda r, i, j: 1 + jnp.exp(-(r @ r)), x, short, **given).sum()

    found = jax.jit(lambda x, nbrs: jax.value_and_grad(total)(x, neighbors=nbrs))(moved, nbrs)
    away = np.asarray(moved)[:, None] - np.asarray(moved)
    away -= np.round(away)
    squared = (away**2).sum(2)
    term = np.where((squared < short**2) & ~np.eye(60, dtype=bool), np.exp(-squared), 0)
    pairs = np.count_nonzero(term)
    assert pairs > 50
    np.testing.assert_allclose(found[0], pairs + term.sum(), rtol=1e-12)
    np.testing.assert_allclose(found[1], -4 * (term[..., None] * away).sum(1), atol=1e-12)
