"""Programs of the library inside `jax.shard_map`, which checks by default over which axes of the mesh each array varies.

Loops and branches begin with constants, which vary over no axis, and end with what was computed, which does. Instead of saying so
at each of them, a program is traced as it is on one device, where nothing varies; its results then vary over all axes that any of
its operands does.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray, Tracer


def varying_axes(tree: Any) -> tuple[str, ...]:  # noqa: ANN401
    """Return the axes of the mesh over which any array of a pytree varies."""
    found: set[str] = set()
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, Tracer):
            found |= _axes_of(jax.typeof(leaf))
    return tuple(sorted(found))


def _axes_of(aval: Any) -> frozenset[str]:  # noqa: ANN401
    kind = getattr(aval, "manual_axis_type", None)  # as JAX says it from 0.10 on
    return frozenset(getattr(aval, "vma", ()) if kind is None else kind.varying)


def varied(tree: Any, axes: tuple[str, ...]) -> Any:  # noqa: ANN401
    """Return the same arrays as ones that vary over these axes, and over whatever they do."""

    def vary(x: Any) -> Any:  # noqa: ANN401
        more = tuple(name for name in axes if name not in _axes_of(jax.typeof(x)))
        return lax.pcast(x, more, to="varying") if more else x

    return jax.tree.map(vary, tree) if axes else tree


def result_aval(shape: tuple[int, ...], dtype: Any, operands: Any) -> ShapedArray:  # noqa: ANN401
    """Return the type of a result that varies as the first of the operands does, which all vary alike."""
    for aval in operands:
        if hasattr(aval, "update") and _axes_of(aval):
            sharding = aval.sharding.update(spec=jax.sharding.PartitionSpec(*[None] * len(shape)))
            return aval.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)
    return ShapedArray(shape, dtype)


def unvaried(avals: Any) -> list[ShapedArray]:  # noqa: ANN401
    """Return types of arrays that vary over nothing."""
    return [ShapedArray(aval.shape, aval.dtype) if _axes_of(aval) else aval for aval in avals]


def call_apart(fn: Callable[..., Any], *args: Any) -> Any:  # noqa: ANN401
    """Call a function of pytrees that has no derivative; where an argument varies over axes of a mesh, as a program of its own."""
    axes = varying_axes(args)
    if not axes:
        return fn(*args)
    leaves, structure = jax.tree.flatten(args)
    is_static = [isinstance(x, int) for x in leaves]
    arrays = [lax.stop_gradient(jnp.asarray(x)) for x, static in zip(leaves, is_static, strict=True) if not static]

    def flat(*arrays: Any) -> Any:  # noqa: ANN401
        given = iter(arrays)
        whole = [x if static else next(given) for x, static in zip(leaves, is_static, strict=True)]
        return fn(*jax.tree.unflatten(structure, whole))

    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]
    jaxpr, out = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    results = varied(_program().bind(*arrays, jaxpr=jaxpr), axes)
    return jax.tree.unflatten(jax.tree.structure(out), results)


@functools.cache
def _program() -> Any:  # noqa: ANN401
    """Return the primitive of a program that varies over nothing; `varied` then says over what its results do."""
    from jax.extend.core import Primitive, jaxpr_as_fun
    from jax.interpreters import batching, mlir

    program = Primitive("jfrnn_program")
    program.multiple_results = True
    program.def_impl(lambda *args, jaxpr: jax.jit(jaxpr_as_fun(jaxpr))(*args))
    program.def_abstract_eval(lambda *_, jaxpr: [ShapedArray(x.shape, x.dtype) for x in jaxpr.out_avals])

    def lower(ctx: Any, *args: Any, jaxpr: Any) -> Any:  # noqa: ANN401
        return mlir.lower_fun(jaxpr_as_fun(jaxpr))(ctx.replace(avals_in=jaxpr.in_avals), *args)

    def batch(args: Any, dims: Any, *, jaxpr: Any) -> Any:  # noqa: ANN401
        mapped = jax.vmap(jaxpr_as_fun(jaxpr), dims)
        results = program.bind(*args, jaxpr=jax.make_jaxpr(mapped)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)))
        return results, [0] * len(results)

    mlir.register_lowering(program, lower)
    batching.primitive_batchers[program] = batch
    return program
