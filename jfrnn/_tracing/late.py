"""What is done differently on each platform, and functions that are traced when a program is lowered, for the platform it is for.

`lax.platform_dependent` traces one branch per platform, of which a compiled program contains one. Where one takes long to trace,
the function is a parameter of a primitive here, whose lowering knows the platform and traces the function once.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray

from jfrnn._tracing.kinds import Aval, Internal, Tree

_platform: contextvars.ContextVar[str | None] = contextvars.ContextVar("platform", default=None)


def platform_of_lowering() -> str | None:
    """Return the one platform for which the function that is being traced will be lowered, or None if that is not known."""
    return _platform.get()


def on_platform(
    *args: Tree, late: bool = False, default: Callable[..., Tree] | None = None, **branches: Callable[..., Tree]
) -> Tree:
    """Call the function that `branches` has for the platform for which a program is compiled, else `default`.

    Args:
        args: What the function is given, pytrees of arrays.
        late: Trace that function alone, while lowering; its results have the shapes of those of `cpu`, and no derivative.
        default: For platforms that are not named.
        branches: By names of platforms in JAX: cpu, cuda.
    """
    platform = platform_of_lowering()
    branch = None if platform is None else branches.get(platform, default)
    if branch is not None:
        return branch(*args)
    if late:
        return call_late(functools.partial(on_platform, default=default, **branches), args, jax.eval_shape(branches["cpu"], *args))
    return lax.platform_dependent(*args, default=default, **branches)


def call_late(fn: Callable[..., Tree], args: tuple, like: Tree) -> Tree:
    """Return fn(*args), a pytree of arrays with the shapes and dtypes of `like`, tracing the function while lowering.

    The function may use no traced arrays but its arguments, pytrees of arrays; it has no derivative.
    """
    leaves, structure = jax.tree.flatten(args)
    shapes, out = jax.tree.flatten(like)

    def flat(*leaves: Array) -> list[Array]:
        return jax.tree.leaves(fn(*jax.tree.unflatten(structure, leaves)))

    return jax.tree.unflatten(out, _late().bind(*leaves, fn=flat, types=tuple((x.shape, np.dtype(x.dtype)) for x in shapes)))


def lower_late(fn: Callable[..., Sequence[Array]]) -> Internal:
    """Return a rule that lowers a primitive with several results by tracing a function, which may ask for the platform."""
    from jax.interpreters import mlir

    def lower(ctx: Internal, *args: Internal, **params: Internal) -> Internal:
        platforms = ctx.platforms or ctx.module_context.platforms
        with _lowering_for(platforms[0] if len(platforms) == 1 else None):
            return mlir.lower_fun(fn, multiple_results=True)(ctx, *args, **params)

    return lower


@contextlib.contextmanager
def _lowering_for(platform: str | None) -> Iterator[None]:
    token = _platform.set(platform)
    try:
        yield
    finally:
        _platform.reset(token)


def _call(*args: Array, fn: Callable[..., list[Array]], types: tuple) -> list[Array]:
    del types
    return fn(*args)


@functools.cache
def _late() -> Internal:
    from jax.extend.core import Primitive
    from jax.interpreters import batching, mlir

    late = Primitive("jfrnn_late")
    late.multiple_results = True

    def infer(*_: Aval, fn: Callable, types: tuple) -> list[ShapedArray]:
        del fn
        return [ShapedArray(*kind) for kind in types]

    def batch(args: Sequence[Array], dims: Sequence[int | None], *, fn: Callable, types: tuple) -> tuple[list[Array], list[int]]:
        size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
        batched = tuple(((size, *shape), dtype) for shape, dtype in types)
        return late.bind(*args, fn=jax.vmap(fn, tuple(dims)), types=batched), [0] * len(types)

    late.def_impl(_call)  # outside a program, as under `jax.disable_jit`
    late.def_abstract_eval(infer)
    batching.primitive_batchers[late] = batch
    mlir.register_lowering(late, lower_late(_call))
    return late
