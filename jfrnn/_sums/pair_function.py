"""Call the user's function of a pair, and explain its errors."""

import functools
import inspect
from collections.abc import Callable

import jax
from jax import Array

from jfrnn._tracing import Tree

_NEEDS_A_VALUE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def call_with_pair(fn: Callable[[Array, Tree, Tree], Tree], r: Array, i: Tree, j: Tree) -> Tree:
    """Return fn(r, i, j) for one traced pair; an error of fn gets a note that describes its arguments.

    A TypeError says that fn does not take three arguments, or needs a concrete value, as `if` does.
    """
    _check_signature(fn, r, i, j)
    try:
        return fn(r, i, j)
    except _NEEDS_A_VALUE as error:
        raise TypeError(
            f"fn ({_name_of(fn)}) asks what a number is, as `if`, `and`, `float()` and functions of NumPy do. It is traced once "
            "for all pairs, so numbers are not known: write jnp.where(condition, a, b) instead of `if`, & instead of `and`, "
            f"and jnp instead of np. {_describe_arguments(r, i, j)}"
        ) from error
    except Exception as error:
        error.add_note(f"Raised by fn ({_name_of(fn)}) of a pair sum. {_describe_arguments(r, i, j)}")
        raise


def _check_signature(fn: Callable[..., Tree], r: Array, i: Tree, j: Tree) -> None:
    try:
        signature = inspect.signature(fn)
    except (TypeError, ValueError):  # some built-in functions have no signature
        return
    try:
        signature.bind(r, i, j)
    except TypeError as error:
        names = ", ".join(map(str, signature.parameters))
        raise TypeError(
            f"fn must take three arguments, (r, i, j), also where it reads but one of them; {_name_of(fn)} takes ({names}). "
            f"{_describe_arguments(r, i, j)}"
        ) from error


def _name_of(fn: object) -> str:
    while isinstance(fn, functools.partial):
        fn = fn.func
    return getattr(fn, "__name__", type(fn).__name__)


class _Shape(str):
    """A text that is its own `repr`, so that a pytree of shapes prints readably."""

    __repr__ = str.__str__


def _describe_arguments(r: Array, i: Tree, j: Tree) -> str:
    """Describe the arguments that fn gets for a pair."""

    def describe(values: Tree) -> str:
        if not jax.tree.leaves(values):
            return f"{values!r}, as no values were given"
        return repr(jax.tree.map(lambda x: _Shape(f"{x.dtype}{list(x.shape)}"), values))

    return f"What it gets of a pair: r = x_j - x_i, {r.dtype}{list(r.shape)}; i = {describe(i)}; j = {describe(j)}."
