"""Functions whose derivative is a rule of their own, also where JAX takes derivatives of loops.

`jax.custom_jvp` is not enough where the function itself has no derivative, since kernels compute it: of the body of a loop, JAX
keeps the function and drops the rule as soon as it has applied it once. So the derivative of a derivative through a loop would be
that of the function, 0. The rule of a primitive stays.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jfrnn._tracing.arguments import Internal, Tree
from jfrnn._tracing.internals import Primitive
from jfrnn._tracing.late import lower_late, result_aval, vary, varying_axes
from jfrnn._tracing.programs import compile_program

Rule = Callable[..., tuple[Sequence[Array], Sequence[Any]]]


def still(like: Array) -> SymbolicZero:
    """Return the tangent of an array that does not move."""
    return SymbolicZero(jax.typeof(like).to_tangent_aval())


def ruled(
    name: str, work: Callable[..., Sequence[Array]], like: Callable[..., Sequence[Any]], rule: Rule
) -> Callable[..., list[Array]]:
    """Return `work` as a function with a derivative; it takes pytrees of arrays, and what is static by name.

    Args:
        name: That of the primitive, which programs show.
        work: Returns the results, a sequence of arrays.
        like: Returns shape and dtype of each result, given the same arguments, or their types.
        rule: Returns results and their tangents, given pytrees of arguments and of tangents; those that do not move are `still`.
    """
    from jax.interpreters import ad, batching, mlir

    primitive = Primitive(name)
    primitive.multiple_results = True

    def call(*args: Tree, **static: Any) -> list[Array]:  # noqa: ANN401
        leaves, structure = jax.tree.flatten(args)
        leaves = vary([jnp.asarray(x) for x in leaves], varying_axes(leaves))
        return primitive.bind(*leaves, structure=structure, static=tuple(static.items()))

    def run(*leaves: Array, structure: Any, static: tuple) -> list[Array]:  # noqa: ANN401
        return list(work(*jax.tree.unflatten(structure, leaves), **dict(static)))

    def types(*leaves: Internal, structure: Any, static: tuple) -> list:  # noqa: ANN401
        found = like(*jax.tree.unflatten(structure, leaves), **dict(static))
        return [result_aval(x.shape, x.dtype, leaves) for x in found]

    def jvp(primals: Sequence, tangents: Sequence, *, structure: Any, static: tuple) -> tuple[list, list]:  # noqa: ANN401
        moved = [still(x) if isinstance(move, ad.Zero) else move for x, move in zip(primals, tangents, strict=True)]
        results, moves = rule(jax.tree.unflatten(structure, primals), jax.tree.unflatten(structure, moved), **dict(static))
        return list(results), [ad.Zero(move.aval) if isinstance(move, SymbolicZero) else move for move in moves]

    def batch(args: Sequence[Array], dims: Sequence[int | None], **params: Internal) -> tuple[list[Array], list[int]]:
        """Go through a batch one by one, as what calls kernels does anyway; so the rule stays that of the function."""
        moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]

        def one(some: list[Array]) -> list[Array]:
            left = iter(some)
            return primitive.bind(*(x if d is None else next(left) for x, d in zip(moved, dims, strict=True)), **params)

        results = lax.map(one, [x for x, d in zip(moved, dims, strict=True) if d is not None])
        return results, [0] * len(results)

    compiled = functools.partial(compile_program, static_argnames=("structure", "static"))(run)
    primitive.def_impl(lambda *leaves, **params: (run if jax.config.jax_disable_jit else compiled)(*leaves, **params))  # pyright: ignore[reportAttributeAccessIssue]
    primitive.def_abstract_eval(types)
    ad.primitive_jvps[primitive] = jvp
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, lower_late(run))
    return call
