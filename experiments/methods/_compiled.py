"""What the library compiles, before it is timed and its memory measured."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.methods import at_hand


def compile_for(function: Callable[..., Any], positions: np.ndarray, *more: jax.Array, kernels: bool = True) -> Callable[[], Any]:
    """Compile `function(positions, *more)`, and return it; every call reads the positions anew and waits for the result.

    With `kernels` of Warp it runs on one particle here: they compile when they first run, as does what makes an array.
    """
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    jitted = jax.jit(function)
    given = (positions, *more)
    compiled = jitted.lower(*(jax.ShapeDtypeStruct(values.shape, values.dtype) for values in given)).compile()
    x = at_hand(positions)
    if kernels:
        jax.block_until_ready(jitted(*(jnp.asarray(values)[:1] for values in (x, *more))))
    return lambda: jax.block_until_ready(compiled(jnp.asarray(x), *more))
