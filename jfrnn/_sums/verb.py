"""The public function `pair_sum`: sums over neighbors without a neighbor list."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
from jax import Array

from jfrnn._engine import ARRAYS, ENGINES, Features, Inputs, Options, parse_backend, platform_of
from jfrnn._geometry import Box, check_flag, check_values
from jfrnn._search import Asked, EdgeList, NeighborList, check_problem
from jfrnn._tracing import (
    AnyCutoff,
    Backend,
    Flag,
    Flags,
    IndexRows,
    Indices,
    Points,
    RadiusRule,
    Tree,
    on_device,
    own_transfers,
)

Sums = TypeVar("Sums")  # what the function of a pair returns, and with one more axis the sum
REDUCTIONS = ("sum", "max", "min")
SYMMETRIES = (None, "symmetric", "antisymmetric")


def pair_sum(  # noqa: D417 (nine arguments share a line)
    fn: Callable[[Array, Any, Any], Sums],
    positions: Points,
    cutoff: AnyCutoff | None,
    values: Tree = None,
    *,
    query_values: Tree = None,
    reduce: Literal["sum", "max", "min"] = "sum",
    symmetry: Literal["symmetric", "antisymmetric"] | None = None,
    queries: Points | None = None,
    box: Box | None = None,
    batch: Indices | tuple[Indices, Indices] | None = None,
    radius_rule: RadiusRule = "gather",
    species: Indices | tuple[Indices, Indices] | None = None,
    exclude: IndexRows | None = None,
    include_self: Flag = False,
    closed: Flag = False,
    active: Flags | None = None,
    compensated: Flag = False,
    backend: Backend = "auto",
    neighbors: NeighborList | EdgeList | None = None,
) -> Sums:
    """Sum a function of pairs over the neighbors of each particle, without a neighbor list; differentiable to every order.

    result[i] = sum over the neighbors j of i of fn(r_ij, i, j), with r_ij = x_j - x_i (in a box + S·(lattice vectors), one term per
    image); the neighbors are those of `search` with the same options. The guide "Sums in full" (docs/guides/sums-in-full.md) tells
    more: order and rounding, memory, derivatives.

    Args:
        fn: A JAX function of one pair: the displacement r [length], shape [d], the values of i and those of j -> a pytree of
            arrays. It may close over arrays, traced ones too. Each new Python number that it closes over is compiled in.
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64.
        cutoff: As in `search`; with `neighbors` that of the list, a shorter one, or None.
        values: A pytree of arrays of shape [n, ...]; fn gets leaves [...], of j and, without queries, of i. Default: None.
        query_values: Values of the queries, leaves [m, ...], which fn gets for i.
        reduce: "sum"; or "max" or "min" of floats, of which rows without neighbors are -inf or inf.
        symmetry: "symmetric" or "antisymmetric": fn is evaluated in one direction of each pair, and the other gets the same value,
            or its negative, bit for bit. Not with queries, nor with the rules "gather" and "scatter".
        queries, box, batch, radius_rule, species, exclude, include_self, closed, active: As in `search`.
        compensated: Carry the rounding errors of the sums along (two-sum, Knuth 1969), also in derivatives.
        backend: "warp" (fn becomes part of the kernel that finds the pairs), "jax" (any device), "brute", or "auto".
        neighbors: A padded or flat list to use instead of a search: its pairs that are closer than the cutoff at these positions.

    Returns:
        A pytree as fn returns it, leaves [m, ...]. Invalid rows (NaN or infinite coordinates; inside jit all rows, if pairs may be
        missing) are NaN, integers the smallest of their dtype (unsigned: the largest); rows without neighbors are 0.

    Raises:
        NeighborOverflowError, ValueError: outside jit, pairs may be missing.
        TypeError, ValueError, NotImplementedError: an argument is of the wrong kind, shape or range; fn cannot be summed, or not by
            the engine that was chosen by name. Other errors of fn are raised with a note.

    Jit: yes; outside of it, define fn once. vmap: yes, one after the other. Source: sums as in SPH (Gingold & Monaghan 1977,
    doi:10.1093/mnras/181.3.375); derivatives by transposition (Radul et al. 2023, doi:10.1145/3571236).

    >>> import jax.numpy as jnp, jfrnn
    >>> x = jnp.array([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]])
    >>> jfrnn.pair_sum(lambda r, i, j: j * (r @ r), x, 1.0, jnp.array([1.0, 2.0, 4.0])).tolist()
    [0.5, 0.25, 0.0]
    """
    from jfrnn._sums.reduction import pairs_of_list, pairs_of_search, reduce_pairs

    if not callable(fn):
        raise TypeError(f"fn must be a function of (r, i, j), got {type(fn).__name__}.")
    if reduce not in REDUCTIONS:
        raise ValueError(f"reduce must be one of {', '.join(map(repr, REDUCTIONS))}, got {reduce!r}.")
    if symmetry not in SYMMETRIES:
        raise ValueError(f"symmetry must be None, 'symmetric' or 'antisymmetric', got {symmetry!r}.")
    compensated, named = check_flag("compensated", compensated), parse_backend(backend, ENGINES)
    if neighbors is None:
        if cutoff is None:
            raise ValueError("cutoff must be given: only a list (neighbors=) has its own.")
        if named is not None and (reason := named.refuse(Features(summed=True))):
            raise ValueError(f"backend={backend!r} {reason}")
        options = (radius_rule, species, exclude, False, include_self, closed, backend, 0.0, active)
        problem, inputs = check_problem(Asked(positions, cutoff, queries, box, batch, *options))
        with own_transfers():
            engine = _with_engine(problem.options, inputs, named is None)
            pairs = pairs_of_search(dataclasses.replace(problem, options=engine), inputs, reduce == "sum")
    else:
        given = {"batch": batch is not None, "radius_rule": radius_rule != "gather", "include_self": include_self}
        given |= {"species": species is not None, "exclude": exclude is not None}
        given |= {"closed": closed, "active": active is not None, "backend": named is not None}
        with own_transfers():
            pairs = pairs_of_list(neighbors, positions, cutoff, queries, box, given, reduce != "sum" or compensated)
    if symmetry is not None and not pairs.directionless:
        raise ValueError(
            f"symmetry={symmetry!r} is about pairs without direction: not with queries, nor with a cutoff of one side."
        )
    if queries is None and query_values is not None:
        raise ValueError("query_values belong to queries: without them fn gets values of i and of j.")
    shared = ": what all pairs share fn may close over"
    theirs = jax.tree.map(on_device, check_values("values", values, len(pairs.sources), "particle", shared))
    mine = theirs
    if queries is not None:
        mine = jax.tree.map(on_device, check_values("query_values", query_values, len(pairs.rows), "query", shared))
    with own_transfers():
        return reduce_pairs(fn, pairs, mine, theirs, reduce, symmetry, compensated)


def _with_engine(options: Options, inputs: Inputs, may_change: bool) -> Options:
    """Return options with an engine that supports this search; if none was named, the term may change the engine later."""
    from jfrnn._sums.fused import refusal

    sources, queries = inputs.sources, inputs.queries
    if not options.engine.translates:
        return options
    platform = platform_of(sources, sources if queries is None else queries)
    reason = refusal(inputs, platform)
    if reason is not None and not may_change:
        raise ValueError(f"backend='warp' cannot sum over pairs {reason}: pass backend='jax'.")
    return options._replace(may_change=may_change) if reason is None else options._replace(engine=ARRAYS)
