"""Arguments as users may give them: the names of their types, and arrays of what is an array for NumPy, too."""

from collections.abc import Sequence
from typing import Any, Literal

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._tracing.kinds import Given

Real = float | np.floating | np.integer  # a number that is known while tracing
Number = Real | Array  # also an array of the shape []
Size = int | np.integer
Flag = bool | np.bool_
Points = Array | np.ndarray[Any, Any] | Sequence[Sequence[float]]  # rows of coordinates, or a table of numbers
Numbers = Array | np.ndarray[Any, Any] | Sequence[float]  # one real number for each particle
Indices = Array | np.ndarray[Any, Any] | Sequence[int]  # one integer for each particle
IndexRows = Array | np.ndarray[Any, Any] | Sequence[Sequence[int]]  # rows of integers
Flags = Array | np.ndarray[Any, Any] | Sequence[bool]  # one bool for each particle
AnyCutoff = Number | Numbers | Points | tuple[Numbers, Numbers]  # one, one per particle, or a table for pairs of species
Backend = Literal["auto", "warp", "jax", "hashgrid", "brute"]
RadiusRule = Literal["gather", "scatter", "either", "both", "mean", "sum"]


def as_array(name: str, given: Given, dtype: np.dtype | None = None) -> Given:
    """Return lists of numbers as a NumPy array, and everything else as it is; refuse arrays of other libraries.

    Args:
        name: The argument, for errors.
        given: What a user passed.
        dtype: What a list of numbers is converted to; default: what NumPy makes of it.

    Raises:
        TypeError: a list is not one of numbers, or an array is neither one of JAX nor of NumPy, but can become one.
    """
    if isinstance(given, list | tuple):
        return _of_numbers(name, given, dtype)
    if not isinstance(given, Array | np.ndarray | np.generic) and hasattr(given, "__dlpack__"):
        kind = type(given)
        raise TypeError(
            f"{name} must be an array of JAX or NumPy, got {kind.__module__}.{kind.__qualname__}: pass jnp.from_dlpack({name}), "
            "which copies nothing."
        )
    return given


def default_float() -> np.dtype:
    """Return the dtype that lists of numbers have where nothing else is known: float64 in JAX's 64-bit mode, else float32."""
    return np.dtype(np.float64 if jax.config.read("jax_enable_x64") else np.float32)


def _of_numbers(name: str, given: list | tuple, dtype: np.dtype | None) -> np.ndarray:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(given)):
        raise TypeError(f"{name} must be an array, got a {type(given).__name__} of traced values: pass jnp.stack({name}).")
    try:
        array = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array, got a {type(given).__name__} of which NumPy makes none: {error}.") from None
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must be an array of numbers, got a {type(given).__name__} of which NumPy makes {array.dtype}.")
    return array.astype(dtype) if dtype is not None and array.dtype.kind != "b" else array
