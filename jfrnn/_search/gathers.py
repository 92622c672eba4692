"""What belongs to sources, read for the pairs of a list, and what belongs to pairs, summed for their sources: both by gathers.

The two are the transposes of each other, and are primitives of JAX with these derivatives, of every order. So no derivative of the
geometry of a list scatters, and the same input gives the same bits on every device.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.interpreters import ad, batching, mlir

from jfrnn import _tracing as tracing
from jfrnn._engine import collect_slots
from jfrnn._search.present import MOST_SLOTS, Topology

Structure = Any  # a `PyTreeDef`, which type checkers do not accept as a type
_WIDEST = 16  # numbers of a slot that kernels add
_GROUP = 16  # slots of each source that are added at a time in lists that are not their own mirror image


def gather(x: Array, topology: Topology) -> Array:
    """Return x [n, ...] of the source of each slot, [m, capacity, ...], 0 in unused slots; differentiable to every order."""
    if topology.idx.size > MOST_SLOTS:
        return _gather(x, topology)
    return bind(_gather_p, x, topology)


def collect(y: Array, topology: Topology) -> Array:
    """Return the sums of y [m, capacity, ...] over the slots of each source, [n, ...]; differentiable to every order."""
    return bind(_collect_p, y, topology)


def bind(primitive: tracing.Primitive, x: Array, given: tracing.Tree) -> Array:
    """Apply a primitive of `define` to x and a pytree of arrays."""
    leaves, structure = jax.tree.flatten(given)
    axes = tracing.varying_axes((x, leaves))
    x, leaves = tracing.vary((x, leaves), axes)
    return primitive.bind(x, *leaves, structure=structure)


def _gather(x: Array, topology: Topology) -> Array:
    return x.at[topology.idx].get(mode="fill", fill_value=0)


def _collect(y: Array, topology: Topology) -> Array:
    """Return the sums of y [m, capacity, ...] over the slots of each source, [n, ...]."""
    reverse, flat = topology.with_reverse(), y.reshape(topology.idx.size, *y.shape[2:])
    if 0 in (topology.sources, *y.shape):
        return jnp.zeros((topology.sources, *y.shape[2:]), y.dtype)
    if topology.native and flat.dtype in (np.float32, np.float64) and 0 < flat[0].size <= _WIDEST:
        given = flat.reshape(len(flat), -1), reverse.slots, reverse.starts, reverse.lengths
        on_cpu, on_cuda = (functools.partial(collect_slots, sources=topology.sources, cuda=cuda) for cuda in (False, True))
        sums = tracing.on_platform(*given, cpu=on_cpu, cuda=on_cuda)
        return sums.reshape(topology.sources, *y.shape[2:])
    if reverse.starts is None or reverse.lengths is None:
        return jnp.sum(flat.at[reverse.slots].get(mode="fill", fill_value=0), axis=1)
    starts, lengths, slots = reverse.starts, reverse.lengths, reverse.slots

    def add_group(g: Array, sums: Array) -> Array:
        place = g * _GROUP + lax.iota(jnp.int32, _GROUP)
        slot = slots.at[starts[:, None] + place].get(mode="clip")
        slot = jnp.where(place < lengths[:, None], slot, flat.shape[0])
        return sums + jnp.sum(flat.at[slot].get(mode="fill", fill_value=0), axis=1)

    groups = (jnp.max(lengths) + _GROUP - 1) // _GROUP
    return lax.fori_loop(0, groups, add_group, jnp.zeros((topology.sources, *y.shape[2:]), y.dtype))


_gather_p, _collect_p = tracing.Primitive("jfrnn_gather"), tracing.Primitive("jfrnn_collect")


def define(
    primitive: tracing.Primitive,
    work: Callable[[Array, Any], Array],
    transposed: tracing.Primitive,
    shape_of: Callable[[tuple[int, ...], Any], tuple[int, ...]],
    plain: Callable[[Array, Any], Array] | None = None,
) -> None:
    """Define a primitive that is linear in its first operand; the others are the leaves of a pytree.

    That is a topology, or, with `plain`, any. `plain` is an array program of the same meaning: derivatives by the leaves are those
    of it, and it is what a batch maps.

    The function is long because all rules of a primitive stand in it.
    """

    def run(x: Array, *leaves: Array, structure: Structure) -> Array:
        return work(x, jax.tree.unflatten(structure, leaves))

    def run_plain(x: Array, *leaves: Array, structure: Structure) -> Array:
        return (plain or work)(x, jax.tree.unflatten(structure, leaves))

    def shape(x: tracing.Aval, *leaves: tracing.Aval, structure: Structure) -> ShapedArray:
        return tracing.result_aval(shape_of(x.shape, jax.tree.unflatten(structure, leaves)), x.dtype, (x, *leaves))

    def jvp(primals: tuple, tangents: tuple, *, structure: Structure) -> tuple[Array, Any]:
        result = primitive.bind(*primals, structure=structure)
        moving = [k for k, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]
        parts = [primitive.bind(tangents[0], *primals[1:], structure=structure)] if 0 in moving else []
        moving = [k for k in moving if k > 0]
        if moving:

            def at(*moved: Array) -> Array:
                now = [*primals]
                for k, x in zip(moving, moved, strict=True):
                    now[k] = x
                return run_plain(*now, structure=structure)

            parts.append(jax.jvp(at, [primals[k] for k in moving], [tangents[k] for k in moving])[1])
        if not parts:
            return result, ad.Zero(jax.typeof(result).to_tangent_aval())
        return result, functools.reduce(jnp.add, parts)

    def transpose(cotangent: tracing.Internal, x: tracing.Internal, *leaves: Array, structure: Structure) -> list:
        none = [None] * len(leaves)
        if isinstance(cotangent, ad.Zero):
            return [ad.Zero(x.aval), *none]
        return [transposed.bind(cotangent, *leaves, structure=structure), *none]

    def batch(args: tuple, dims: tuple, *, structure: Structure) -> tuple[Array, int]:
        if plain is not None:
            return jax.vmap(functools.partial(run_plain, structure=structure), dims)(*args), 0
        if all(d is None for d in dims[1:]):  # one list for the whole batch, which becomes the last axis of the values
            result = primitive.bind(jnp.moveaxis(args[0], dims[0], -1), *args[1:], structure=structure)
            return result, result.ndim - 1
        size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
        x, *leaves = (
            jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)
        )
        topology = jax.tree.unflatten(structure, leaves)
        if topology.idx.size > MOST_SLOTS:
            return lax.map(lambda each: primitive.bind(*each, structure=structure), (x, *leaves)), 0
        merged = topology.merge()
        result = bind(primitive, x.reshape(-1, *x.shape[2:]), merged)
        return result.reshape(size, -1, *result.shape[1:]), 0

    def lower(ctx: tracing.Internal, *args: tracing.Internal, **params: tracing.Internal) -> tracing.Internal:
        return mlir.lower_fun(run, multiple_results=False)(
            ctx.replace(avals_in=tracing.unvarying_types(ctx.avals_in)), *args, **params
        )

    compiled = functools.partial(tracing.compile_program, static_argnames="structure")(run)
    primitive.def_impl(lambda *args, structure: compiled(*args, structure=structure))
    primitive.def_abstract_eval(shape)
    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transpose
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, lower)


define(_gather_p, _gather, _collect_p, lambda shape, topology: (*topology.idx.shape, *shape[1:]))
define(_collect_p, _collect, _gather_p, lambda shape, topology: (topology.sources, *shape[2:]))
