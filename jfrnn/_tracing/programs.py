"""Compiled programs of the library: each shape needs its own, and their number is bounded.

JAX keeps the program of every shape as long as its function lives. A structure with another number of particles is another shape.
One program of XLA's CPU compiler takes up to 600 memory maps, of which Linux grants a process 65 530 by default.
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

MOST = 512  # most programs of all functions together, 1 to 4 MB each
_LOOK_EVERY = 16  # new programs between counts of memory maps, which take 1 to 20 ms; compiling takes a second
_SHARE = 0.5  # share of the memory maps of a process from which on programs are dropped

Option = Any  # a keyword of `jax.jit`
Lowered = Any  # the result of `lower` of a jitted function

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")
_functions: "list[Program[..., Any]]" = []
_seen = 0  # number of programs when memory maps were last counted


class Program(Generic[_Args, _Result]):
    """A compiled function; the library bounds the number of programs of all such functions together."""

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
        """Return the number of programs of this function: one per combination of shapes and static arguments."""
        return self._jitted._cache_size()

    def clear_cache(self) -> None:
        """Drop the programs of this function."""
        self._jitted.clear_cache()

    def lower(self, *args: Tree, **kwargs: Tree) -> Lowered:
        """Lower like a jitted function; arguments may be shapes instead of arrays."""
        return self._jitted.lower(*args, **kwargs)


def compile_program(function: Callable[_Args, _Result], **options: Option) -> Program[_Args, _Result]:
    """Compile a function like `jax.jit`, and drop all programs of the library if there are too many.

    Programs in use elsewhere, such as a program of the caller that calls this function, are not affected.
    """
    return Program(function, **options)


def program_count() -> int:
    """Return the number of compiled programs that the library holds."""
    return sum(function.cache_size() for function in _functions)


def clear_programs() -> None:
    """Drop all compiled programs of the library; functions that are called again are compiled again."""
    for function in _functions:
        function.clear_cache()


def at_once() -> AbstractContextManager[None]:
    """Evaluate calls with concrete arrays immediately, even while tracing, with the programs of eager calls.

    `jax.ensure_compile_time_eval` would also evaluate constants inside these programs operation by operation, each of which is
    compiled for each shape.
    """
    return jax.core.eval_context()


def on_device(x: Given) -> Array:
    """Return `jnp.asarray(x)`, replicated if it is sharded over explicit mesh axes, and concrete if x is.

    NumPy arrays are transferred without the program that `jnp.asarray` compiles for each shape, unless a guard has to see the
    transfer.
    """
    if isinstance(x, Tracer):
        return gather(x)
    with at_once():
        if isinstance(x, Array):
            return gather(jnp.asarray(x))
        copied = np.array(x)  # JAX may share memory with this array, so it must not be the caller's
        return jnp.asarray(copied) if guards_transfers() else jax.device_put(copied)


def make_on_host(x: Given, how: Callable[[np.ndarray], np.ndarray]) -> Array:
    """Return on the device what a NumPy function makes of a concrete array, so that no program is compiled for its shape."""
    with own_transfers() if isinstance(x, Array) else contextlib.nullcontext():
        return on_device(how(np.asarray(jax.device_get(x) if isinstance(x, Array) else x)))


def _keep_bounded() -> None:
    global _seen
    count = program_count()
    if count < _seen:  # caches have been cleared
        _seen = 0
    if count < _seen + _LOOK_EVERY:
        return
    if count > MOST or _maps_are_scarce():
        clear_programs()
        count = program_count()
    _seen = count


def _maps_are_scarce() -> bool:
    """Say whether this process uses a large share of the memory maps that Linux grants; other systems have no such limit."""
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        with Path("/proc/self/maps").open("rb") as maps:
            return sum(1 for _ in maps) > _SHARE * limit
    except (
        FileNotFoundError,
        PermissionError,
        ValueError,
    ):  # not OSError: a handler of signals may raise TimeoutError, which is one
        return False
