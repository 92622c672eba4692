"""Distances of a list that is its own mirror image, by Warp's kernels, with derivatives by kernels that gather.

A pair gives the opposite to j of what it gives to i. So derivatives by positions need two numbers of each slot: its slope and that
of its reverse slot. Neither displacements nor what belongs to them is stored.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive

from jfrnn._engine import KeptList, kept_distances, kept_slopes
from jfrnn._geometry import Box, Cutoff, Images, Radii, bring_near, translation
from jfrnn._search.gathers import bind, collect, define, gather
from jfrnn._search.geometry import ImagesMade, kept_list, kept_shifts, norms, open_vectors, periodic_vectors
from jfrnn._search.topology import Topology
from jfrnn._tracing import call_apart, compile_program


class _Given(NamedTuple):
    """A list without positions and box; see `kept_list`."""

    topology: Topology
    counts: Array
    images: ImagesMade
    cutoff: Cutoff | Radii | None


class _Lines(NamedTuple):
    """The pairs of a list at present positions, and their distances, 0 where there is no pair."""

    kept: KeptList
    topology: Topology
    distances: Array


@functools.partial(compile_program, static_argnames=("kind", "closed"))
def lengths(
    topology: Topology,
    count: Array,
    images: ImagesMade,
    sources: Array,
    box: Box | None,
    kind: Images | None,
    cutoff: Cutoff | Radii | None,
    closed: bool,
) -> tuple[Array, Array]:
    """Return distances [n, capacity] and the mask, as `norms` of the vectors gives them."""
    return _lengths((kind, closed), sources, box, lax.stop_gradient(_Given(topology, count, images, cutoff)))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _lengths(how: tuple[Images | None, bool], sources: Array, box: Box | None, given: _Given) -> tuple[Array, Array]:
    return call_apart(kept_distances, _at(how, sources, box, given))


def _at(how: tuple[Images | None, bool], sources: Array, box: Box | None, given: _Given) -> KeptList:
    kind, closed = how
    topology, counts, images, cutoff = given
    return kept_list(topology, counts, images, sources, sources, cutoff, closed, box, kind)


def _by_vectors(how: tuple[Images | None, bool], sources: Array, box: Box | None, given: _Given) -> tuple[Array, Array]:
    (kind, closed), (topology, counts, images, cutoff) = how, given
    if box is None or kind is None:
        vectors, mask = open_vectors(topology, counts, sources, sources, cutoff, closed)
    else:
        vectors, mask, _ = periodic_vectors(topology, counts, images, sources, sources, box, None, kind, cutoff, closed, False)
    return norms(vectors), mask


@functools.partial(_lengths.defjvp, symbolic_zeros=True)
def _lengths_jvp(how: tuple[Images | None, bool], primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    sources, box, given = primals
    moved, stretched, _ = tangents
    if any(not isinstance(x, SymbolicZero) for x in jax.tree.leaves(stretched)):
        both = (moved, stretched), (sources, box)
        moved, stretched = jax.tree.map(lambda x, at: jnp.zeros_like(at) if isinstance(x, SymbolicZero) else x, *both)
        (_, mask), (slopes, none) = jax.jvp(lambda x, box: _by_vectors(how, x, box, given), (sources, box), (moved, stretched))
        return (_lengths(how, sources, box, given)[0], mask), (slopes, none)
    distances, mask = _lengths(how, sources, box, given)
    none = SymbolicZero(jax.typeof(mask).to_tangent_aval())
    if isinstance(moved, SymbolicZero):
        return (distances, mask), (SymbolicZero(jax.typeof(distances)), none)
    fixed = _at(how, lax.stop_gradient(sources), lax.stop_gradient(box), given)
    near = sources if fixed.lattice is None else bring_near(sources, fixed.lattice).points
    lines = _Lines(fixed._replace(sources=near, rows=near), given.topology, distances)
    return (distances, mask), (bind(_along_p, moved, lines), none)


def _directions(lines: _Lines) -> Array:
    """Return unit vectors from i to j, [n, capacity, d], 0 where there is no distance."""
    kept = lines.kept
    vectors = gather(kept.sources, lines.topology) - kept.sources[:, None, :]
    if kept.lattice is not None:
        vectors = vectors + translation(lax.stop_gradient(kept_shifts(kept)), kept.lattice)
    apart = lines.distances > 0
    return jnp.where(apart[..., None], vectors / jnp.where(apart, lines.distances, 1)[..., None], 0)


def _along(moved: Array, lines: _Lines) -> Array:
    """Return how fast distances grow while sources move, [n, capacity]."""
    away = gather(moved, lines.topology) - moved[:, None, :]
    return jnp.sum(_directions(lines) * away, axis=-1)


def _pull(slopes: Array, lines: _Lines) -> Array:
    """Return the transpose of `_along`, [n, d]."""
    parts = slopes[..., None] * _directions(lines)
    return collect(parts, lines.topology) - jnp.sum(parts, axis=1)


def _pull_by_kernel(slopes: Array, lines: _Lines) -> Array:
    return kept_slopes(lines.kept, lines.topology.with_reverse().slots, lines.distances, slopes)


_along_p, _pull_p = Primitive("jfrnn_along"), Primitive("jfrnn_pull")
define(_along_p, _along, _pull_p, lambda shape, lines: lines.distances.shape, _along)
define(_pull_p, _pull_by_kernel, _along_p, lambda shape, lines: lines.kept.sources.shape, _pull)
