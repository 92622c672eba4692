"""Programs of the library inside `jax.shard_map`, which checks by default over which mesh axes each array varies.

Loops and branches start with constants, which vary over no axis, and end with results, which vary. Instead of annotating each of
them, a program is traced as on a single device, where nothing varies; its results then vary over all axes over which any operand
does.
"""

import functools
from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray, Tracer

from jfrnn._tracing.kinds import Aval, Internal, Tree


def varying_axes(tree: Tree) -> tuple[str, ...]:
    """Return the mesh axes over which any array of a pytree varies."""
    found: set[str] = set()
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, Tracer):
            found |= _axes_of(jax.typeof(leaf))
    return tuple(sorted(found))


def _axes_of(aval: Aval) -> frozenset[str]:
    kind = getattr(aval, "manual_axis_type", None)  # the name in JAX 0.10 and later
    return frozenset(getattr(aval, "vma", ()) if kind is None else kind.varying)


def vary(tree: Tree, axes: tuple[str, ...]) -> Tree:
    """Return the same arrays, marked as varying over these axes and those over which they do already."""

    def vary_leaf(x: Array) -> Array:
        more = tuple(name for name in axes if name not in _axes_of(jax.typeof(x)))
        return _mark(x, more) if more else x

    return jax.tree.map(vary_leaf, tree) if axes else tree


def _mark(x: Array, axes: tuple[str, ...]) -> Array:
    """Mark an array as varying over more axes, by the name that this has in JAX 0.8.0 and earlier, or in later releases."""
    if hasattr(lax, "pcast"):
        return lax.pcast(x, axes, to="varying")
    return lax.pvary(x, axes)  # pyright: ignore[reportAttributeAccessIssue]


def result_aval(shape: tuple[int, ...], dtype: np.dtype, operands: Iterable[Aval]) -> ShapedArray:
    """Return the type of a result that varies like the operands, which all vary alike."""
    for aval in operands:
        if hasattr(aval, "update") and _axes_of(aval):
            sharding = aval.sharding.update(spec=jax.sharding.PartitionSpec(*[None] * len(shape)))
            return aval.update(shape=shape, dtype=dtype, weak_type=False, sharding=sharding)
    return ShapedArray(shape, dtype)


def unvarying_types(avals: Iterable[Aval]) -> list[ShapedArray]:
    """Return the types of these arrays as varying over nothing."""
    return [ShapedArray(aval.shape, aval.dtype) if _axes_of(aval) else aval for aval in avals]


def call_apart(fn: Callable[..., Tree], *args: Tree) -> Tree:
    """Call a function of pytrees without derivatives; if arguments vary over mesh axes, as a separate program."""
    axes = varying_axes(args)
    if not axes:
        return fn(*args)
    leaves, structure = jax.tree.flatten(args)
    is_static = [isinstance(x, int) for x in leaves]
    arrays = [lax.stop_gradient(jnp.asarray(x)) for x, static in zip(leaves, is_static, strict=True) if not static]

    def flat(*arrays: Array) -> Tree:
        given = iter(arrays)
        whole = [x if static else next(given) for x, static in zip(leaves, is_static, strict=True)]
        return fn(*jax.tree.unflatten(structure, whole))

    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]
    jaxpr, out = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    results = vary(_program().bind(*arrays, jaxpr=jaxpr), axes)
    return jax.tree.unflatten(jax.tree.structure(out), results)


@functools.cache
def _program() -> Internal:
    """Return the primitive of a program that varies over nothing; `vary_leaf` marks its results afterwards."""
    from jax.extend.core import Primitive, jaxpr_as_fun
    from jax.interpreters import batching, mlir

    program = Primitive("jfrnn_program")
    program.multiple_results = True
    program.def_impl(lambda *args, jaxpr: jax.jit(jaxpr_as_fun(jaxpr))(*args))
    program.def_abstract_eval(lambda *_, jaxpr: [ShapedArray(x.shape, x.dtype) for x in jaxpr.out_avals])

    def lower(ctx: Internal, *args: Internal, jaxpr: Internal) -> Internal:
        return mlir.lower_fun(jaxpr_as_fun(jaxpr))(ctx.replace(avals_in=jaxpr.in_avals), *args)

    def batch(args: Sequence[Array], dims: Sequence[int | None], *, jaxpr: Internal) -> tuple[list[Array], list[int]]:
        mapped = jax.vmap(jaxpr_as_fun(jaxpr), dims)
        results = program.bind(*args, jaxpr=jax.make_jaxpr(mapped)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args)))
        return results, [0] * len(results)

    mlir.register_lowering(program, lower)
    batching.primitive_batchers[program] = batch
    return program
