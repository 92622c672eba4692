"""The public function `pair_sum`: sums over neighbors without a neighbor list."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
from jax import Array
from jax.tree_util import KeyPath

from jfrnn._engine import ARRAYS, ENGINES, Inputs, Kind, Options, parse_backend, platform_of
from jfrnn._geometry import Box, check_flag
from jfrnn._search import NeighborList, check_problem
from jfrnn._tracing import (
    AnyCutoff,
    Backend,
    Flag,
    Flags,
    Given,
    IndexRows,
    Indices,
    Points,
    RadiusRule,
    Tree,
    as_array,
    on_device,
    own_transfers,
)

Sums = TypeVar("Sums")  # what the function of a pair returns, and with one more axis the sum
REDUCTIONS = ("sum", "max", "min")
SYMMETRIES = (None, "symmetric", "antisymmetric")


def pair_sum(
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
    neighbors: NeighborList | None = None,
) -> Sums:
    """Sum a function of pairs over the neighbors of each particle, without a neighbor list; differentiable to every order.

    result[i] = sum over the neighbors j of i of fn(r_ij, i, j), with the displacement r_ij = x_j - x_i (in a periodic box +
    S·(lattice vectors), one term per image). The neighbors are exactly those of `search` with the same options.

    Args:
        fn: A JAX function of one pair. It gets the displacement r [length], shape [d], the values of i and those of j, and returns
            a pytree of arrays of floats or integers. It may close over arrays, traced ones too, and be differentiated in them.
            Python numbers that it closes over are compiled in: each new value costs about a second of compilation, so close over
            `jnp.asarray(number, x.dtype)` if a number changes. If particles may coincide or are their own neighbors, fn must be
            safe at r = 0 (the derivative of sqrt is not).
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64, or fractional coordinates, as in
            `search`. n = 0 is allowed.
        cutoff: As in `search`; with `neighbors` a number that is at most the cutoff of the list, or None: that of the list.
        values: A pytree of arrays of shape [n, ...]; fn gets leaves [...], of j and, without queries, of i. Default: None.
        query_values: Values of the queries, leaves [m, ...], which fn gets for i. Only with queries.
        reduce: "sum"; or "max" or "min" of each element of fn's result, which must be floats. Rows without neighbors are -inf or
            inf then.
        symmetry: None: fn is evaluated for (i, j) and for (j, i). "symmetric" or "antisymmetric": fn is evaluated in one direction,
            from the smaller index to the larger (for a particle's own images: with the first nonzero number of S positive); the
            other direction gets the same value, or its negative, bit for bit. So forces balance up to the rounding of the sums.
            Every row gets its whole sum in any case. Not with queries, nor with the rules "gather" and "scatter".
        queries: As in `search`; the result has one row per query.
        box: As in `search`, one for all or one per system; with `neighbors` as in `NeighborList.vectors`.
        batch: As in `search`.
        radius_rule: As in `search`.
        species: As in `search`.
        exclude: As in `search`.
        include_self: As in `search`; r is 0 then.
        closed: As in `search`.
        active: As in `search`.
        compensated: Carry the rounding errors of the sums along (two-sum, Knuth 1969) and add them at the end, as if summed in
            twice the precision; also in derivatives. Has no effect on "max" and "min".
        backend: "jax" (cells, any device), "brute" (all n·m candidates), "warp" (cells, on the CPU and on CUDA: fn is translated
            into the kernel that finds the pairs), or "auto": on the CPU "warp" if it supports the sum, else "jax". "warp" sums
            floats of the dtype of the positions; values and closed-over arrays have that dtype, or are smaller floats, bool, int32
            or (float64) int64. If fn or its derivative has no translation, "auto" warns.
        neighbors: A list to use instead of a search: its pairs that are closer than the cutoff at these positions, as in
            `NeighborList.vectors`. A half list gives whole sums too. Leave out the options with which it was made. If the list may
            lack pairs (see `NeighborList.check`), this raises outside jit. Over lists that "warp" made, on the CPU and on CUDA, a
            kernel reads the rows and evaluates the translated fn, with cutoffs per particle too; over others, and with a warning
            if fn has no translation, array programming does. On a GPU rows are taken in the order of space that the list keeps,
            and read fastest if particles that follow each other are close (`sort_order`).

    Returns:
        A pytree as fn returns it, leaves [m, ...]. Rows of inactive particles, and rows without neighbors, are 0 ("max": -inf,
        "min": inf). Invalid rows are NaN, as are their derivatives in the positions, and integers are the smallest of their dtype.
        Invalid are rows of particles with NaN or infinite coordinates; and, inside jit, all rows if the data show that pairs may be
        missing (a box that is too small, a particle too far outside of it, a cutoff per particle that is negative or not finite, a
        list that overflowed). The `status` of a `search`, or of the list, tells the reason.

    Raises:
        NeighborOverflowError, ValueError: outside jit, pairs may be missing, as above.
        TypeError, ValueError: an argument is of the wrong kind, shape or range; fn does not take (r, i, j), needs a concrete value
            (as `if` does), or returns what cannot be summed; or "warp" was chosen by name and does not support the sum. Other
            errors of fn are raised unchanged, with a note that describes its arguments.
        NotImplementedError: "warp" was chosen by name, and a primitive of fn or its derivative, named in the message, has no
            translation.

    Order of summation: neighbors are added in the order in which the engine meets them (cell by cell; "brute" by index; a list as
    listed) in groups of up to 32, first within a group, then group by group. The same input gives the same bits. With k neighbors
    the error is at most 4 eps·sqrt(k) of the sum of |terms| for k up to 60 000; compensated a few eps of the sum itself plus some
    eps²·k of the sum of |terms|. "warp" on the CPU adds 4 to 16 partial sums, and then these pairwise; its bits depend on the
    processor's vector width, not on the number of threads. On CUDA it adds the terms among up to 704 candidates one by one, then
    their sums; over a list one by one, or as eight partial sums where rows are few. The error bound is the same for all.
    In fn, denormal numbers count as zero on the CPU, as everywhere in XLA; pairs are decided with them. Matrix products in fn, such
    as r @ r, have full precision, also on GPUs whose default is TF32, unless fn sets `precision`.
    Memory: that of `search` without its list, the results, and at most 16 MB (float32) for each array that fn needs for the pairs
    being processed; nothing grows with the number of pairs, nor in derivatives. "warp" needs instead two copies of the numbers that
    fn reads of each j and one of those of each i, except coordinates in open space, and in a box one more number for each; over a
    list a copy of the coordinates and numbers of each j, padded to multiples of 16 B, and one of those of each i. See
    `memory_plan`.
    Differentiable: to every order, forward and backward, in positions, queries, values, query_values, the lattice vectors of the
    box and whatever fn closes over; which particles are neighbors is constant. A derivative is a sum over the same pairs, gathered
    by each particle. In a compiled function "warp" finds pairs once for several sums over them, such as a total and its gradient,
    unless one needs the results of another. For a list that is not its own mirror image, the slots of each j are found by a sort,
    unless the list keeps them (`reverse` of `search`); array programming scatters there. "max" and "min" have the derivative of the
    extreme pair, of several the one with the smallest j.
    Jit: yes; outside of it, define fn once, since each new definition is compiled anew. vmap: yes, one after the other. Source:
    sums over neighbors as in SPH (Gingold & Monaghan 1977, doi:10.1093/mnras/181.3.375); derivatives by transposition (Radul et al.
    2023, doi:10.1145/3571236).
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
        if named is not None and (reason := named.refuse(Kind(summed=True))):
            raise ValueError(f"backend={backend!r} {reason}")
        problem, inputs = check_problem(
            positions, cutoff, queries, box, batch, radius_rule, species, exclude, False, include_self, closed, backend, 0.0, active
        )
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
    theirs = _check_values("values", values, pairs.sources.shape[0], "particle")
    mine = theirs if queries is None else _check_values("query_values", query_values, pairs.rows.shape[0], "query")
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


def _check_values(name: str, values: Tree, size: int, what: str) -> Tree:
    def check_leaf(path: KeyPath, leaf: Given) -> Array:
        leaf = as_array(f"{name}{jax.tree_util.keystr(path)}", leaf)
        if not hasattr(leaf, "shape") or not hasattr(leaf, "dtype"):
            raise TypeError(
                f"{name}{jax.tree_util.keystr(path)} must be an array with a row per {what}, got {type(leaf).__name__}."
            )
        if tuple(leaf.shape[:1]) != (size,):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must have shape [{size}, ...], one row per {what}, got {list(leaf.shape)}: "
                "what all pairs share fn may close over."
            )
        return on_device(leaf)

    return jax.tree_util.tree_map_with_path(check_leaf, values)
