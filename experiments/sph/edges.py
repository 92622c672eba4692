"""Pairs as flattened edges, and sums over them by `jax.ops.segment_sum`: the way of jax-sph, to measure ours against.

Terms and integrators are those of the solver, so that the physics is the same; what differs is where pairs come from and how they
are summed. Source: Toshev et al. (2024), arXiv:2403.04750; https://github.com/tumaer/jax-sph, `solver.py` and `simulate.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from jfrnn.sph.particles import Model, State

_SLACK = 1.25  # room for more edges, as jax-sph has it


def _sum_edges(fn: Callable[[Array, Any, Any], Any], x: Array, values: Any, i: Array, j: Array) -> Any:  # noqa: ANN401
    mine, theirs = (jax.tree.map(lambda value, k=k: value[k], values) for k in (i, j))
    terms = jax.vmap(fn)(x[j] - x[i], mine, theirs)
    return jax.tree.map(lambda term: jax.ops.segment_sum(term, i, x.shape[0]), terms)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OwnEdges:
    """Edges of a list of jfrnn, flattened when it is made anew.

    Attributes:
        nbrs: With a skin.
        i, j: Shape [edges], int32.
    """

    nbrs: jfrnn.NeighborList
    i: Array
    j: Array

    @property
    def overflow(self) -> Array:
        """Whether edges are missing, shape [], bool."""
        return self.nbrs.overflow | (jnp.sum(self.nbrs.count) > self.i.shape[0])

    @property
    def rebuild_count(self) -> Array:
        """How often they were made anew, shape [], int32."""
        return self.nbrs.rebuild_count

    def update(self, positions: Array, *, active: Array | None = None) -> "OwnEdges":
        """Return the edges at these positions."""
        nbrs = self.nbrs.update(positions, active=active)
        made = nbrs.rebuild_count != self.nbrs.rebuild_count
        i, j = jax.lax.cond(made, lambda: nbrs.pairs(self.i.shape[0]), lambda: (self.i, self.j))
        return OwnEdges(nbrs, i, j)

    def sum(self, fn: Callable[[Array, Any, Any], Any], positions: Array, values: Any) -> Any:  # noqa: ANN401
        """Sum over the edges of each i."""
        return _sum_edges(fn, positions, values, self.i, self.j)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JaxMdEdges:
    """Edges of jax-md's neighbor list, format Sparse.

    Attributes:
        nbrs: `jax_md.partition.NeighborList`.
        low: What is taken off positions [m], shape [d]: its cells begin at 0.
        rebuilds: How often they were made anew, shape [], int32.
        always: They are made anew in every step. Static.
    """

    nbrs: Any
    low: Array
    rebuilds: Array
    always: bool = field(metadata={"static": True})

    @property
    def overflow(self) -> Array:
        """Whether edges are missing, shape [], bool."""
        return self.nbrs.did_buffer_overflow

    @property
    def rebuild_count(self) -> Array:
        """How often they were made anew, shape [], int32."""
        return self.rebuilds

    def update(self, positions: Array, *, active: Array | None = None) -> "JaxMdEdges":
        """Return the edges at these positions."""
        if active is not None:
            raise ValueError("jax-md's list knows no inactive particles: take a scene without inflow.")
        nbrs = self.nbrs.update(positions - self.low)
        made = self.always | jnp.any(nbrs.reference_position != self.nbrs.reference_position)
        return replace(self, nbrs=nbrs, rebuilds=self.rebuilds + made.astype(jnp.int32))

    def sum(self, fn: Callable[[Array, Any, Any], Any], positions: Array, values: Any) -> Any:  # noqa: ANN401
        """Sum over the edges of each i."""
        i, j = self.nbrs.idx
        return _sum_edges(fn, positions, values, i, j)


def of_own_list(model: Model, s: State, skin: float) -> OwnEdges:
    """Return edges of a list of jfrnn with a skin [m]."""
    nbrs = jfrnn.search(s.x, model.cutoff, skin=skin, slack=_SLACK)
    i, j = nbrs.pairs(round(_SLACK * int(np.asarray(nbrs.count).sum(dtype=np.int64))))
    return OwnEdges(nbrs, i, j)


def of_jax_md(model: Model, s: State, skin: float) -> JaxMdEdges:
    """Return edges of jax-md with a skin [m]; 0: made anew in every step, as jax-sph does.

    Raises:
        ImportError: jax-md is not installed.
    """
    from jax_md import partition, space  # pyright: ignore[reportMissingImports]

    margin = model.cutoff + skin  # what leaves the box is found in its first or last cells
    low = jnp.min(s.x, axis=0) - margin
    size = jnp.max(s.x, axis=0) - low + margin
    displacement, _ = space.free()
    make: Any = partition.neighbor_list(
        displacement, size, model.cutoff, skin, capacity_multiplier=_SLACK, format=partition.NeighborListFormat.Sparse
    )
    return JaxMdEdges(make.allocate(s.x - low), low, jnp.zeros((), jnp.int32), always=skin == 0)
