"""Sums over the same pairs, which become one sum while a program is lowered."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow
from jax.interpreters import mlir

import jfrnn
from jfrnn._sums import joint

N, CUTOFF = 60, 0.35
X = np.random.default_rng(0).random((N, 3))
M = np.random.default_rng(1).random(N)


def energy(r, i, j):
    return i["m"] * j["m"] * jnp.maximum(1 - (r @ r) / CUTOFF**2, 0) ** 3


def density(x, m, backend="warp", **options):
    return jfrnn.pair_sum(energy, x, CUTOFF, {"m": m}, backend=backend, **options)


def compiled(function, *args):
    """Return a program, and how many sums it calls."""
    program = jax.jit(function).lower(*args).compile()
    return program, program.as_text().count('kernel = "jfrnn_pair_sum')


def count_calls(function, *args):
    return compiled(function, *args)[1]


def slopes(x, m, pulled=lambda rho: 1, box=False):
    """Return densities, by NumPy in float64, and the derivatives by x and m of a function of them that has the slopes `pulled`."""
    r = x[None] - x[:, None]
    r = r - np.round(r.real) if box else r
    left = 1 - (r * r).sum(2) / CUTOFF**2
    near = (left.real > 0) & ~np.eye(len(x), dtype=bool)
    left = np.where(near, left, 0)
    rho = (m[:, None] * m * left**3).sum(1)
    pull = (pulled(rho) * np.ones(len(x)))[:, None] * m[:, None] * m * left**2
    of_r = (-6 / CUTOFF**2 * pull)[..., None] * r
    of_pairs = pull * left
    return rho, of_r.sum(0) - of_r.sum(1), (of_pairs.sum(0) + of_pairs.sum(1)) / m


def expected_energies(x, m, **box):
    rho, of_x, of_m = slopes(x, m, **box)
    return rho.mean() / 2, (of_x / (2 * N), of_m / (2 * N))


def expected_pressure(x, m):
    rho, of_x, _ = slopes(x, m, lambda rho: 2 * rho)
    return (rho**2).sum(), of_x


def expected_several(x, m):
    r = x[None] - x[:, None]
    squares = (r * r).sum(2)
    near = (squares < CUTOFF**2) & ~np.eye(N, dtype=bool)
    two = (near @ np.arange(N), np.exp(m.mean()) * (near[..., None] * r).sum(1))
    return (near * squares).sum(1), two, slopes(x, m)[0]


def assert_near(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5), found, expected)


def density_and_force(x, m, backend="warp", **options):
    rho, back = jax.vjp(lambda x: density(x, m, backend, **options), x)
    return rho, back(jnp.ones_like(rho))[0]


def energies(x, m, backend="warp", **options):
    """Return the energy, half the sum, with its derivatives."""
    return jax.value_and_grad(lambda x, m: 0.5 * density(x, m, backend, **options).mean(), (0, 1))(x, m)


def pressure(x, m, backend="warp", **options):
    """Return what needs the densities of i and j before it can be summed."""
    return jax.value_and_grad(lambda x: (density(x, m, backend, **options) ** 2).sum())(x)


def several(x, m, backend="warp", **options):
    """Return three sums over the same pairs, one of which takes a number that the program computes before."""
    scale, numbers = jnp.exp(m.mean()), jnp.arange(N, dtype=x.dtype)
    one = jfrnn.pair_sum(lambda r, i, j: r @ r, x, CUTOFF, backend=backend, **options)
    two = jfrnn.pair_sum(lambda r, i, j: (j, scale * r), x, CUTOFF, numbers, backend=backend, **options)
    return one, two, density(x, m, backend, **options)


SLOW = [slow(function, "compensated") for function in (pressure, several)]


@pytest.mark.parametrize(
    ("function", "kind"),
    [(energies, "open"), (energies, "box"), (energies, "compensated"), (pressure, "open"), (several, "open"), *SLOW],
)
def test_sums_are_joined_and_right(function, kind):
    x, m = jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)
    options = {"open": {}, "box": {"box": jfrnn.Box([1.0] * 3)}, "compensated": {"compensated": True}}[kind]
    program, calls = compiled(functools.partial(function, **options), x, m)
    expected = {energies: expected_energies, pressure: expected_pressure, several: expected_several}[function]
    assert_near(program(x, m), expected(X, M, **({"box": True} if kind == "box" else {})))
    assert calls == (2 if function is pressure else 1)


@pytest.mark.slow
def test_array_programs_find_pairs_once():
    """A program sorts particles once for a density and its gradient, and what it finds is what two programs find."""
    x = jnp.asarray(np.random.default_rng(3).random((200, 3)), jnp.float32)
    m = jnp.asarray(np.random.default_rng(4).random(200), jnp.float32)
    program, _ = compiled(functools.partial(density_and_force, backend="jax"), x, m)
    assert program.as_text().count(" sort(") == 1
    apart = density(x, m, "jax"), jax.grad(lambda x: density(x, m, "warp").sum())(x)
    assert_near(program(x, m), apart)


def test_a_step_of_a_scan_finds_pairs_once():
    def step(x, _):
        rho, force = density_and_force(x, jnp.asarray(M, x.dtype))
        return x + 1e-3 * force, rho

    x = jnp.asarray(X, jnp.float32)
    program, calls = compiled(lambda x: jax.lax.scan(step, x, None, length=3), x)
    assert calls == 1
    moved, rhos = program(x)
    at = X
    for rho in rhos:
        expected, force, _ = slopes(at, M)
        assert_near(rho, expected)
        at = at + 1e-3 * force
    assert_near(moved, at)


def test_derivatives_of_joined_sums():
    x, m = jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)
    along = jnp.asarray(np.random.default_rng(2).normal(size=(N, 3)), jnp.float32)

    @jax.jit
    def both(x):
        return jax.jvp(lambda x: energies(x, m), (x,), (along,)), jax.hessian(lambda x: energies(x, m)[0])(x)

    def turned(direction):
        """Return how the derivatives by x and m change in a direction, by a complex step, which loses no digit."""
        return tuple(part.imag / 1e-30 / (2 * N) for part in slopes(X + 1e-30j * direction, M)[1:])

    ((value, gradient), (slope, product)), hessian = both(x)
    assert_near((value, gradient), expected_energies(X, M))
    assert_near((slope, product), (np.vdot(expected_energies(X, M)[1][0], along), turned(np.asarray(along))))
    columns = [turned(axis.reshape(N, 3))[0] for axis in np.eye(3 * N)]
    assert_near(hessian, np.stack(columns).reshape(N, 3, N, 3))


def test_invalid_rows_stay_marked():
    x, m, others = X.astype(np.float32), M.astype(np.float32), np.arange(N) != 7
    x[7, 1] = np.nan
    rho, force = map(np.asarray, jax.jit(density_and_force)(x, m))
    assert np.isnan(rho[7]) and np.isnan(force[7]).all()
    assert_near((rho[others], force[others]), slopes(X[others], M[others])[:2])


def test_more_numbers_than_are_summed_together_stay_apart():
    x = jnp.asarray(X, jnp.float32)

    def both(x):
        return [jfrnn.pair_sum(lambda r, i, j, k=k: jnp.tile(r * k, 3), x, CUTOFF, backend="warp") for k in (1.0, 2.0)]

    program, calls = compiled(both, x)
    assert calls == 2
    one, two = map(np.asarray, program(x))
    assert_near(two, 2 * one)
    assert one.any()


def test_a_compensated_sum_stays_apart_from_others():
    x, m = jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)

    def both(x, m):
        return [density(x, m, compensated=each) for each in (False, True)]

    program, calls = compiled(both, x, m)
    assert calls == 2
    for found, alone in zip(program(x, m), both(x, m), strict=True):
        np.testing.assert_array_equal(found, alone)


def test_many_operations_before_a_sum_take_no_time():
    """Each is an operand of the next one twice: who followed all ways through them would not come to an end."""

    def after_many(x, m):
        for _ in range(60):
            x, m = x * x - x * (x - 1), m * m - m * (m - 1)
        return density_and_force(x, m)

    assert count_calls(after_many, jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)) == 1


@pytest.mark.parametrize("backend", ["warp", "auto"])
def test_terms_that_no_kernel_holds_together_stay_apart(backend, monkeypatch):
    """Each has fewer operations than a kernel may have, both together have more."""
    monkeypatch.setattr("jfrnn._sums.scalars.MOST_SCALARS", 80)
    x = jnp.asarray(X, jnp.float32)

    def sines(k, square, sin):
        return functools.reduce(lambda y, n: sin(y / 2 + (k + n)), range(10), square)

    def both(x):
        return [jfrnn.pair_sum(lambda r, i, j, k=k: sines(k, r @ r, jnp.sin), x, CUTOFF, backend=backend) for k in (1.1, 2.3)]

    program, calls = compiled(both, x)
    assert calls == 2
    squares = ((X[None] - X[:, None]) ** 2).sum(2)
    near = (squares < CUTOFF**2) & ~np.eye(N, dtype=bool)
    assert_near(program(x), [(near * sines(k, squares, np.sin)).sum(1) for k in (1.1, 2.3)])


def test_operations_of_xla_can_be_read():
    """One file reads them, by an interface that is private to JAX: here a release that changes it is found, and how."""
    fault = joint.find_fault()
    assert fault is None, f"jfrnn/_sums/joint.py cannot read operations as jax {jax.__version__} shows them: {fault}"


def test_a_sum_is_lowered_alone_where_operations_cannot_be_read(monkeypatch):
    x, m = jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)
    expected = expected_energies(X, M)
    monkeypatch.setattr(joint, "find_fault", lambda: "there are no operations")
    monkeypatch.setattr(joint, "_warn", functools.cache(joint._warn.__wrapped__))
    with pytest.warns(RuntimeWarning) as caught:
        program, calls = compiled(functools.partial(energies), x, m)
    found = program(x, m)
    assert_near(found, expected)
    assert_near(jax.jit(functools.partial(energies, backend="jax"))(x, m), expected)  # which warns of nothing again
    assert calls > 1 and len(caught) == 1 and caught[0].filename == __file__
    said = f"jfrnn/_sums/joint.py cannot read the operations of XLA as jax {jax.__version__} shows them (there are no operations)"
    assert str(caught[0].message).startswith(said)


def test_modules_that_keep_nothing_are_told(monkeypatch):
    """Where a release gives modules no place to keep what was lowered."""
    monkeypatch.setattr(joint, "hasattr", lambda *_: False, raising=False)
    monkeypatch.setattr(joint, "_warn", functools.cache(joint._warn.__wrapped__))
    with pytest.warns(RuntimeWarning, match="a module keeps no lowering_cache"):
        assert count_calls(functools.partial(density_and_force), jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)) == 2


class Without:
    """The interface of an imagined release, which lacks some names."""

    def __init__(self, *names):
        self._names = names

    def __getattr__(self, name):
        if name in self._names:
            raise AttributeError(f"there is no {name}")
        return getattr(mlir.ir, name)


@pytest.mark.parametrize(
    ("name", "changed", "told"),
    [
        ("ir", None, "AttributeError: 'NoneType' object has no attribute 'Location'"),
        ("ir", Without("OpResult"), "AttributeError: there is no OpResult"),
        ("_rank", lambda value: 7, "a value and its type, a number that was broadcast"),
        ("_describe", lambda value: value, "what an operation computes"),
        ("_is_before", lambda one, other: False, "operations before another, an operation that is made before another"),
    ],
    ids=["nothing", "no_results", "ranks", "descriptions", "order"],
)
def test_what_an_imagined_release_changed_is_named(name, changed, told, monkeypatch):
    monkeypatch.setattr(joint, name, changed)
    assert joint.find_fault.__wrapped__().startswith(told)


def test_operations_are_in_order_without_a_method_that_says_so(monkeypatch):
    """As with jax 0.7."""
    monkeypatch.setattr(joint, "hasattr", lambda x, name: name != "is_before_in_block" and hasattr(x, name), raising=False)
    assert joint.find_fault.__wrapped__() is None
    assert count_calls(functools.partial(density_and_force), jnp.asarray(X, jnp.float32), jnp.asarray(M, jnp.float32)) == 1
