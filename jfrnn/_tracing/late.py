"""Functions that are traced apart from what calls them: for the platform a program is lowered for, or as on a single device.

`lax.platform_dependent` traces one branch per platform, of which a compiled program contains one. Where one takes long to trace,
the function is a parameter of a primitive here, whose lowering knows the platform and traces the function once.

`jax.shard_map` checks by default over which mesh axes each array varies. Loops and branches start with constants, which vary over
no axis, and end with results, which vary. Instead of annotating each of them, a program is traced as on a single device, where
nothing varies; its results then vary over all axes over which any operand does.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray, Tracer

from jfrnn._tracing.arguments import Aval, Internal, Tree
from jfrnn._tracing.internals import Primitive, jaxpr_as_fun

# the one platform for which the function that is being traced will be lowered, None if that is not known
_platform: contextvars.ContextVar[str | None] = contextvars.ContextVar("platform", default=None)


def on_platform(
    *args: Tree, late: bool = False, default: Callable[..., Tree] | None = None, **branches: Callable[..., Tree]
) -> Tree:
    """Call the function that `branches` has for the platform for which a program is compiled (cpu, cuda), else `default`.

    With `late`, that function alone is traced, while lowering; its results have the shapes of those of `cpu`, and no derivative.
    """
    platform = _platform.get()
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
    """Return a rule that lowers a primitive with several results by tracing a function, which may ask for the platform.

    It is traced as on a single device.
    """
    from jax.interpreters import mlir

    def lower(ctx: Internal, *args: Internal, **params: Internal) -> Internal:
        platforms = ctx.platforms or ctx.module_context.platforms
        token = _platform.set(platforms[0] if len(platforms) == 1 else None)
        try:
            return mlir.lower_fun(fn, multiple_results=True)(ctx.replace(avals_in=unvarying_types(ctx.avals_in)), *args, **params)
        finally:
            _platform.reset(token)

    return lower


@functools.cache
def _late() -> Internal:
    from jax.interpreters import batching, mlir

    late = Primitive("jfrnn_late")
    late.multiple_results = True

    def call(*args: Array, fn: Callable[..., list[Array]], types: tuple) -> list[Array]:
        del types
        return fn(*args)

    def batch(args: Sequence[Array], dims: Sequence[int | None], *, fn: Callable, types: tuple) -> tuple[list[Array], list[int]]:
        size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
        batched = tuple(((size, *shape), dtype) for shape, dtype in types)
        return late.bind(*args, fn=jax.vmap(fn, tuple(dims)), types=batched), [0] * len(types)

    late.def_impl(call)  # outside a program, as under `jax.disable_jit`
    late.def_abstract_eval(lambda *_, fn, types: [ShapedArray(*kind) for kind in types])
    batching.primitive_batchers[late] = batch
    mlir.register_lowering(late, lower_late(call))
    return late


@contextlib.contextmanager
def without_mesh() -> Iterator[None]:
    """Trace as where no mesh of devices is set; of older releases of JAX, only where none is.

    Over which axes closed-over arrays vary is not asked then: no array could be made to vary like them.
    """
    use = getattr(jax.sharding, "use_abstract_mesh", None)
    with contextlib.ExitStack() as contexts:
        if use is not None and not jax.sharding.get_abstract_mesh().empty:
            contexts.enter_context(use(jax.sharding.AbstractMesh((), ())))
            with contextlib.suppress(ImportError, AttributeError):
                from jax._src import config

                contexts.enter_context(config._check_vma(False))
        yield


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
        if more and hasattr(lax, "pcast"):
            return lax.pcast(x, more, to="varying")
        return lax.pvary(x, more) if more else x  # pyright: ignore[reportAttributeAccessIssue] (of JAX 0.8.0 and earlier)

    return jax.tree.map(vary_leaf, tree) if axes else tree


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

    program, like = jax.make_jaxpr(flat, return_shape=True)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays))
    return vary(call_late(jaxpr_as_fun(program), tuple(arrays), like), axes)
