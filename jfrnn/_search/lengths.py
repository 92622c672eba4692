"""Distances of a list that is its own mirror image, by Warp's kernels, with derivatives by kernels.

A pair gives the opposite to j of what it gives to i. So on CUDA, derivatives by positions need two numbers of each slot: its slope
and that of its reverse slot. On the CPU, where several blocks of rows have sums of their own, each pair gives to both ends at once.
Neither displacements nor what belongs to them is stored.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jfrnn._engine import KeptList, kept_distances, kept_slopes
from jfrnn._geometry import Box, bring_near, translation
from jfrnn._search.gathers import bind, collect, define, gather
from jfrnn._search.geometry import kept_list, kept_shifts, norms, vectors_of
from jfrnn._search.present import Present, Topology
from jfrnn._tracing import Primitive, call_apart, compile_program, on_platform, ruled, still

_Lines = tuple[KeptList, Topology, Array]  # a list at present positions, and its distances, 0 where there is no pair


@compile_program
def lengths(present: Present) -> tuple[Array, Array]:
    """Return distances [n, capacity] and the mask, as `norms` of the vectors gives them."""
    distances, mask = _lengths(present.sources, present.box, lax.stop_gradient(present))
    return distances, mask


def _at(sources: Array, box: Box | None, fixed: Present) -> Present:
    return dataclasses.replace(fixed, sources=sources, box=box)


def _find(sources: Array, box: Box | None, fixed: Present) -> tuple[Array, Array]:
    return call_apart(kept_distances, kept_list(_at(sources, box, fixed)))


def _like(sources: Array, _: Box | None, fixed: Present) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(fixed.topology.idx.shape, dtype) for dtype in (sources.dtype, np.dtype(bool))]


def _move(primals: tuple, tangents: tuple) -> tuple[list[Array], list[Any]]:
    (sources, box, present), (moved, stretched, _) = primals, tangents
    distances, mask = _lengths(*primals)
    none = still(mask)
    if not all(isinstance(x, SymbolicZero) for x in jax.tree.leaves(stretched)):
        both = (moved, stretched), (sources, box)
        moved, stretched = jax.tree.map(lambda x, at: jnp.zeros_like(at) if isinstance(x, SymbolicZero) else x, *both)
        by_vectors = lambda sources, box: norms(vectors_of(_at(sources, box, present))[0])  # noqa: E731
        return [distances, mask], [jax.jvp(by_vectors, (sources, box), (moved, stretched))[1], none]
    if isinstance(moved, SymbolicZero):
        return [distances, mask], [still(distances), none]
    fixed = kept_list(_at(sources, box, present))
    near = sources if fixed.lattice is None else bring_near(sources, fixed.lattice).points
    lines = fixed._replace(sources=near), present.topology, distances
    return [distances, mask], [bind(_along_p, moved, lines), none]


_lengths = ruled("jfrnn_lengths", _find, _like, _move)


def _directions(lines: _Lines) -> Array:
    """Return unit vectors from i to j, [n, capacity, d], 0 where there is no distance."""
    kept, topology, distances = lines
    vectors = gather(kept.sources, topology) - kept.sources[:, None, :]
    if kept.lattice is not None:
        vectors = vectors + translation(lax.stop_gradient(kept_shifts(kept)), kept.lattice)
    apart = distances > 0
    return jnp.where(apart[..., None], vectors / jnp.where(apart, distances, 1)[..., None], 0)


def _along(moved: Array, lines: _Lines) -> Array:
    """Return how fast distances grow while sources move, [n, capacity]."""
    away = gather(moved, lines[1]) - moved[:, None, :]
    return jnp.sum(_directions(lines) * away, axis=-1)


def _pull(slopes: Array, lines: _Lines) -> Array:
    """Return the transpose of `_along`, [n, d]."""
    parts = slopes[..., None] * _directions(lines)
    return collect(parts, lines[1]) - jnp.sum(parts, axis=1)


def _pull_by_kernel(slopes: Array, lines: _Lines) -> Array:
    def on(cuda: bool, slopes: Array, lines: _Lines) -> Array:
        kept, topology, distances = lines
        return kept_slopes(kept, topology.with_reverse().slots if cuda else None, distances, slopes)

    return on_platform(slopes, lines, cpu=functools.partial(on, False), cuda=functools.partial(on, True))


_along_p, _pull_p = Primitive("jfrnn_along"), Primitive("jfrnn_pull")
define(_along_p, _along, _pull_p, lambda _, lines: lines[2].shape, _along)
define(_pull_p, _pull_by_kernel, _along_p, lambda _, lines: lines[0].sources.shape, _pull)
