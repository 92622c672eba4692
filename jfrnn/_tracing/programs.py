"""Compiled programs of the library: each shape needs its own, and their number is bounded.

JAX keeps the program of every shape as long as its function lives. A structure with another number of particles is another shape.
One program of XLA's CPU compiler takes about 2 MB, and up to 600 memory maps, of which Linux grants a process 65 530 by default.
glibc keeps what is freed for itself, unless it is asked to give it back.
"""

import contextlib
import ctypes
import functools
import mmap
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

MOST = 512  # most programs of all functions together
_LOOK_EVERY = 8  # new programs between looks at the memory and its maps, which take 1 to 20 ms; compiling takes a second
_FEWEST, _MOST_BYTES = 16, 40 << 20  # so many programs are kept, whatever else takes memory; more, while that has grown by less
_USES = 4  # calls of each of its programs with which a function is one of a loop; those of a data set come once or twice
_SHARE = 0.5  # share of the memory maps of a process from which on programs are dropped

Option = Any  # a keyword of `jax.jit`
Lowered = Any  # the result of `lower` of a jitted function

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")
_functions: "list[Program[..., Any]]" = []
_seen = 0  # number of programs when memory was last looked at
_before: int | None = None  # what was resident when programs were last dropped, or first looked at [B]


class Program(Generic[_Args, _Result]):
    """A compiled function; the library bounds the number of programs of all such functions together."""

    def __init__(self, function: Callable[_Args, _Result], **options: Option) -> None:
        self._function, self._options, self.calls = function, options, 0
        self._jitted = self._compile_anew()
        _functions.append(self)
        functools.update_wrapper(self, function)

    def _compile_anew(self) -> Any:  # noqa: ANN401
        """Return a jitted function of its own identity, with which all goes that JAX keeps of it, traces included."""

        @functools.wraps(self._function)
        def function(*args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
            return self._function(*args, **kwargs)

        return jax.jit(function, **self._options)

    def __call__(self, *args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        """Compile for new shapes, and run."""
        self.calls += 1
        result = self._jitted(*args, **kwargs)
        _keep_bounded()
        return result

    def cache_size(self) -> int:
        """Return the number of programs of this function: one per combination of shapes and static arguments."""
        return self._jitted._cache_size()

    def clear_cache(self) -> None:
        """Drop the programs of this function."""
        self._jitted.clear_cache()
        self._jitted, self.calls = self._compile_anew(), 0

    @property
    def is_reused(self) -> bool:
        """Whether its programs have been called several times each, since it was last cleared."""
        return self.calls >= _USES * self.cache_size()

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


def clear_programs(reused: bool = True) -> None:
    """Drop compiled programs of the library, and give their memory back; functions that are called again are compiled again.

    Without `reused`, those stay whose functions call each of their programs several times, as in a loop over steps.
    """
    for function in _functions:
        if reused or not function.is_reused:
            function.clear_cache()
    trim = _trim()
    if trim is not None:
        trim(0)


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """Return the function of glibc that gives freed memory back to the system; None with other C libraries."""
    with contextlib.suppress(OSError, AttributeError):
        return ctypes.CDLL(None).malloc_trim
    return None


class _WithOthers:
    """A cache in the list of those that `jax.clear_caches` clears, which keeps no hold of freed memory by itself."""

    def cache_clear(self) -> None:
        clear_programs()

    def cache_info(self) -> None:
        return None

    def cache_keys(self) -> list[Any]:
        return []


def _clear_with_others() -> _WithOthers | None:
    """Have `jax.clear_caches` clear the programs of the library; None where this JAX keeps no list of caches."""
    with contextlib.suppress(ImportError, AttributeError, TypeError):
        from jax._src.util import register_cache

        cache = _WithOthers()
        register_cache(cache, "programs of jfrnn")
        return cache
    return None


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
    """Drop programs if there are too many, or if they have taken much memory; look only where there are new ones."""
    global _seen, _before
    count = program_count()
    if count < _seen:  # caches have been cleared
        _seen, _before = 0, None
    if count < _seen + _LOOK_EVERY:
        return
    used = _resident_bytes()
    _before = used if _before is None else _before
    if count > MOST or _maps_are_scarce():
        clear_programs()
        count, _before = program_count(), _resident_bytes()
    elif count > _FEWEST and used - _before > _MOST_BYTES:
        clear_programs(reused=False)
        count, _before = program_count(), _resident_bytes()
    _seen = count


def _resident_bytes() -> int:
    """Return the memory of this process [B]; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE
    except (FileNotFoundError, PermissionError, ValueError, IndexError):
        return 0


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


_listed = _clear_with_others()
