"""Arguments as users may give them: the names of their types, and the arrays on the device that become of them.

JAX's modes say what may become of them. `jax_numpy_rank_promotion="raise"` forbids operands of different rank.
`jax.transfer_guard("disallow")` forbids implicit transfers between host and device, also of the library's own numbers. On a mesh
with explicit axes, the type of an array tells over which axes it is sharded, and sorts, sums and lookups along such an axis are
forbidden. In a process that was forked after JAX had started, its threads are missing, and whatever waits for them waits forever.
"""

import contextlib
import functools
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from numbers import Integral
from typing import Any, Literal

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jfrnn._tracing.internals import Primitive, find_top_trace, set_current_trace

Tree = Any  # a pytree of arrays, of any structure
Given = Any  # an argument as the user passed it, before it is checked
Aval = Any  # the type of an array in JAX's tracing: shape, dtype and the mesh axes over which it varies
Internal = Any  # an internal object of JAX, such as a primitive, a jaxpr or a lowering context

Real = int | float | np.floating | np.integer  # a number that is known while tracing
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


def as_array(name: str, given: Given, dtype: np.dtype | type[float] | None = None, empty: type | None = None) -> Given:
    """Return lists of numbers as a NumPy array, and everything else as it is; refuse arrays of other libraries.

    A list becomes an array of the dtype, `float` standing for float64 in JAX's 64-bit mode, else float32; without one, of what
    NumPy makes of it, or, as NumPy makes floats of nothing, of the type `empty` if there is nothing in it. Errors name the
    argument: a TypeError tells of a list that is not one of numbers, or of an array that can become one of JAX or NumPy, a
    ValueError of a symbol of `jax.export` in a shape.
    """
    if isinstance(given, list | tuple):
        array = _of_numbers(name, given, dtype)
        return array if array.size or empty is None else array.astype(empty)
    if not isinstance(given, Array | np.ndarray | np.generic):
        if hasattr(given, "__dlpack__"):
            kind = f"{type(given).__module__}.{type(given).__qualname__}"
            raise TypeError(
                f"{name} must be an array of JAX or NumPy, got {kind}: pass jnp.from_dlpack({name}), which copies nothing."
            )
        return given
    if symbols := [str(size) for size in given.shape if not isinstance(size, Integral)]:
        raise ValueError(
            f"{name} must have a shape of numbers, got ({', '.join(map(str, given.shape))}): kernels and scratch are made for a "
            f"number of rows, not for the symbol {symbols[0]}. Export one program for each number, or one for the most rows that "
            "come: `search`, `count` and `pair_sum` take active= for those that are there."
        )
    return given


def _of_numbers(name: str, given: list | tuple, dtype: np.dtype | type[float] | None) -> np.ndarray:
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(given)):
        raise TypeError(f"{name} must be an array, got a {type(given).__name__} of traced values: pass jnp.stack({name}).")
    try:
        array = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array, got a {type(given).__name__} of which NumPy makes none: {error}.") from None
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must be an array of numbers, got a {type(given).__name__} of which NumPy makes {array.dtype}.")
    if dtype is None or array.dtype.kind == "b":
        return array
    return array.astype((np.float64 if jax.config.read("jax_enable_x64") else np.float32) if dtype is float else dtype)


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
        guarded = jax.config.jax_transfer_guard_host_to_device in ("disallow", "log")  # pyright: ignore[reportAttributeAccessIssue]
        return jnp.asarray(copied) if guarded else jax.device_put(copied)


def as_dtype(x: Given, dtype: np.dtype) -> Array:
    """Convert an array; a concrete one on the host, so that no program is compiled for its shape."""
    if isinstance(x, Tracer):
        return gather(x).astype(dtype)
    return on_device(x) if x.dtype == dtype else make_on_host(x, lambda known: known.astype(dtype))


def make_on_host(x: Given, how: Callable[[np.ndarray], np.ndarray]) -> Array:
    """Return on the device what a NumPy function makes of a concrete array, so that no program is compiled for its shape."""
    with own_transfers() if isinstance(x, Array) else contextlib.nullcontext():
        return on_device(how(np.asarray(jax.device_get(x) if isinstance(x, Array) else x)))


def gather(x: Array) -> Array:
    """Return x replicated on every device, if its type says that it is sharded over explicit mesh axes.

    Along automatic axes the compiler does this where needed. `jfrnn.distributed` divides the work instead.
    """
    spread = jax.typeof(x).sharding
    if not any(spread.spec):  # one of a batch does not know over what that is sharded
        is_one = isinstance(x, Tracer) and AxisType.Explicit in (spread.mesh.axis_types or ())
        return _one_of_batch().bind(x) if is_one else x
    if isinstance(x, Tracer) or not isinstance(x.sharding, NamedSharding):
        return jax.sharding.reshard(x, NamedSharding(spread.mesh, PartitionSpec()))
    mesh = x.sharding.mesh
    if jax.sharding.get_abstract_mesh().empty:  # outside a mesh, its type must not name one
        mesh = Mesh(np.asarray(mesh.devices), mesh.axis_names)
    return jax.device_put(x, NamedSharding(mesh, PartitionSpec()))


@functools.cache
def _one_of_batch() -> Internal:
    """Return a primitive that does nothing, but that `jax.vmap` refuses a batch that is sharded, whose parts JAX keeps apart."""
    from jax.interpreters import ad, batching, mlir

    def batch(args: Sequence[Array], dims: Sequence[int]) -> tuple[Array, int]:
        spec = jax.typeof(args[0]).sharding.spec
        if any(spec):
            raise ValueError(
                f"jax.vmap cannot go over an axis that is sharded over explicit axes of a mesh, got {spec}: gather the batch "
                "before, x = jax.sharding.reshard(x, jax.sharding.PartitionSpec()), or make the axes of the mesh AxisType.Auto."
            )
        return one.bind(args[0]), dims[0]

    one = Primitive("jfrnn_one_of_batch")
    one.def_impl(lambda x: x)
    one.def_abstract_eval(lambda x: x)
    ad.deflinear2(one, lambda cotangent, _: [cotangent])
    batching.primitive_batchers[one] = batch
    mlir.register_lowering(one, lambda _, x: [x])
    return one


def own_transfers() -> AbstractContextManager[object]:
    """Allow the library's own transfers between host and devices, like explicit `device_put` and `device_get`.

    `jax.transfer_guard("disallow_explicit")` forbids these too. Arrays of users must be on the device before: transferring their
    NumPy arrays is left to them. Whatever enters here works with arrays, so forked processes are refused; and where an exception
    ends it, so do the traces that JAX had begun within.
    """
    refuse_forks()
    stack = contextlib.ExitStack()
    stack.push(functools.partial(_end_traces, find_top_trace(())))
    for guard in (jax.transfer_guard_host_to_device, jax.transfer_guard_device_to_host, jax.transfer_guard_device_to_device):
        if getattr(jax.config, f"jax_{guard.__name__}") in ("disallow", "log"):
            stack.enter_context(guard("allow"))
    return stack


def _end_traces(before: Internal, kind: type[BaseException] | None, *_: object) -> None:
    """Make the trace the current one that was it before, where an exception ends a call.

    JAX leaves a trace by Python code, and a handler of signals that raises at its beginning leaves the trace a current one, so that
    every later operation of the thread would return a tracer.
    """
    if kind is not None and find_top_trace(()) is not before:
        set_current_trace(before).__enter__()


_is_forked = False


def _look() -> None:
    """Note in a forked process whether JAX had started before."""
    global _is_forked
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import xla_bridge

        _is_forked = _is_forked or bool(xla_bridge._backends)


def refuse_forks() -> None:
    """Raise where JAX cannot run because this process was forked after it had started.

    Raises:
        RuntimeError: it was.
    """
    if _is_forked:
        raise RuntimeError(
            "this process was forked after JAX had started, whose threads do not run here, so that it would wait forever: start "
            "processes with multiprocessing.get_context('spawn'), or use JAX only after forking. jfrnn.ase needs no JAX, and runs."
        )


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look)
