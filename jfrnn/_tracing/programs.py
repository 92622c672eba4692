"""Compiled programs of the library: each shape compiles its own, and no process keeps more of them than it can bear.

JAX keeps what it compiled for a shape as long as the function lives. A structure with another number of particles is another
shape, and one program of XLA's CPU compiler takes up to 600 memory maps, of which Linux grants a process 65 530 by default.
"""

import contextlib
import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._tracing.kinds import Given, Tree
from jfrnn._tracing.modes import gather, guards_transfers, own_transfers

MOST = 512  # programs of all functions together: 1 to 4 MB each
_LOOK_EVERY = 16  # new programs after which memory maps are counted: a millisecond or twenty, against a second of compilation
_SHARE = 0.5  # of the memory maps that a process may have, from which on programs are given up

Option = Any  # a keyword of `jax.jit`
Lowered = Any  # what `lower` of `jax.jit` returns: a program that can be compiled for shapes

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")
_functions: "list[Program[..., Any]]" = []
_seen = 0  # how many programs there were when memory maps were last counted


class Program(Generic[_Args, _Result]):
    """A compiled function, one of those of which the library keeps only so many programs."""

    def __init__(self, function: Callable[_Args, _Result], **options: Option) -> None:
        self._jitted: Any = jax.jit(function, **options)
        _functions.append(self)
        functools.update_wrapper(self, function)

    def __call__(self, *args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        """Compile for new shapes, and run."""
        result = self._jitted(*args, **kwargs)
        _keep_bounded()
        return result

    def cache_size(self) -> int:
        """Return how many programs are kept of this function: one per combination of shapes and static arguments."""
        return self._jitted._cache_size()

    def clear_cache(self) -> None:
        """Let go of the programs of this function."""
        self._jitted.clear_cache()

    def lower(self, *args: Tree, **kwargs: Tree) -> Lowered:
        """Do as `lower` of what `jax.jit` returns: shapes may stand for arrays."""
        return self._jitted.lower(*args, **kwargs)


def compile_program(function: Callable[_Args, _Result], **options: Option) -> Program[_Args, _Result]:
    """Compile a function as `jax.jit` does, and let go of all programs of the library when there are too many.

    What is in use elsewhere, such as a program of the caller that calls this function, stays as it is.
    """
    return Program(function, **options)


def program_count() -> int:
    """Return how many compiled programs the library keeps."""
    return sum(function.cache_size() for function in _functions)


def clear_programs() -> None:
    """Let go of all compiled programs of the library; what is called again is compiled again."""
    for function in _functions:
        function.clear_cache()


def at_once() -> AbstractContextManager[None]:
    """Compute what concrete arrays give at once, also while something is traced, with the programs that eager calls use.

    `jax.ensure_compile_time_eval` would evaluate what is constant inside these programs, too, operation by operation, each of which
    is compiled for each shape.
    """
    return jax.core.eval_context()


def on_device(x: Given) -> Array:
    """Return `jnp.asarray(x)` in one piece, concrete where x is.

    Of NumPy's arrays it does so without the program that this compiles for each shape, but where a guard is to see the transfer.
    """
    if isinstance(x, Tracer):
        return gather(jnp.asarray(x))
    with at_once():
        if isinstance(x, Array):
            return gather(jnp.asarray(x))
        copied = np.array(x)  # where JAX shares memory with an array, it must not be the caller's
        return jnp.asarray(copied) if guards_transfers() else jax.device_put(copied)


def make_on_host(x: Given, how: Callable[[np.ndarray], np.ndarray]) -> Array:
    """Return on the device what a function of NumPy makes of an array that is known: no program is compiled for its shape."""
    with own_transfers() if isinstance(x, Array) else contextlib.nullcontext():
        return on_device(how(np.asarray(jax.device_get(x))))


def _keep_bounded() -> None:
    global _seen
    count = program_count()
    if count < _seen:  # somebody cleared the caches
        _seen = 0
    if count < _seen + _LOOK_EVERY:
        return
    if count > MOST or _maps_are_scarce():
        clear_programs()
        count = program_count()
    _seen = count


def _maps_are_scarce() -> bool:
    """Say whether this process has most of the memory maps that Linux grants it; no other system counts them."""
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        with Path("/proc/self/maps").open("rb") as maps:
            return sum(1 for _ in maps) > _SHARE * limit
    except (OSError, ValueError):
        return False
