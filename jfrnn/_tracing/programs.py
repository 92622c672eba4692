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
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import jax

from jfrnn._tracing.arguments import Tree

MOST = 512  # most programs of all functions together
_LOOK_EVERY = 8  # new programs between looks at the memory and its maps, which take 1 to 20 ms; compiling takes a second
_FEWEST, _MOST_BYTES = 16, 40 << 20  # so many programs are kept, whatever else takes memory; more, while that has grown by less
_USES = 4  # calls of each of its programs with which a function is one of a loop; those of a data set come once or twice
_SHARE = 0.5  # share of the memory maps of a process from which on programs are dropped

Option = Any  # a keyword of `jax.jit`
Lowered = Any  # the result of `lower` of a jitted function

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")
_functions: "dict[Program[..., Any], None]" = {}  # those that have been called
_seen = 0  # number of programs when memory was last looked at
_before: int | None = None  # what was resident when programs were last dropped, or first looked at [B]


class Program(Generic[_Args, _Result]):
    """A compiled function, as `jax.jit` makes it; all programs of the library are dropped if there are too many.

    Programs in use elsewhere, such as a program of the caller that calls this function, are not affected.
    """

    def __init__(self, function: Callable[_Args, _Result], **options: Option) -> None:
        self._function, self._options, self.calls = function, options, 0
        functools.update_wrapper(self, function)

    @functools.cached_property
    def _jitted(self) -> Any:  # noqa: ANN401
        """A jitted function of its own identity, with which all goes that JAX keeps of it, traces included."""
        _functions[self] = None
        return jax.jit(functools.partial(self._function), **self._options)

    def __call__(self, *args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        """Compile for new shapes, and run."""
        self.calls += 1
        result = self._jitted(*args, **kwargs)
        _keep_bounded()
        return result

    def cache_size(self) -> int:
        """Return the number of programs of this function: one per combination of shapes and static arguments."""
        return self._jitted._cache_size() if self in _functions else 0

    def clear_cache(self) -> None:
        """Drop the programs of this function."""
        _functions.pop(self, None)
        jitted, self.calls = vars(self).pop("_jitted", None), 0
        if jitted is not None:
            jitted.clear_cache()

    def lower(self, *args: Tree, **kwargs: Tree) -> Lowered:
        """Lower like a jitted function; arguments may be shapes instead of arrays."""
        return self._jitted.lower(*args, **kwargs)


compile_program = Program  # as functions are decorated with it


def program_count() -> int:
    """Return the number of compiled programs that the library holds."""
    return sum([function._jitted._cache_size() for function in list(_functions)])  # a list takes less time than a generator


def clear_programs(reused: bool = True) -> None:
    """Drop compiled programs of the library, and give their memory back; functions that are called again are compiled again.

    Without `reused`, those stay whose functions call each of their programs several times, as in a loop over steps.
    """
    for function in list(_functions):
        if reused or function.calls < _USES * function.cache_size():
            function.clear_cache()
    with contextlib.suppress(OSError, AttributeError):  # other C libraries than glibc have no such function
        ctypes.CDLL(None).malloc_trim(0)


class _WithOthers:
    """A cache in the list of those that `jax.clear_caches` clears, which keeps no hold of freed memory by itself."""

    def cache_clear(self) -> None:
        clear_programs()

    def cache_info(self) -> None:
        return None

    def cache_keys(self) -> list[Any]:
        return []


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
    except (FileNotFoundError, PermissionError, ValueError):  # not OSError, one of which a handler of signals may raise
        return False


_listed = _WithOthers()
with contextlib.suppress(ImportError, AttributeError, TypeError):  # where this JAX keeps no list of caches
    from jax._src.util import register_cache

    register_cache(_listed, "programs of jfrnn")
