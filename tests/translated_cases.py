"""Functions to translate: every primitive that has a translation, and what pairs of particles are summed over.

Each says how many units in the last place it may be off.
"""

import itertools
import math

import jax
import numpy as np
from jax import lax
from jax import numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from translated import Case

N = 1024
EDGES = [0, -0.0, np.inf, -np.inf, np.nan, 1, -1, 0.5, -0.5, 1.5, -1.5, 2.5, -2.5, 2, -2, 3, 1e-8, -1e-8, 1e4, -1e4]
EXTREMES = {
    "float32": [1e-40, -1e-40, 2e-38, 3e38, -3e38, 2147483648.0, -2147483648.0],
    "float64": [3e-308, 1e308, -1e308, 2.0**63],
}


def random_reals(rng, shape, real):
    """Draw numbers of every size around 1, half of them negative."""
    return (rng.choice([-1, 1], shape) * 10.0 ** rng.uniform(-5, 3, shape)).astype(real)


def anything(*arity_and_bounds):
    """Draw scalars: pairs of edge cases, then random numbers, within bounds if there are any."""
    arity, low, high = arity_and_bounds

    def draw(rng, real):
        columns = [random_reals(rng, N, real) for _ in range(arity)]
        special = list(itertools.product(np.array(EDGES + EXTREMES[real], real), repeat=min(arity, 2)))
        for column, values in zip(columns, zip(*special)):
            column[: len(values)] = values
        if low is not None:
            columns = [
                np.where(np.isfinite(x) & ~((x > low) & (x < high)), rng.uniform(low, high, N), x).astype(real) for x in columns
            ]
        return columns

    return draw


def one(function, ulp=0, low=None, high=None, exact=None):
    return Case(function, ((),), anything(1, low, high), ulp, exact=exact)


def two(function, ulp=0, low=None, high=None):
    return Case(function, ((), ()), anything(2, low, high), ulp)


ELEMENTWISE = {  # ulp in float32 and in float64
    "add": two(lambda x, y: x + y, 0.5),
    "sub": two(lambda x, y: x - y, 0.5),
    "mul": two(lambda x, y: x * y, 0.5),
    "div": two(lambda x, y: x / y, 0.5),
    "rem": two(lax.rem),
    "neg": one(lambda x: -x),
    "abs": one(jnp.abs),
    "sign": one(jnp.sign),
    "max": two(jnp.maximum),
    "min": two(jnp.minimum),
    "clamp": Case(lambda low, x, high: lax.clamp(low, x, high), ((),) * 3, anything(3, None, None)),
    "eq": two(lambda x, y: x == y),
    "ne": two(lambda x, y: x != y),
    "lt": two(lambda x, y: x < y),
    "le": two(lambda x, y: x <= y),
    "gt": two(lambda x, y: x > y),
    "ge": two(lambda x, y: x >= y),
    "floor": one(jnp.floor),
    "ceil": one(jnp.ceil),
    "round": one(lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO)),
    "round_even": one(jnp.round),
    "sqrt": one(jnp.sqrt, 0.5),
    "rsqrt": one(lax.rsqrt, 2),
    "cbrt": one(jnp.cbrt, 4, exact=np.cbrt),
    "exp": one(jnp.exp, 2),
    "exp2": one(jnp.exp2, 2, exact=np.exp2),
    "expm1": one(jnp.expm1, 3),
    "log": one(jnp.log, 2),
    "log1p": one(jnp.log1p, 3, exact=np.log1p),
    "logistic": one(jax.nn.sigmoid, 4, -80, 1e3),
    "erf": one(lax.erf, 2),
    "erfc": one(lax.erfc, 4, exact=np.vectorize(math.erfc)),
    "is_finite": one(jnp.isfinite),
    "sin": one(jnp.sin, 3),
    "cos": one(jnp.cos, 3),
    "tan": one(jnp.tan, 5),
    "asin": one(jnp.arcsin, 2, exact=np.arcsin),
    "acos": one(jnp.arccos, 2),
    "atan": one(jnp.arctan, 2, exact=np.arctan),
    "atan2": two(jnp.arctan2, 2),
    "sinh": one(jnp.sinh, 3, exact=np.sinh),
    "cosh": one(jnp.cosh, 3, exact=np.cosh),
    "tanh": one(jnp.tanh, 4, exact=np.tanh),
    "pow": two(lambda x, y: x**y, 2),
    "square": one(jnp.square, 0.5),
    "integer_pow": one(lambda x: (x**1, x**2, x**3, x**7, x**-1, x**-2, x**-3), 4, -1e3, 1e3),
    "power_of_constant": one(lambda x: (2.0**x, 10.0**x, x**0.5, x**1.5, x**2.0, x**-3.0, x**7.0, x**0.0, x**9.0), 4, -300, 300),
    "select_n": two(lambda x, y: jnp.where(x > y, x, -y)),
    "isnan": one(lambda x: jnp.isnan(x) | jnp.isinf(x) ^ ~(x > 1) & (x < 3)),
    "to_int": one(lambda x: (x.astype(jnp.int32), x.astype(bool), (x > 0).astype(x.dtype), (x > 0).astype(jnp.int32))),
    "to_long": one(lambda x: jnp.clip(x, -1e9, 1e9).astype(jnp.int64)),
    "copy": one(lambda x: (jnp.copy(x), lax.stop_gradient(x), lax.optimization_barrier(x), checkpoint_name(x, "x"))),
    "nothing": one(lambda x: (x * 1, x + 0.0, x - 0.0, -0.0 + x, x / 1, -jnp.negative(x), x * 0, x * -1)),
}


def integers(rng, real):
    values = rng.integers(-20, 20, (2, N)).astype(real)
    pairs = list(itertools.product([0, 1, -1, 7, -7, -(2.0**31), 2.0**24], repeat=2))
    values[:, : len(pairs)] = np.transpose(pairs)
    return list(values)


def of_integers(function):
    def both(a, b):
        return function(a, b), function(a.astype(jnp.int64), b.astype(jnp.int64))

    return Case(both, ((), ()), integers, dtypes=("int32", "int32"))


INTEGERS = {
    "int_add": of_integers(lambda a, b: (a + b, a - b, a * b, -a)),
    "int_div": of_integers(lambda a, b: (lax.div(a, b), lax.rem(a, b))),
    "int_bits": of_integers(lambda a, b: (a & b, a | b, a ^ b, ~a)),
    "int_order": of_integers(lambda a, b: (jnp.minimum(a, b), jnp.maximum(a, b), jnp.sign(a), jnp.abs(b), lax.clamp(b, a, b + 3))),
    "int_compare": of_integers(lambda a, b: (a < b, a <= b, a == b, a != b, a > b, a >= b)),
    "int_power": of_integers(lambda a, b: (a**2 + b**5, a.astype(jnp.float32), (a > 0).astype(b.dtype) + b)),
    "int_select": of_integers(lambda a, b: lax.select_n(jnp.clip(a, 0, 2).astype(jnp.int32), a, b, a + b)),
    "bools": of_integers(
        lambda a, b: ((a > 0) == (b > 0), (a > 0) < (b > 0), lax.max(a > 0, b > 1), jnp.where(a > 1, b > 1, a < -1))
    ),
    "switch": of_integers(lambda a, b: lax.switch(a.astype(jnp.int32), [lambda b: b, lambda b: b + 1, lambda b: b * b], b)),
}


def vectors(*shapes):
    def draw(rng, real):
        return [rng.uniform(-2, 2, (N, *shape)).astype(real) for shape in shapes]

    return draw


def shaped(function, *shapes, ulp=0, scale=0):
    return Case(function, shapes, vectors(*shapes), ulp, scale)


@jax.custom_vjp
def doubled(x):
    return 2 * x


doubled.defvjp(lambda x: (2 * x, None), lambda _, g: (3 * g,))


def by_data(a):
    """Read and write by indices that are data: negative ones, and some that are out of range."""
    k, l = jnp.floor(2 * a[:, 0]).astype(jnp.int32)  # noqa: E741
    both = jnp.stack([k, l])
    each = jax.vmap(lambda row, k: row[k])
    read = a[k, l], a[both], a.at[:, k].get(mode="fill"), a.at[k, l].get(mode="clip"), jnp.take(a, both, axis=1), each(a, both)
    windows = lax.dynamic_slice(a, (k, l), (1, 2)), lax.dynamic_update_slice(a, a[:1, :2], (k, l)), lax.dynamic_index_in_dim(a, k)
    numbers = jnp.take(a[0], k), a[1].at[k].get(mode="fill"), a.at[k, l].get(mode="fill", fill_value=7)
    written = a.at[k, 1].set(7), a.at[:, both].add(a[:, :2]), a.at[k].add(1, mode="clip"), jnp.zeros(3, a.dtype).at[k].set(a[0, 0])
    slopes = jax.grad(lambda a: a[k, l] + (each(a, both) ** 2).sum() + a.at[l].get(mode="fill", fill_value=0).sum())(a)
    return read, windows, numbers, written, slopes


SHAPES = {
    "reshape": shaped(lambda a: (a.T, a.reshape(3, 2), a.reshape(-1), lax.reshape(a, (6,), (1, 0)), a[None, ..., None]), (2, 3)),
    "broadcast": shaped(lambda a, b: (a + b[:, None], jnp.broadcast_to(b, (3, 2)), a * b[0]), (2, 3), (2,), ulp=0.5),
    "slice": shaped(lambda a: (a[1], a[:, ::2], a[:, ::-1], a[-1, 1:], a[0, 0]), (2, 3)),
    "concatenate": shaped(
        lambda a: (jnp.concatenate([a, a[:1]]), jnp.stack([a, -a], 1), jnp.tile(a, (2, 1)), jnp.repeat(a, 2)), (2, 3)
    ),
    "split": shaped(lambda a: (jnp.split(a, [1], axis=1), tuple(jnp.unstack(a, axis=1)), jnp.squeeze(a[:1])), (2, 3)),
    "pad": shaped(
        lambda a: (
            jnp.pad(a, 1),
            lax.pad(a, a[0, 0], ((1, -1, 2), (-1, 2, 1))),
            lax.pad(a, a.dtype.type(1), ((0, 0, 0), (0, 0, 3))),
        ),
        (2, 3),
    ),
    "iota": shaped(
        lambda a: (a + jnp.arange(3.0, dtype=a.dtype), a * lax.iota(a.dtype, 3), jnp.eye(3, dtype=a.dtype)), (2, 3), ulp=0.5
    ),
    "gather": shaped(lambda a: (a[jnp.array([1, 0, 1])], a[:, jnp.array([2, -1])], a.at[:, 5].get(mode="fill")), (2, 3)),
    "scatter": shaped(
        lambda a: (a.at[0, 1].set(7), a.at[:, jnp.array([1, 1])].add(a[:, :2]), a.at[0].add(1)), (2, 3), ulp=1, scale=4
    ),
    "dynamic_slice": shaped(
        lambda a: (lax.dynamic_slice(a, (1, 1), (1, 2)), lax.dynamic_update_slice(a, a[:1, :1], (1, 2))), (2, 3)
    ),
    "by data": shaped(by_data, (2, 3), ulp=1, scale=4),
    "reduce": shaped(lambda a: (a.sum(), a.sum(0), a.prod(1), a.mean(), jnp.zeros((0, 3), a.dtype).sum(0)), (2, 3), ulp=4, scale=4),
    "extremes": shaped(
        lambda a: (a.max(), a.min(0), (a > 0).any(), (a > -1).all(1), (a > 0).sum(), jnp.bitwise_xor.reduce(a > 0, axis=0)), (2, 3)
    ),
    "extremes of nothing": shaped(lambda a: (a[:0].min(0, initial=9), a[:0].max(0, initial=-9)), (2, 3)),
    "running": shaped(
        lambda a: (jnp.cumsum(a, 1), jnp.cumprod(a, 0), lax.cummax(a, 1), lax.cummin(a, 1, reverse=True)), (2, 3), ulp=2, scale=4
    ),
    "dot": shaped(
        lambda a, b: (a @ b, b @ b.T, a[0] @ b[:, 0], jnp.einsum("ij,kj->ik", a, a), jnp.outer(a, b)),
        (2, 3),
        (3, 2),
        ulp=4,
        scale=4,
    ),
    "batched_dot": shaped(lambda a: jnp.einsum("bij,bjk->bik", a, a), (2, 3, 3), ulp=4, scale=4),
    "determinant": shaped(lambda a: (jnp.linalg.det(a), jnp.trace(a), jnp.cross(a[0], a[1])), (3, 3), ulp=8, scale=8),
    "nested": shaped(lambda a: jax.jit(lambda a: jax.checkpoint(jax.jit(jnp.sin))(a) + doubled(a))(a), (3,), ulp=2, scale=1),
    "cond": shaped(lambda a: lax.cond(a[0] > 0, lambda a: (a, a[0]), lambda a: (-a, a[1]), a), (3,)),
    "derivatives": shaped(
        lambda a: (jax.grad(lambda a: doubled(a[jnp.array([0, 0])]).sum())(a), jax.jacobian(lambda a: a * a[1:].sum())(a)),
        (3,),
        ulp=4,
        scale=4,
    ),
    "activations": shaped(
        lambda a: (jax.nn.softplus(a), jax.nn.relu(a), jax.nn.gelu(a), jax.nn.silu(a), jax.nn.softmax(a), jax.nn.logsumexp(a)),
        (3,),
        ulp=8,
        scale=1,
    ),
}


# --- pair functions ---------------------------------------------------------------------------------------------------


def poly6(r):
    return jnp.where(r @ r < 1, (1 - r @ r) ** 3, 0)


@jax.custom_jvp
def safe_norm(r):
    square = r @ r
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


@safe_norm.defjvp
def _(primals, tangents):
    (r,), (t,) = primals, tangents
    length = safe_norm(r)
    return length, (r @ t) / jnp.where(length > 0, length, 1)


def cubic_spline(r):
    q = 2 * jnp.linalg.norm(jnp.where((r != 0).any(), r, jnp.ones_like(r)))
    inner, outer = 1 - 1.5 * q**2 + 0.75 * q**3, 0.25 * (2 - q) ** 3
    return jnp.where((r != 0).any(), jnp.where(q < 1, inner, jnp.where(q < 2, outer, 0)), 1) * 8 / jnp.pi


def wendland(r):
    q = safe_norm(r)
    return jnp.maximum(1 - q, 0) ** 4 * (1 + 4 * q)


def lennard_jones(r, sigma):
    square = r @ r
    near = square < 2.25
    power = (sigma**2 / jnp.where(near, square, 1)) ** 3
    return jnp.where(near, 4 * (power**2 - power), 0)


def viscosity(r, v_i, v_j, rho_i, rho_j, parameters):
    mass, mu, h = parameters
    slope = jax.grad(wendland)(r / h) / h
    return mass * mu * (v_j - v_i) * (r @ slope) / (rho_i * rho_j * (r @ r + 0.01 * h**2))


def morse(r, depth):
    return depth * (1 - jnp.exp(-1.5 * (jnp.linalg.norm(r) - 0.7))) ** 2 + jax.scipy.special.erfc(r @ r) / (1 + jnp.tanh(r[0]))


def twice(function, *others):
    """Return the gradient of a function of r and its Hessian."""
    return lambda r, *others: (jax.grad(function)(r, *others), jax.hessian(function)(r, *others))


def displacements(*shapes):
    """Draw displacements [n, 3], the first of them 0, and positive values of other shapes."""

    def draw(rng, real):
        r = rng.uniform(-0.8, 0.8, (N, 3))
        r += 0.4 * np.sign(r)
        r[:4] = 0
        return [x.astype(real) for x in (r, *(rng.uniform(0.5, 1.5, (N, *shape)) for shape in shapes))]

    return draw


def of_pair(function, *shapes, ulp=32, scale=1):
    return Case(function, ((3,), *shapes), displacements(*shapes), ulp, scale)


PAIRS = {
    "poly6": of_pair(poly6),
    "poly6_twice": of_pair(twice(poly6), ulp=64),
    "cubic_spline": of_pair(cubic_spline),
    "cubic_spline_twice": of_pair(twice(cubic_spline), ulp=256),
    "wendland": of_pair(wendland),
    "wendland_gradient": of_pair(jax.grad(wendland)),
    "wendland_twice": of_pair(lambda r: jax.grad(lambda r: jax.grad(wendland)(r) @ jnp.arange(3.0, dtype=r.dtype))(r), ulp=64),
    "lennard_jones": of_pair(lennard_jones, (), ulp=64, scale=8),
    "lennard_jones_twice": of_pair(twice(lennard_jones), (), ulp=256, scale=1e4),
    "viscosity": of_pair(viscosity, (3,), (3,), (), (), (3,)),
    "viscosity_gradient": of_pair(
        jax.grad(lambda *a: viscosity(*a).sum(), (0, 1, 3, 5)), (3,), (3,), (), (), (3,), ulp=256, scale=4
    ),
    "morse": of_pair(morse, ()),
    "matrices": of_pair(lambda r, b: (b @ r * poly6(r), jnp.outer(r, b @ r), r @ b @ r), (3, 3), scale=4),
    "clip": of_pair(lambda r: (jnp.clip(r, -0.5, 0.5), jnp.clip(r @ r, None, 1))),
}


# --- random functions -------------------------------------------------------------------------------------------------


def random_function(rng, depth):
    """Return a function of x and y, bounded and smooth enough that rounding stays small; x > y decides where it selects."""
    if depth == 0:
        return [lambda x, y: x, lambda x, y: y, lambda x, y: x * y, lambda x, y: y - 0.5][rng.integers(4)]
    f, g = random_function(rng, depth - 1), random_function(rng, depth - 1)
    return [
        lambda x, y: f(x, y) + g(x, y),
        lambda x, y: f(x, y) - g(y, x),
        lambda x, y: jnp.sin(f(x, y)) * jnp.cos(g(x, y)),
        lambda x, y: jnp.tanh(f(x, y)) / (1 + g(x, y) ** 2),
        lambda x, y: jnp.exp(-jnp.abs(f(x, y))) * g(x, y),
        lambda x, y: jnp.maximum(f(x, y), g(x, y)),
        lambda x, y: jnp.where(x > y, f(x, y), g(x, y)),
        lambda x, y: jnp.sqrt(1 + f(x, y) ** 2) - jnp.log1p(g(x, y) ** 2),
        lambda x, y: jnp.stack([f(x, y), g(x, y)])[::-1] @ jnp.stack([g(y, x), f(y, x)]) / 4,
    ][rng.integers(9)]


RANDOM = {
    f"random_{seed}": Case(random_function(np.random.default_rng(seed), 4), ((), ()), vectors((), ()), ulp=512, scale=4)
    for seed in range(16)
}
CASES = ELEMENTWISE | INTEGERS | SHAPES | PAIRS | RANDOM
