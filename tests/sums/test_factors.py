"""Factors that stand before brackets: values stay as they are up to rounding, and fewer operations are left."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jfrnn
from jfrnn._sums.factors import factor_out
from jfrnn._sums.translate import translate_scalars


def evaluate(scalars, known, number):
    """Return the value of a scalar in float64."""
    node = scalars.nodes[number]
    if number not in known:
        given = [evaluate(scalars, known, k) for k in node.operands]
        known[number] = float(node.value) if node.value is not None else OPERATIONS[node.operation](*given)
    return known[number]


OPERATIONS = {
    **{"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "neg": lambda a: -a},
    **{"reciprocal": lambda a: 1 / a, "div": lambda a, b: a / b, "sqrt": np.sqrt},
}


def energy(x):
    sixth = 1 / (x @ x) ** 3
    return 4 * (sixth * sixth - sixth)


def faded(x):
    """An energy with a smooth end, of which each particle of a pair has half."""
    square = x @ x
    fade = (6.25 - square) ** 2 * (6.25 + 2 * square - 12) / 11.390625
    return energy(x) * fade / 2


# a function of three numbers, and how many operations it takes at most
FUNCTIONS = {
    "a force": (lambda x: -jax.grad(energy)(x) - jax.grad(energy)(x), 19),
    "a force and its derivative": (lambda x: jax.jvp(jax.grad(energy), (x,), (x,)), 60),
    "signs and twos": (lambda x: -(x * x[0] * 3 + x * x[0] * 3), 6),
    "twice a sign and a constant": (lambda x: -x[0] * 3.0 + -x[0] * 3.0, 1),
    "signs and constants": (lambda x: -(-x[0] * 3.0 * x[1]), 2),
    "some of several": (lambda x: x[0] * x[1] + x[2] + x[0] * x[2] - jnp.sqrt(x[1]), 6),
    "inner brackets": (lambda x: x[0] * x[1] * x[2] + x[0] * x[1] * x[1] + x[0] * x[2], 7),
    "signs and powers of two": (lambda x: 4 * (x[0] * 0.5) * x[1] - 2 * (-x[0] * x[1]) + (x[0] - x[2]) * (x[2] - x[0]) * 0.25, 8),
    "a force with a smooth end": (lambda x: jax.grad(faded)(x) * 0.5 + jax.grad(faded)(x) * 0.5, 35),
    "products in another order": (lambda x: x[0] * (x[1] * x[2]) + x[1] * (x[2] * x[0]) + jnp.sqrt(x[2] * (x[0] * x[1])), 5),
    "nothing in common": (lambda x: x[0] * x[1] + x[2] * x[2], 3),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_stay_and_operations_go(name):
    function, most = FUNCTIONS[name]
    scalars, (inputs,), results = translate_scalars(jax.make_jaxpr(function)(jnp.ones(3, jnp.float32)))
    outputs = [k for result in results for k in result.reshape(-1).tolist()]
    better = factor_out(scalars, outputs)
    for x in np.random.default_rng(1).uniform(0.5, 2, (5, 3)):
        known = dict(zip(inputs.tolist(), x.tolist(), strict=True))
        values, same = ([evaluate(scalars, dict(known), k) for k in numbers] for numbers in (outputs, [better[k] for k in outputs]))
        np.testing.assert_allclose(same, values, rtol=1e-9, atol=1e-9)
    count = {True: 0, False: 0}
    for is_better, numbers in ((False, outputs), (True, better.values())):
        count[is_better] = sum(bool(scalars.nodes[k].operands) for k in scalars.dependencies(numbers))
    assert count[True] <= min(count[False], most), count


LARGEST, LEAST = (float(x) for x in (np.finfo(np.float32).max, np.finfo(np.float32).tiny))
AT_THE_ENDS = {
    "a guard": lambda x: 1 / (2 * (x[0] * x[1]) * (x[0] + x[2]) * 2 + LEAST),
    "a smaller guard": lambda x: 1 / (2 * x[0] * x[2] * 2 * x[1] + LEAST),
    "a mask": lambda x: 0.5 * jnp.where(x[0] > 10, 0.5 * (x[0] * 0.5) * x[1] * 0.5, LARGEST),
    "a mask behind": lambda x: jnp.where(x[0] > 10, 0.5 * x[0] * (0.5 * x[1]), LARGEST) * 0.5,
    "a root": lambda x: jnp.sqrt(jnp.where(x[0] > 10, 0.5 * x[0] * x[1], LARGEST) * 0.5 * -1 * -1),
    "a power": lambda x: (x[0] * -8) * (x[1] * -8) * 1e-30 * 2.0**127 * 2.0**-100 * -1,
    "a sum with the largest": lambda x: (LARGEST - 4 * x[0]) * 0.5 + (x[1] * 0.25 - LEAST),
}


@pytest.mark.parametrize("name", AT_THE_ENDS)
@pytest.mark.filterwarnings("error")
def test_constants_stay_in_the_range_of_floats(name):
    """Masks and guards have the largest float, or the least: twice or half of it is none."""
    function = AT_THE_ENDS[name]
    scalars, _, (results,) = translate_scalars(jax.make_jaxpr(lambda x: jnp.reshape(function(x), 1))(jnp.ones(3, jnp.float32)))
    better = factor_out(scalars, results.tolist())
    x = jnp.asarray([[0, 0, 0], [0.25, 0, 0.5]], jnp.float32)
    constants = [scalars.value(k) for k in scalars.dependencies(better.values()) if scalars.value(k) is not None]
    assert all(value == 0 or LEAST <= abs(float(value)) <= LARGEST for value in constants), constants
    found = jfrnn.pair_sum(lambda r, i, j: function(r), x, 1.0, backend="warp")
    np.testing.assert_allclose(found, jax.vmap(function)(x[::-1] - x), rtol=1e-6)


@pytest.mark.parametrize("factor", [1, 3])
def test_what_rounding_takes_is_not_cancelled(factor):
    def error(x):
        a, b = (x[0], x[1]) if factor == 1 else (x[0] * x[2], x[1] * x[2])
        total = a + b
        return b - (total - a)

    scalars, _, results = translate_scalars(jax.make_jaxpr(error)(jnp.ones(3, jnp.float32)))
    outputs = [k for result in results for k in result.reshape(-1).tolist()]
    assert factor_out(scalars, outputs) == {k: k for k in outputs}
