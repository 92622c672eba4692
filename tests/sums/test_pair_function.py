"""What `pair_sum` says of functions that take something else, that branch, or that fail."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow

import jfrnn

X = np.zeros((4, 2), np.float32)


def of_two(r, j):
    return r


def branching(r, i, j):
    return r if r[0] > 0 else -r


def by_numpy(r, i, j):
    return np.linalg.norm(r)


def by_index(r, i, j):
    return (1.0, 2.0)[j["kind"]]


def of_mass(r, i, j):
    return j["m"] * r


def failing(r, i, j):
    raise ZeroDivisionError("a reason of its own")


GIVEN = {"v": np.ones((4, 2), np.float32), "kind": np.ones(4, np.int32)}
PAIR = r"r = x_j - x_i, float32\[2\]; i = {'kind': int32\[\], 'v': float32\[2\]}; j = {'kind': int32\[\], 'v': float32\[2\]}"


@pytest.mark.parametrize(
    ("error", "fn", "values", "matches"),
    [
        (TypeError, of_two, GIVEN, [r"fn must take three arguments, \(r, i, j\).*of_two takes \(r, j\)", PAIR]),
        (TypeError, functools.partial(of_two, j=1), None, ["of_two takes", "i = None, as no values were given"]),
        (TypeError, branching, GIVEN, [r"fn \(branching\) asks what a number is.*jnp.where", PAIR]),
        (TypeError, by_numpy, GIVEN, [r"fn \(by_numpy\) asks what a number is.*jnp instead of np", PAIR]),
        (TypeError, by_index, GIVEN, [r"fn \(by_index\) asks what a number is", PAIR]),
        (KeyError, of_mass, GIVEN, ["^'m'", r"Raised by fn \(of_mass\)", PAIR]),
        (TypeError, of_mass, None, ["not subscriptable", r"fn \(of_mass\).*j = None, as no values were given"]),
        (ZeroDivisionError, failing, GIVEN, ["^a reason of its own", r"Raised by fn \(failing\)", PAIR]),
    ],
)
@pytest.mark.parametrize("symmetry", [None, "symmetric"])
def test_errors_of_a_function_say_what_it_is_given(error, fn, values, matches, symmetry):
    with pytest.raises(error) as raised:
        jfrnn.pair_sum(fn, X, 1.0, values, symmetry=symmetry)
    assert raised.type is error
    said = "\n".join([str(raised.value), *getattr(raised.value, "__notes__", ())])
    for match in matches:
        assert re.search(match, said), said
    if error is TypeError and values is not None:
        assert isinstance(raised.value.__cause__, TypeError)  # what Python or JAX said


@pytest.mark.parametrize("fn", [lambda r, *values: r, lambda r, i, j, k=2.0: k * r, lambda *pair: pair[0]])
def test_functions_that_can_take_three_arguments_do(fn):
    assert jfrnn.pair_sum(fn, X, 1.0, backend="brute").shape == X.shape


TABLE, SCALE = jnp.array([1.0, 2.0], jnp.float32), 1.0


def in_a_program(r, i, j):
    return jax.jit(lambda square: square * TABLE[0])(r @ r)


def with_a_rule(r, i, j):
    function = jax.custom_jvp(lambda square: square * 1.0)
    function.defjvp(lambda primals, tangents: (function(*primals), SCALE * tangents[0]))
    return function(r @ r)


@pytest.mark.parametrize("backend", ["warp", slow("brute")])
def test_what_a_function_knows_may_change(monkeypatch, backend):
    """Numbers in programs and in rules for derivatives, too, which a printed jaxpr does not show."""
    x = jnp.asarray(np.random.default_rng(0).random((20, 3)), jnp.float32)

    def both():
        sums = jfrnn.pair_sum(in_a_program, x, 0.5, backend=backend)
        slopes = jax.grad(lambda x: jfrnn.pair_sum(with_a_rule, x, 0.5, backend=backend).sum())(x)
        return sums, slopes

    before = both()
    monkeypatch.setitem(globals(), "TABLE", jnp.array([7.0, 2.0], jnp.float32))
    monkeypatch.setitem(globals(), "SCALE", 5.0)
    after = both()
    np.testing.assert_allclose(after[0], 7 * before[0], rtol=1e-5)
    np.testing.assert_allclose(after[1], 5 * before[1], rtol=1e-5)


def test_rules_that_cannot_be_followed_stop_no_sum():
    """Nor are they asked before a derivative is: of loops, of what raises, or with a value of the program."""
    x = jnp.asarray(np.random.default_rng(0).random((20, 3)), jnp.float32)

    @jax.custom_vjp
    def doubled(square):
        return square * 2

    def backward(*_):
        raise NotImplementedError

    doubled.defvjp(lambda square: (doubled(square), None), backward)

    def by_a_loop(r, i, j):
        step = lambda k, root: 0.5 * (root + (r @ r) / root)  # noqa: E731
        return jax.nn.relu(0.5 - jax.lax.while_loop(lambda at: at[0] < 9, lambda at: (at[0] + 1, step(*at)), (0, r @ r + 0.1))[1])

    def of_a_program(x, scale):
        rule = jax.custom_jvp(lambda square: 2 * square)
        rule.defjvp(lambda primals, tangents: (rule(*primals), scale * tangents[0]))
        return jfrnn.pair_sum(lambda r, i, j: rule(r @ r), x, 0.5, backend="brute")

    plain = jfrnn.pair_sum(lambda r, i, j: 2 * (r @ r), x, 0.5, backend="brute")
    np.testing.assert_allclose(jfrnn.pair_sum(lambda r, i, j: doubled(r @ r), x, 0.5, backend="brute"), plain, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(of_a_program)(x, 2.0), plain, rtol=1e-6)
    near = jfrnn.pair_sum(lambda r, i, j: jnp.maximum(0.5 - jnp.sqrt(r @ r), 0), x, 0.5, backend="brute")
    np.testing.assert_allclose(jfrnn.pair_sum(by_a_loop, x, 0.5, backend="brute"), near, rtol=1e-4)


@pytest.mark.slow
def test_rules_in_rules_may_change():
    x, scale = jnp.asarray(np.random.default_rng(0).random((9, 3)), jnp.float32), [1.0]

    def fn(r, i, j):
        inner = jax.custom_jvp(lambda square: square * square / 2)
        inner.defjvp(lambda primals, tangents: (inner(*primals), scale[0] * primals[0] * tangents[0]))
        outer = jax.custom_jvp(lambda square: square**3 / 6)
        outer.defjvp(lambda primals, tangents: (outer(*primals), inner(primals[0]) * tangents[0]))
        return outer(r @ r)

    def hessian(fn):
        return jax.jacfwd(jax.grad(lambda x: jfrnn.pair_sum(fn, x, 0.5, backend="brute").sum()))(x)

    before = hessian(fn)
    scale[0] = 5.0
    after = hessian(fn)
    assert float(jnp.abs(after - before).max()) > 0.01
    np.testing.assert_array_equal(after, hessian(lambda r, i, j: fn(r, i, j)))


WITHIN = {
    "": lambda rule, square: rule(square),
    "jit": lambda rule, square: jax.jit(rule)(square),
    "cond": lambda rule, square: jax.lax.cond(square > 0, rule, lambda square: square, square),
    "scan": lambda rule, square: jax.lax.scan(lambda at, _: (rule(at), None), square, None, length=1)[0],
}


def of_a_rule(x, scale, backend, within=""):
    """A sum of (scale - r^2)^3 by a function that closes over `scale`, as its rule does."""
    rule = jax.custom_jvp(lambda square: (scale - square) ** 3)
    rule.defjvp(lambda primals, tangents: (rule(*primals), -3 * (scale - primals[0]) ** 2 * tangents[0]))
    return jfrnn.pair_sum(lambda r, i, j: WITHIN[within](rule, r @ r), x, 0.5, backend=backend).sum()


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_rules_that_close_over_what_moves_are_refused(backend):
    """Such a rule knows no tangent of what it closes over, which JAX takes for 0."""
    x = jnp.asarray(np.random.default_rng(0).random((9, 3)), jnp.float32)
    scale, work = jnp.float32(0.25), functools.partial(of_a_rule, backend=backend)
    np.testing.assert_allclose(jax.jit(work)(x, scale), work(x, scale), rtol=1e-6)
    assert np.isfinite(jax.grad(work)(x, scale)).all()
    for derivative in (jax.grad(work, 1), jax.jit(jax.grad(work, 1)), jax.grad(jax.jit(work), 1), jax.jit(jax.grad(work))):
        with pytest.raises(ValueError, match=r"fn calls a function with a rule for its derivative .* hand that array over"):
            derivative(x, scale)


@pytest.mark.parametrize("within", ["scan", slow("jit"), slow("cond")])
def test_rules_in_programs_that_close_over_what_moves_are_refused(within):
    x, scale = jnp.asarray(np.random.default_rng(0).random((9, 3)), jnp.float32), jnp.float32(0.25)
    work = functools.partial(of_a_rule, backend="jax", within=within)
    np.testing.assert_allclose(jax.grad(work)(x, scale), jax.grad(of_a_rule)(x, scale, "jax"), rtol=1e-5)
    with pytest.raises(ValueError, match="hand that array over"):
        jax.jit(jax.grad(work, 1))(x, scale)


@pytest.mark.parametrize("name", ["psum", "axis_index"])
def test_functions_that_ask_others_of_a_batch_are_refused(name):
    """The others have other pairs. A batch within the function is its own matter."""

    def asking(r, i, j):
        asked = jax.lax.psum(r @ r, "system") if name == "psum" else jax.lax.axis_index("system")
        return jax.jit(lambda x: x * asked.astype(x.dtype))(r @ r)

    def within(r, i, j):
        return jax.vmap(lambda x: jax.lax.psum(x * x, "axis"), axis_name="axis")(r)[0]

    def mapped(fn):
        return jax.vmap(lambda x: jfrnn.pair_sum(fn, x, 1.0, backend="brute"), axis_name="system")(X[None])

    with pytest.raises(TypeError, match=f"fn must not use {name} over the axis 'system'.*close over the result"):
        mapped(asking)
    assert not mapped(within).any()
