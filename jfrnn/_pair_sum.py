"""The public verb `pair_sum`: sums over neighbors without a list of them."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._backends import Inputs, Options, is_decidable, without_inactive
from jfrnn._box import Box, Images, Lattice, make_lattice, translation
from jfrnn._exact import Radii, make_cutoffs
from jfrnn._extremes import bind_extremes
from jfrnn._inputs import checked_backend, checked_cutoff, checked_flag
from jfrnn._neighbors import NeighborList
from jfrnn._relations import Listed, Relation, Searched
from jfrnn._search import checked_problem
from jfrnn._summation import bind_sum
from jfrnn._terms import Groups, Summand, chosen, traced

REDUCTIONS = ("sum", "max", "min")
SYMMETRIES = (None, "symmetric", "antisymmetric")


def pair_sum(
    fn: Callable[[Array, Any, Any], Any],
    positions: Array,
    cutoff: float | Array | tuple[Array, Array] | None,
    values: Any = None,  # noqa: ANN401
    *,
    query_values: Any = None,  # noqa: ANN401
    reduce: str = "sum",
    symmetry: str | None = None,
    queries: Array | None = None,
    box: Box | None = None,
    batch: Array | tuple[Array, Array] | None = None,
    radius_rule: str = "gather",
    include_self: bool = False,
    closed: bool = False,
    active: Array | None = None,
    compensated: bool = False,
    backend: str = "auto",
    neighbors: NeighborList | None = None,
) -> Any:  # noqa: ANN401
    """Sum a function of pairs over the neighbors of each particle, without a list of them; differentiable to every order.

    result[i] = sum over the neighbors j of i of fn(r_ij, i, j), r_ij = x_j - x_i (in a periodic box + S·(lattice vectors), a term
    for each image). The neighbors are exactly those of `search` with the same options.

    Args:
        fn: A JAX function of one pair: of the displacement r [length], shape [d], of the values of i and those of j; it returns a
            pytree of arrays of floats or integers. It may close over arrays, traced ones too, and be differentiated in them. Where
            particles may coincide or are their own neighbors, it must itself be safe at r = 0 (the derivative of sqrt is not).
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64. n = 0 is allowed.
        cutoff: As in `search`; with `neighbors` that of the list, or None.
        values: A pytree of arrays of shape [n, ...]; fn gets leaves [...], of j and, without queries, of i. Default: None.
        query_values: Likewise of the queries, leaves [m, ...], what fn gets of i. Only with queries.
        reduce: "sum"; or "max" or "min", of each element of what fn returns, floats. Rows without neighbors then are -inf or inf.
        symmetry: None: fn is asked about (i, j) and about (j, i). "symmetric" or "antisymmetric": fn is asked in one direction,
            from the smaller index to the larger (of its own images: where the first number of S that is not zero is positive);
            the other direction gets the same, or its negative, bit for bit. So forces balance to the rounding of the sums. Every
            row gets its whole sum in any case. Not with queries, nor with the rules "gather" and "scatter".
        queries: As in `search`: rows belong to them.
        box: As in `search`; with `neighbors` as in `NeighborList.vectors`.
        batch: As in `search`.
        radius_rule: As in `search`.
        include_self: As in `search`; r is 0 then.
        closed: As in `search`.
        active: As in `search`.
        compensated: Carry the rounding errors of the sums along (two-sum, Knuth 1969) and add them in the end: the result is as if
            summed in twice the precision. Derivatives are summed so, too. "max" and "min" are not concerned.
        backend: "jax" (cells, any device), "brute" (all n·m candidates), or "auto": "jax".
        neighbors: A list whose pairs are taken instead of a search: those that are closer than its cutoff at these positions, as
            `NeighborList.vectors` says. A half list gives whole sums, too. Options with which it was made are left out. Rows that
            overflowed lack pairs here as everywhere: see `NeighborList.check`.

    Returns:
        A pytree as fn returns it, leaves [m, ...]. Rows without neighbors, and those of particles that are inactive or have NaN or
        infinite coordinates, are 0 ("max": -inf, "min": inf). Where the data show that a search cannot answer (a box that is too
        small, a particle too far outside of it, a cutoff that is not positive and finite), all floats are NaN and all integers the
        smallest of their kind; `search` says what it was.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or fn returns what cannot be summed.

    Order of summation: the neighbors of a particle as the engine meets them (cell by cell, or by index in "brute", or as listed) in
    groups of up to 32; first within a group, then one group after the other; compensated, a group is added up by halves. The
    same input gives the same bits. With k neighbors the error is at most 4 eps·sqrt(k) of the sum of |terms| for k up to 60 000;
    compensated a few eps of the sum itself, and some eps²·k of the sum of |terms|.
    Memory: what `search` takes without its list, the results, and at most 16 MB (float32) for each array that fn needs for the
    pairs that are in work; nothing grows with the number of pairs, in derivatives neither.
    Differentiable: to every order, forward and backward, in positions, queries, values, query_values, the lattice vectors of the
    box and whatever fn closes over; who is a neighbor is a constant. A derivative is a sum over the same pairs, gathered
    by each particle (over a list that is not its own mirror image, scattered). What is no pair has no part in it, whatever fn
    makes of it. "max" and "min" have the derivative of the pair that is the extreme one; of several, of that with the smallest j.
    Jit: yes; outside of it, define fn once: one that is defined anew for each call is compiled anew. vmap: yes, one after the
    other. Source: sums over neighbors as in SPH (Gingold & Monaghan 1977, doi:10.1093/mnras/181.3.375); derivatives by
    transposition (Radul et al. 2023, doi:10.1145/3571236).
    """
    if not callable(fn):
        raise TypeError(f"fn must be a function of (r, i, j), got {type(fn).__name__}.")
    if reduce not in REDUCTIONS:
        raise ValueError(f"reduce must be one of {', '.join(map(repr, REDUCTIONS))}, got {reduce!r}.")
    if symmetry not in SYMMETRIES:
        raise ValueError(f"symmetry must be None, 'symmetric' or 'antisymmetric', got {symmetry!r}.")
    compensated = checked_flag("compensated", compensated)
    if neighbors is None:
        if cutoff is None:
            raise ValueError("cutoff must be given: only a list (neighbors=) has its own.")
        engine = _checked_engine(backend)
        problem = checked_problem(
            positions, cutoff, queries, box, batch, radius_rule, False, include_self, closed, engine, 0.0, active
        )
        pairs = _searched(problem.inputs, problem.options)
    else:
        given = {"batch": batch is not None, "radius_rule": radius_rule != "gather", "include_self": include_self}
        given |= {"closed": closed, "active": active is not None, "backend": backend != "auto"}
        pairs = _listed(neighbors, positions, cutoff, queries, box, given, reduce != "sum" or compensated)
    if symmetry is not None and not pairs.directionless:
        raise ValueError(
            f"symmetry={symmetry!r} is about pairs without direction: not with queries, nor with a cutoff of one side."
        )
    if queries is None and query_values is not None:
        raise ValueError("query_values belong to queries: without them fn gets values of i and of j.")
    theirs = _checked_values("values", values, pairs.sources.shape[0], "particle")
    mine = theirs if queries is None else _checked_values("query_values", query_values, pairs.rows.shape[0], "query")
    return _reduced(fn, pairs, mine, theirs, reduce, symmetry, compensated)


class _Pairs(NamedTuple):
    """Which pairs, and what their displacements are made of."""

    relations: tuple[Relation, ...]
    sources: Array
    rows: Array
    lattice: Lattice | None
    largest: Any  # cutoff
    directionless: bool
    decidable: Array | None


def _checked_engine(backend: Any) -> str:  # noqa: ANN401
    if checked_backend(backend) in ("warp", "hashgrid"):
        raise ValueError(f"backend={backend!r} cannot sum over pairs yet: pass 'jax', 'brute' or 'auto'.")
    return "jax" if backend == "auto" else backend


def _searched(inputs: Inputs, options: Options) -> _Pairs:
    sources, queries, active, box, cutoff, _ = inputs
    fixed = lax.stop_gradient(inputs._replace(sources=without_inactive(sources, active), active=None))
    relation, several = Searched(fixed, options), isinstance(cutoff, Radii)
    decidable = is_decidable(inputs, options) if several or box is not None else None
    largest = make_cutoffs(cutoff, options.closed).largest if isinstance(cutoff, Radii) else cutoff.radius
    lattice = _lattice(box, options.images, sources)
    rows = sources if queries is None else queries
    return _Pairs((relation,), sources, rows, lattice, largest, relation.symmetric, decidable)


def _listed(
    nbrs: NeighborList,
    positions: Array,
    cutoff: Any,  # noqa: ANN401
    queries: Array | None,
    box: Box | None,
    given: dict[str, bool],
    full: bool,
) -> _Pairs:
    if not isinstance(nbrs, NeighborList):
        raise TypeError(f"neighbors must be a jfrnn.NeighborList, got {type(nbrs).__name__}.")
    for name in (name for name, is_given in given.items() if is_given):
        raise ValueError(f"{name} was said when the list was made: leave it out where neighbors is given.")
    if full and nbrs.half:
        raise ValueError("neighbors must be a full list for reduce='max', 'min' and compensated=True: search without half=True.")
    sources, rows = nbrs.geometry_inputs(positions, queries)
    dtype = np.dtype(sources.dtype)
    if cutoff is not None and (nbrs.cutoff is None or float(checked_cutoff(cutoff, dtype).radius) != nbrs.cutoff):
        has = "a cutoff per particle" if nbrs.cutoff is None else f"cutoff={nbrs.cutoff}"
        raise ValueError(f"cutoff must be None or that of the list, which has {has}, got {cutoff!r}.")
    fixed, fixed_rows, fixed_box = lax.stop_gradient((sources, rows, box))
    _, mask, shifts = nbrs.geometry(fixed, fixed_rows if nbrs.own_queries else None, fixed_box)
    directionless = not nbrs.own_queries and (nbrs.radii is None or nbrs.radii.rule not in ("gather", "scatter"))
    relation = Listed(nbrs.idx, mask, shifts, nbrs.source_count, symmetric=directionless and not nbrs.half)
    relations: tuple[Relation, ...] = (relation,)
    if nbrs.half:  # its mirror image, in which no pair of a particle with itself stands again
        apart = nbrs.idx != lax.iota(jnp.int32, nbrs.idx.shape[0])[:, None]
        apart = apart if shifts is None else apart | (shifts != 0).any(axis=-1)
        relations = relation, Listed(nbrs.idx, mask & apart, shifts, nbrs.source_count, symmetric=False, flipped=True)
    lattice = _lattice(nbrs.box_now(box, sources), nbrs.box_kind, sources)
    largest = nbrs.cutoff if nbrs.radii is None else make_cutoffs(lax.stop_gradient(nbrs.radii), nbrs.closed).largest
    return _Pairs(relations, sources, rows, lattice, largest, directionless, None)


def _lattice(box: Box | None, images: Images | None, like: Array) -> Lattice | None:
    return None if box is None or images is None else make_lattice(box, images, np.dtype(like.dtype))


def _checked_values(name: str, values: Any, size: int, what: str) -> Any:  # noqa: ANN401
    def checked(path: Any, leaf: Any) -> Array:  # noqa: ANN401
        if not hasattr(leaf, "shape") or not hasattr(leaf, "dtype"):
            raise TypeError(
                f"{name}{jax.tree_util.keystr(path)} must be an array with a row per {what}, got {type(leaf).__name__}."
            )
        if tuple(leaf.shape[:1]) != (size,):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must have shape [{size}, ...], one row per {what}, got {list(leaf.shape)}: "
                "what all pairs share fn may close over."
            )
        return jnp.asarray(leaf)

    return jax.tree_util.tree_map_with_path(checked, values)


def _reduced(
    fn: Callable[[Array, Any, Any], Any],
    pairs: _Pairs,
    mine: Any,  # noqa: ANN401
    theirs: Any,  # noqa: ANN401
    reduce: str,
    symmetry: str | None,
    compensated: bool,
) -> Any:  # noqa: ANN401
    """Trace fn, sum it, and give the sums the structure of what it returns."""
    operands, summand, structure = _summand(fn, pairs, mine, theirs, symmetry)
    one_pair = Groups(
        tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands.shared),
        *(tuple(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in group) for group in operands[1:]),
    )
    term, needed, closed_over = traced(summand, one_pair, jax.ShapeDtypeStruct(pairs.sources.shape[1:], pairs.sources.dtype), fn)
    if reduce != "sum" and not all(jnp.issubdtype(x.dtype, jnp.floating) for x in term.summands):
        raise TypeError(f"fn must return floats for reduce={reduce!r}, whose rows may be infinite: convert them with .astype.")
    operands = chosen(operands, needed)
    operands = operands._replace(shared=(*closed_over, *operands.shared))
    if reduce == "sum":
        parts = (bind_sum(relation, term, operands, compensated) for relation in pairs.relations)
        leaves = functools.reduce(lambda a, b: [x + y for x, y in zip(a, b, strict=True)], parts)
    else:
        leaves = bind_extremes(pairs.relations[0], term, operands, reduce == "max")
    if pairs.decidable is not None:
        leaves = [_marked(x, pairs.decidable) for x in leaves]
    return jax.tree.unflatten(structure[0], leaves)


def _summand(
    fn: Callable[[Array, Any, Any], Any],
    pairs: _Pairs,
    mine: Any,  # noqa: ANN401
    theirs: Any,  # noqa: ANN401
    symmetry: str | None,
) -> tuple[Groups, Summand, list]:
    """Return the operands, fn as a function of one pair of them, and a list that takes the structure of what fn returns."""
    sources, rows, lattice = pairs.sources, pairs.rows, pairs.lattice
    dtype = sources.dtype
    harmless = jnp.zeros(sources.shape[1], dtype).at[0].set(jnp.asarray(pairs.largest, dtype) / 2)
    turning = [] if lattice is None else [lattice.matrix]
    numbers = [lax.iota(jnp.int32, len(x)) for x in (rows, sources)]
    (own, own_tree), (others, other_tree) = jax.tree.flatten(mine), jax.tree.flatten(theirs)
    operands = Groups((harmless, *turning), (rows, numbers[0], *own), (sources, numbers[1], *others))
    structure: list = []

    def summand(real: Array, shift: Array, operands: Groups) -> list[Array]:
        (harmless, *matrix), (x_i, number_i, *own), (x_j, number_j, *others) = operands
        r = x_j - x_i
        if lattice is not None:
            r = r + translation(shift, dataclasses.replace(lattice, matrix=matrix[0]))
        r = jnp.where(real, r, harmless)  # what fn gets where there is no pair must not stop it, or raise in debug modes
        i, j = jax.tree.unflatten(own_tree, own), jax.tree.unflatten(other_tree, others)
        if symmetry is None:
            return leaves_of(fn(r, i, j))
        ahead = (number_i < number_j) | ((number_i == number_j) & ~_is_backward(shift))
        i, j = (jax.tree.map(functools.partial(jnp.where, ahead), *sides) for sides in ((i, j), (j, i)))
        leaves = leaves_of(fn(jnp.where(ahead, r, -r), i, j))
        return leaves if symmetry == "symmetric" else [jnp.where(ahead, x, -x) for x in leaves]

    def leaves_of(result: Any) -> list[Array]:  # noqa: ANN401
        leaves, tree = jax.tree.flatten(result)
        structure[:] = [tree]
        return [_summable(x, dtype) for x in leaves]

    return operands, summand, structure


def _is_backward(shift: Array) -> Array:
    """Say whether the first number of a shift [d] that is not zero is negative."""
    result = jnp.zeros((), bool)
    for k in reversed(range(shift.shape[0])):
        result = (shift[k] < 0) | ((shift[k] == 0) & result)
    return result


def _summable(x: Any, dtype: np.dtype) -> Array:  # noqa: ANN401
    array = jnp.asarray(x)
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise TypeError(f"fn must return floats or integers, got {array.dtype}: convert it, e.g. with .astype(jnp.int32).")
    is_loose = jnp.issubdtype(array.dtype, jnp.floating) and jax.typeof(array).weak_type
    return array.astype(dtype if is_loose else array.dtype)


def _marked(x: Array, decidable: Array) -> Array:
    """Return what is no result where the data show that there is none; its derivatives likewise."""
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x * jnp.where(decidable, 1, jnp.nan).astype(x.dtype)
    return jnp.where(decidable, x, jnp.iinfo(x.dtype).min)
