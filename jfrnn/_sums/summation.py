"""The JAX primitive of pair sums, whose derivatives of every order are sums over the same pairs.

Its operands are the leaves of a relation, which have no derivative, followed by those of a term. The tangent of a sum is the sum of
the tangent of its term. A sum that is linear in some operands is transposed by transposing its term: cotangents of operands of i,
and of shared ones, are summed over the same pairs, those of operands of j over the reversed relation. So no sum scatters to
neighbors, and no pair is stored.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from jfrnn import _tracing as tracing
from jfrnn._sums.exchange import signs_of
from jfrnn._sums.joint import lower_sum
from jfrnn._sums.relations import Relation, sum_pairs, summable
from jfrnn._sums.terms import Groups, Term, choose, is_moving, join, tangent, transpose

Structure = Any  # the `PyTreeDef` of a relation, which type checkers do not accept as a type

_pair_sum_p = tracing.Primitive("pair_sum")
_pair_sum_p.multiple_results = True


def bind_sum(relation: Relation, term: Term, operands: Groups, compensated: bool) -> list[Array]:
    """Sum a term over the pairs of a relation, differentiable in the operands to every order; see `sum_pairs`."""
    leaves, structure = jax.tree.flatten(relation)
    leaves = [x if isinstance(x, Array) else tracing.on_device(x) for x in leaves]  # numbers take no program to get there
    return _bind(leaves, operands, term, structure, compensated)


def _bind(leaves: list[Array], operands: Groups, term: Term, structure: Structure, compensated: bool) -> list[Array]:
    flat = [x if isinstance(x, Array) else jnp.asarray(x) for group in operands for x in group]  # tangents may be Python numbers
    leaves, structure = jax.tree.flatten(summable(jax.tree.unflatten(structure, leaves), term))
    axes = tracing.varying_axes((leaves, flat))
    leaves, flat = tracing.vary((leaves, flat), axes)
    return _pair_sum_p.bind(*leaves, *flat, term=term, structure=structure, compensated=compensated)


def _sums(*args: Array, term: Term, structure: Structure, compensated: bool) -> list[Array]:
    cut = structure.num_leaves
    return sum_pairs(jax.tree.unflatten(structure, args[:cut]), term, term.split(args[cut:]), compensated)


def _result_shapes(*args: tracing.Aval, term: Term, structure: Structure, compensated: bool) -> list[ShapedArray]:
    del compensated
    rows = jax.tree.unflatten(structure, args[: structure.num_leaves]).sizes[0]
    return [
        tracing.result_aval(x.shape if total else (rows, *x.shape), x.dtype, args)
        for x, total in zip(term.summands, term.totals, strict=True)
    ]


def _jvp(primals: tuple, tangents: tuple, *, term: Term, structure: Structure, compensated: bool) -> tuple[list, list]:
    sums = _pair_sum_p.bind(*primals, term=term, structure=structure, compensated=compensated)
    cut = structure.num_leaves
    leaves, operands, moves = list(primals[:cut]), term.split(primals[cut:]), term.split(tangents[cut:])
    moving = Groups(*(tuple(not isinstance(x, ad.Zero) and is_moving(jax.typeof(x)) for x in group) for group in moves))
    none = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in sums]
    if not any(map(any, moving)):
        return sums, none
    derived = tangent(term, moving)
    needed = choose(join(operands, choose(moves, moving)), derived.needed)
    moved = iter(_bind(leaves, needed, derived.term, structure, compensated))
    return sums, [next(moved) if is_moving(x) else zero for x, zero in zip(term.summands, none, strict=True)]


def _transpose(cotangents: list, *args: tracing.Internal, term: Term, structure: Structure, compensated: bool) -> list:
    cut = structure.num_leaves
    leaves, operands = list(args[:cut]), term.split(args[cut:])
    relation = jax.tree.unflatten(structure, leaves)
    linear = Groups(*(tuple(map(ad.is_undefined_primal, group)) for group in operands))
    there = tuple(not isinstance(x, ad.Zero) for x in cotangents)
    if not any(there):
        return [None] * len(args)
    still = choose(operands, Groups(*(tuple(not flag for flag in group) for group in linear)))
    of_kind = {
        kind: tuple(x for x, flag, total in zip(cotangents, there, term.totals, strict=True) if flag and total == kind)
        for kind in (True, False)
    }
    given = join(still, Groups(of_kind[True], of_kind[False], ()))
    signs = signs_of(term) if relation.symmetric else (None,) * len(there)
    rules = transpose(term, linear, there, relation.symmetric, signs)
    results: list[Array] = []
    if rules.along is not None:
        if rules.sides:
            side = tuple((given.own + given.others)[k] for k in rules.sides)
            given = Groups(given.shared, side, side)
        results += _bind(leaves, choose(given, rules.along.needed), rules.along.term, structure, compensated)
    if rules.across is not None:
        exchanged, other_structure = jax.tree.flatten(relation.reverse())
        turned = choose(Groups(given.shared, given.others, given.own), rules.across.needed)
        results += _bind(exchanged, turned, rules.across.term, other_structure, compensated)
    found, joint = iter(results), iter(rules.joint)
    flags = [flag for group in linear[:2] for flag in group] + [flag and not next(joint, False) for flag in linear.others]
    return [None] * cut + [next(found) if flag else None for flag in flags]


def _batch(args: tuple, dims: tuple, **params: tracing.Internal) -> tuple[list[Array], list[int]]:
    """Run the sums of a batch one after the other, since their loops have different lengths."""
    mapped = [d is not None for d in dims]
    batched = [jnp.moveaxis(x, d, 0) for x, d, is_mapped in zip(args, dims, mapped, strict=True) if is_mapped]

    def one(some: list[Array]) -> list[Array]:
        left = iter(some)
        return _pair_sum_p.bind(*(next(left) if is_mapped else x for x, is_mapped in zip(args, mapped, strict=True)), **params)

    sums = lax.map(one, batched)
    return sums, [0] * len(sums)


def _lower(ctx: tracing.Internal, *args: tracing.Internal, **params: tracing.Internal) -> tracing.Internal:
    """Trace the sums as on a single device; see `jfrnn._tracing.late`."""
    return lower_sum(tracing.lower_late(_sums), ctx.replace(avals_in=tracing.unvarying_types(ctx.avals_in)), *args, **params)


_compiled = functools.partial(tracing.compile_program, static_argnames=("term", "structure", "compensated"))(_pair_sum_p.bind)
_pair_sum_p.def_impl(lambda *args, **params: (_sums if jax.config.jax_disable_jit else _compiled)(*args, **params))  # pyright: ignore[reportAttributeAccessIssue]
_pair_sum_p.def_abstract_eval(_result_shapes)
ad.primitive_jvps[_pair_sum_p] = _jvp
ad.primitive_transposes[_pair_sum_p] = _transpose
batching.primitive_batchers[_pair_sum_p] = _batch
mlir.register_lowering(_pair_sum_p, _lower, cacheable=False)  # a sum looks at those before it
