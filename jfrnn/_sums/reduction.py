"""What `pair_sum` reduces: the pairs of a search or of a list, and the summand made from the user's function."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn import _geometry as geometry
from jfrnn._engine import ARRAYS, Inputs, Options, find_bits, hide_inactive, rows_asked
from jfrnn._search import MOST_SLOTS, EdgeList, NeighborList, Problem, find_ends, kept_list, lattice_of_rows
from jfrnn._sums.extremes import bind_extremes
from jfrnn._sums.pair_function import call_with_pair
from jfrnn._sums.relations import Flat, Kept, Listed, Relation, Searched, is_fused
from jfrnn._sums.summation import bind_sum
from jfrnn._sums.terms import OF_QUERIES, OF_SOURCES, Groups, Summand, Term, choose, fresh_labels, trace
from jfrnn._tracing import Given, Points, Tree, call_apart, compile_program, on_device

Marked = tuple[Array, Array, Callable[[list[Array]], list[Array]]]  # what `_prepare_marks` returns


class Pairs(NamedTuple):
    """The pairs of a sum and the operands of their displacements.

    `mark`, of the term that is summed, returns sources and rows whose derivatives are NaN in invalid rows, and a function that
    replaces sums there by NaN (integers: the smallest one). Rows are invalid where pairs may be missing, and where the position of
    an active particle is not finite. None: nothing else makes rows invalid, so the sums mark them themselves.
    """

    relation: Relation
    half: bool  # each pair is listed once, and counts for both particles
    sources: Array
    rows: Array
    lattice: geometry.Lattice | None
    largest: Any  # the largest cutoff
    directionless: bool
    mark: Callable[[Term], Marked] | None
    sides: Array | None = None  # of the lattice, where they are known


def pairs_of_search(problem: Problem, inputs: Inputs, summed: bool) -> Pairs:
    """Return the pairs that a search finds; `summed` says that they are summed, rather than reduced to an extreme.

    Raises:
        ValueError: outside jit, the data show that pairs may be missing.
    """
    options = problem.options
    sources, queries, active, box, cutoff, batch, exclude, *_ = inputs
    fixed = lax.stop_gradient(inputs._replace(sources=hide_inactive(sources, active), active=None))
    relation, several = Searched(fixed, options), isinstance(cutoff, geometry.Radii)
    largest = geometry.make_cutoffs(cutoff, options.closed).largest if isinstance(cutoff, geometry.Radii) else cutoff.radius
    lattice, sides = _lattice(box, options.images, sources, batch)
    sources, queries = _bring_near(sources, queries, box, options.images, batch)
    unsure = (exclude is not None and exclude.valid is not None) or (batch is not None and batch.fit is not None)
    doubtful = by_data = several or box is not None or unsure
    if doubtful:
        known = geometry.known_status(call_apart(lambda inputs: find_bits(inputs, options), inputs))  # a program leaves it out
        problem.refuse(known, inputs)
        doubtful = known is None

    def mark(term: Term) -> Marked:
        asked = options if is_fused(relation, term) else options._replace(engine=ARRAYS)  # not by a kernel for it alone
        return _prepare_marks(sources, queries, _good_rows_of_search, (inputs,), (asked, doubtful))

    plain = summed and active is None and not by_data
    rows = sources if queries is None else queries
    return Pairs(relation, False, sources, rows, lattice, largest, relation.symmetric, None if plain else mark, sides)


def pairs_of_list(
    nbrs: NeighborList | EdgeList,
    positions: Points,
    cutoff: Given,
    queries: Points | None,
    box: geometry.Box | None,
    given: dict[str, bool],
    full: bool,
) -> Pairs:
    """Return the pairs of a list, after checking that no argument in `given` contradicts it; `full` refuses half lists."""
    if not isinstance(nbrs, NeighborList | EdgeList):
        raise TypeError(f"neighbors must be a jfrnn.NeighborList or a jfrnn.EdgeList, got {type(nbrs).__name__}.")
    for name in (name for name, is_given in given.items() if is_given):
        raise ValueError(f"{name} was said when the list was made: leave it out where neighbors is given.")
    if full and nbrs.half:
        raise ValueError("neighbors must be a full list for reduce='max', 'min' and compensated=True: search without half=True.")
    known = nbrs.box_numbers if box is None and cutoff is None else None
    sources, rows, box = nbrs._geometry_inputs(positions, queries, box)
    dtype = np.dtype(sources.dtype)
    if cutoff is not None:
        asked = geometry.check_cutoff(cutoff, dtype, ", or make the list with an array of one per particle, which may be traced")
        if nbrs.cutoff is None or asked > nbrs.cutoff:
            has = "a cutoff per particle" if nbrs.cutoff is None else f"cutoff={nbrs.cutoff}"
            raise ValueError(f"cutoff must be None or at most that of the list, which has {has}, got {cutoff!r}.")
        nbrs = dataclasses.replace(nbrs, problem=dataclasses.replace(nbrs.problem, cutoff=asked))
    own = nbrs.own_queries
    fixed_rows = lax.stop_gradient(rows)
    directionless = not own and (nbrs.radii is None or nbrs.radii.rule not in geometry.EXCHANGED)
    relation = _relation_of_list(nbrs, *lax.stop_gradient((sources, rows, box)), symmetric=directionless and not nbrs.half)
    if known is not None and isinstance(relation, Kept):
        relation = dataclasses.replace(relation, given=relation.given._replace(numbers=known.pairs))
    lattice, sides = _lattice(box, nbrs.box_kind, sources, nbrs.batch)
    if isinstance(relation, Kept) and not any(isinstance(x, Tracer) for x in jax.tree.leaves((sources, rows, box))):
        sources, rows = relation.given.ends  # no derivative is taken
    else:
        sources, asking = _bring_near(sources, rows if own else None, box, nbrs.box_kind, nbrs.batch)
        rows = sources if asking is None else asking
    largest = nbrs.cutoff if nbrs.radii is None else geometry.make_cutoffs(lax.stop_gradient(nbrs.radii), nbrs.closed).largest
    masked = nbrs.masked or (nbrs.box is not None and nbrs.box.per_system)
    held = (nbrs.count if isinstance(nbrs, NeighborList) else jnp.diff(nbrs.offsets)) if masked and not own else None
    data, harmless = (nbrs.status, held, fixed_rows), (nbrs._harmless,)
    sides = sides if known is None else known.sides

    def mark(_: Term) -> Marked:
        return _prepare_marks(sources, rows if own else None, _good_rows_of_list, data, harmless)

    return Pairs(relation, nbrs.half, sources, rows, lattice, largest, directionless, mark, sides)


def _relation_of_list(
    nbrs: NeighborList | EdgeList, sources: Array, rows: Array, box: geometry.Box | None, symmetric: bool
) -> Kept | Listed | Flat:
    """Return the pairs of a list: of padded ones Warp's kernels decide while they sum; else all is decided at once."""
    if isinstance(nbrs, EdgeList):
        mask, shifts = nbrs._close_edges(sources, rows, box)
        kind = {"source_count": nbrs.source_count, "symmetric": symmetric}
        return Flat(senders=nbrs.senders, receivers=nbrs.receivers, offsets=nbrs.offsets, mask=mask, shifts=shifts, **kind)
    present, empty = nbrs._at(sources, rows, box), 0 in (*nbrs.idx.shape, nbrs.source_count)
    if empty or not present.native or nbrs.idx.size > MOST_SLOTS:
        _, mask, shifts = nbrs._geometry_of(sources, rows, box)
        return Listed(idx=nbrs.idx, mask=mask, shifts=shifts, source_count=nbrs.source_count, symmetric=symmetric)
    nbrs._check_known(spared=geometry.ROWS_ARE_WHOLE)
    given = call_apart(kept_list, present)
    known = nbrs.reverse if nbrs.reverse is not None and nbrs.reverse.starts is not None else None
    return Kept(given, known, symmetric)


@functools.partial(compile_program, static_argnames=("options", "doubtful"))
def _good_rows_of_search(inputs: Inputs, options: Options, doubtful: bool) -> Array:
    """Say which rows [m] of a search are valid; `doubtful` says that the data decide whether pairs may be missing."""
    return geometry.good_rows(*rows_asked(inputs), geometry.are_whole(find_bits(inputs, options)) if doubtful else None)


@functools.partial(compile_program, static_argnames=("harmless",))
def _good_rows_of_list(status: Array, count: Array | None, points: Array, harmless: geometry.Status) -> Array:
    """Say which rows [m] of a list are valid. If particles may be inactive, `count` is given: those with neighbors are active."""
    active = None if count is None else (count > 0) | ((status & geometry.Status.NONFINITE.value) != 0)
    return geometry.good_rows(points, active, geometry.are_whole(status, harmless))


def _prepare_marks(
    sources: Array, queries: Array | None, are_good: Callable[..., Array], data: tuple, static: tuple = ()
) -> Marked:
    """Return sources, rows and a function that marks invalid rows; derivatives in invalid rows of the positions are NaN.

    `are_good(*data, *static)` says which rows are valid. For concrete arrays one program evaluates and applies it.
    """
    points = sources if queries is None else queries
    if not isinstance(points, Tracer):  # no derivatives are taken
        return sources, points, functools.partial(_mark_by, data=data, are_good=are_good, static=static)
    good = call_apart(lambda *data: are_good(*data, *static), *data)
    points = _mark_derivatives(points, good)
    return points if queries is None else sources, points, functools.partial(_mark, good=good)


@jax.custom_jvp
def _mark_derivatives(points: Array, good: Array) -> Array:
    del good
    return points


@_mark_derivatives.defjvp
def _mark_derivatives_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Any]) -> tuple[Array, Array]:
    points, good = primals
    return points, _mark([tangents[0]], good)[0]


def _lattice(
    box: geometry.Box | None, images: geometry.Images | None, like: Array, batch: geometry.Batch | None
) -> tuple[geometry.Lattice | None, Array | None]:
    """Return the lattice of all pairs or, where each system has a box of its own, of each row; and its sides if a box is known."""
    if box is None or images is None:
        return None, None
    systems, dtype = None if batch is None else batch.of_queries, np.dtype(like.dtype)
    if not any(isinstance(x, Tracer) for x in jax.tree.leaves((box, systems))):
        return _known_lattice(box, systems, images, dtype)
    return call_apart(lambda box, systems: lattice_of_rows(box, images, dtype, systems, False), box, systems), None


@functools.partial(compile_program, static_argnames=("images", "dtype"))
def _known_lattice(
    box: geometry.Box, systems: Array | None, images: geometry.Images, dtype: np.dtype
) -> tuple[geometry.Lattice, Array]:
    lattice = lattice_of_rows(box, images, dtype, systems, False)
    return lattice, geometry.sides_of(lattice)


def _bring_near(
    sources: Array, queries: Array | None, box: geometry.Box | None, images: geometry.Images | None, batch: geometry.Batch | None
) -> tuple[Array, Array | None]:
    """Return sources and queries near the box, as engines see them; differentiable in positions and box."""
    if box is None or images is None or images.counts_short:
        return sources, queries
    return _near_points(sources, queries, box, batch, images)


@functools.partial(compile_program, static_argnames="images")
def _near_points(
    sources: Array, queries: Array | None, box: geometry.Box, batch: geometry.Batch | None, images: geometry.Images
) -> tuple[Array, Array | None]:
    ends = find_ends(sources, sources if queries is None else queries, box, images, batch, False)
    return ends.sources.points, None if queries is None else ends.rows.points


def reduce_pairs(
    fn: Callable[[Array, Any, Any], Any],
    pairs: Pairs,
    mine: Tree,
    theirs: Tree,
    reduce: str,
    symmetry: str | None,
    compensated: bool,
) -> Tree:
    """Trace fn, reduce it over the pairs, and return the results in the structure that fn returns."""
    operands, summand, structure = _summand(fn, pairs, mine, theirs, symmetry)
    one_pair = Groups(
        tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands.shared),
        *(tuple(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in group) for group in operands[1:]),
    )
    shift = jax.ShapeDtypeStruct(pairs.sources.shape[1:], pairs.sources.dtype)
    theirs_first = OF_SOURCES, *fresh_labels(len(operands.others) - 1, ((), ()))
    labels = theirs_first, theirs_first  # where both sides are the same arrays
    if pairs.rows is not pairs.sources or mine is not theirs:
        labels = (OF_QUERIES, *fresh_labels(len(operands.own) - 1, ((), theirs_first))), theirs_first
    term, needed, closed_over = trace(summand, one_pair, shift, labels, fn, pairs.mark is None)
    finish = None
    if pairs.mark is not None:
        sources, rows, finish = pairs.mark(term)
        operands = operands._replace(own=(rows, *operands.own[1:]), others=(sources, *operands.others[1:]))
    if reduce != "sum" and not all(jnp.issubdtype(x.dtype, jnp.floating) for x in term.summands):
        raise TypeError(f"fn must return floats for reduce={reduce!r}, whose rows may be infinite: convert them with .astype.")
    operands = choose(operands, needed)
    known = not isinstance(pairs.sources, Tracer)
    operands = Groups(
        *(tuple(_numbers(x, known) if isinstance(x, jax.ShapeDtypeStruct) else x for x in group) for group in operands)
    )
    operands = operands._replace(shared=(*closed_over, *operands.shared))
    if reduce != "sum":
        leaves = bind_extremes(pairs.relation, term, operands, reduce == "max")
    elif pairs.half and not isinstance(pairs.relation, Searched):
        leaves = _sums_of_half(pairs.relation, term, operands, compensated)
    else:
        leaves = bind_sum(pairs.relation, term, operands, compensated)
    leaves = leaves if finish is None else finish(leaves)
    return jax.tree.unflatten(structure[0], leaves)


@functools.partial(compile_program, static_argnames=("term", "compensated"))
def _sums_of_half(listed: Listed | Flat | Kept, term: Term, operands: Groups, compensated: bool) -> list[Array]:
    """Sum over a half list and over its mirror image; a particle's pair with itself counts once."""
    parts = (bind_sum(relation, term, operands, compensated) for relation in (listed, listed.mirrored()))
    return [x + y for x, y in zip(*parts, strict=True)]


def _numbers(like: jax.ShapeDtypeStruct, known: bool) -> Array:
    """Return the particle numbers 0, 1, ...: made on the host if data are concrete, which needs no compilation."""
    n = like.shape[0]
    return on_device(np.arange(n, dtype=np.int32)) if known else lax.iota(jnp.int32, n)


def _summand(
    fn: Callable[[Array, Any, Any], Any], pairs: Pairs, mine: Tree, theirs: Tree, symmetry: str | None
) -> tuple[Groups, Summand, list]:
    """Return the operands, fn as a function of one pair of them, and a list that receives the structure of fn's result."""
    sources, rows, lattice = pairs.sources, pairs.rows, pairs.lattice
    dtype = sources.dtype
    harmless = _along_first_axis(pairs.largest, sources.shape[1], dtype)
    by_sides = lattice is not None and lattice.images.orthogonal and not lattice.images.per_system
    vectors = [] if lattice is None else [lattice.matrix]
    if by_sides and lattice is not None:
        vectors = [geometry.sides_of(lattice) if pairs.sides is None else pairs.sides]
    turning, each = ([], vectors) if lattice is not None and lattice.images.per_system else (vectors, [])
    same = rows is sources and mine is theirs
    numbers = [jax.ShapeDtypeStruct((len(x),), np.int32) for x in (rows, sources)]  # become arrays only if the term needs them
    (own, own_tree), (others, other_tree) = jax.tree.flatten(mine), jax.tree.flatten(theirs)
    theirs_too = each if same else []
    operands = Groups((harmless, *turning), (rows, numbers[0], *each, *own), (sources, numbers[1], *theirs_too, *others))
    structure: list = []

    def summand(real: Array, shift: Array, operands: Groups) -> list[Array]:
        (harmless, *matrix), (x_i, number_i, *own), (x_j, number_j, *others) = operands
        matrix, own, others = [*matrix, *own[: len(each)]], own[len(each) :], others[len(theirs_too) :]
        r = x_j - x_i
        if lattice is not None:
            move = shift * matrix[0] if by_sides else geometry.translation(shift, dataclasses.replace(lattice, matrix=matrix[0]))
            r = r + move
        r = jnp.where(real, r, harmless)  # for masked slots, an input for which fn raises nothing in debug modes
        i, j = jax.tree.unflatten(own_tree, own), jax.tree.unflatten(other_tree, others)
        if symmetry is None:
            return leaves_of(call_with_pair(fn, r, i, j))
        ahead = (number_i < number_j) | ((number_i == number_j) & ~_is_backward(shift))
        i, j = (jax.tree.map(functools.partial(jnp.where, ahead), *sides) for sides in ((i, j), (j, i)))
        leaves = leaves_of(call_with_pair(fn, jnp.where(ahead, r, -r), i, j))
        return leaves if symmetry == "symmetric" else [jnp.where(ahead, x, -x) for x in leaves]

    def leaves_of(result: Tree) -> list[Array]:
        leaves, tree = jax.tree.flatten(result)
        if not leaves:
            raise TypeError(f"fn must return arrays, got {result!r}: let it end with `return`.")
        structure[:] = [tree]
        return [_summable(x, dtype) for x in leaves]

    return operands, summand, structure


def _along_first_axis(largest: np.floating | Array, dim: int, dtype: np.dtype) -> Array:
    """Return a vector of half that length; of a number that is known it is made on the host, which needs no compilation."""
    if isinstance(largest, Array):
        return jnp.zeros(dim, dtype).at[0].set(jnp.asarray(largest, dtype) / 2)
    vector = np.zeros(dim, dtype)
    vector[0] = np.asarray(largest, dtype) / 2
    return on_device(vector)


def _is_backward(shift: Array) -> Array:
    """Say whether the first nonzero number of a shift [d] is negative."""
    result = jnp.zeros((), bool)
    for k in reversed(range(shift.shape[0])):
        result = (shift[k] < 0) | ((shift[k] == 0) & result)
    return result


def _summable(x: Given, dtype: np.dtype) -> Array:
    if isinstance(x, str | bytes) or callable(x):
        raise TypeError(
            f"fn must return floats or integers, got {type(x).__name__}: return arrays, in a pytree if there are several."
        )
    array = jnp.asarray(x)
    split = jnp.issubdtype(array.dtype, jnp.complexfloating)
    how = "return its real and its imaginary part" if split else "convert it, e.g. with .astype(jnp.int32)"
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise TypeError(f"fn must return floats or integers, got {array.dtype}: {how}.")
    is_loose = jnp.issubdtype(array.dtype, jnp.floating) and jax.typeof(array).weak_type
    return array.astype(dtype if is_loose else array.dtype)


def _mark(leaves: list[Array], good: Array) -> list[Array]:
    """Replace invalid rows by NaN (integers: the smallest one); their derivatives become NaN too.

    Factors are made apart from the sums. So they are known before, and derivatives may be summed together with those.
    """
    dtypes = {np.dtype(x.dtype) for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)}
    return _multiply(leaves, good, {dtype.name: _factors(good, dtype) for dtype in dtypes})


@functools.partial(compile_program, static_argnames=("dtype",))
def _factors(good: Array, dtype: np.dtype) -> Array:
    return jnp.where(good, 1, jnp.nan).astype(dtype)


@compile_program
def _multiply(leaves: list[Array], good: Array, factors: dict[str, Array]) -> list[Array]:
    def spread(x: Array) -> Array:
        return factors[np.dtype(x.dtype).name].reshape(-1, *[1] * (x.ndim - 1))

    return [x * spread(x) if jnp.issubdtype(x.dtype, jnp.floating) else geometry.mark_rows(x, good) for x in leaves]


@functools.partial(compile_program, static_argnames=("are_good", "static"))
def _mark_by(leaves: list[Array], data: tuple, are_good: Callable[..., Array], static: tuple) -> list[Array]:
    return _mark(leaves, are_good(*data, *static))
