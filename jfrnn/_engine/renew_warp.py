"""Lists with a skin: on the CPU, whether one is stale; on CUDA they renew themselves in one call, which tells the host nothing.

There the device decides (`native/launch/launch.h`): kernels say whether a point has moved too far, and what is launched behind
them, a search and what stands around it, runs if one has.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.auto import platform_of
from jfrnn._engine.kept_warp import numbers_of_pairs
from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.near_warp import constants_of_far
from jfrnn._engine.operands import MOST_IN_BOX, describe_call, lattice_numbers
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Inputs, Options
from jfrnn._engine.warp import PLATFORMS, all_meet, plan_few, plan_on_cuda
from jfrnn._geometry import (
    Box,
    Cutoff,
    Status,
    bound_wrapping,
    find_bounding,
    make_cutoff,
    make_lattice,
    sides_of,
)
from jfrnn._tracing import compile_program, portable
from jfrnn.kernels import Kind, cells_cuda, few_cuda, renew

_BITS = {"NOT_FINITE": Status.NONFINITE, "OUT_OF_RANGE": Status.OUT_OF_RANGE, "BOX_TOO_SMALL": Status.BOX_TOO_SMALL}
_KEPT = ("idx", "counts", "status", "required", "rebuild_count", "reference")
_KEPT_OF_BOX = ("kept_vectors", "kept_origin")


class KeptRows(NamedTuple):
    """What a list keeps from step to step.

    Attributes:
        idx, counts: Its rows, [n, capacity] and [n] int32.
        status, required, rebuild_count: [] int32.
        reference: Where points were when it was made [length], [n, d].
        box: The box of that time, or None.
        order: In which sources follow each other in space, [n] int32, or None.
    """

    idx: Array
    counts: Array
    status: Array
    required: Array
    rebuild_count: Array
    reference: Array
    box: Box | None
    order: Array | None


@portable
class BoxNumbers(NamedTuple):
    """What kernels are told of the box of a list, computed once: on a GPU, XLA moves nothing out of a loop.

    Attributes:
        search: What a search is given, [10, 31]: `numbers_of_box`.
        pairs: What tells which slots hold a pair, [31]: `numbers_of_pairs`.
        sides: Lengths of the edges [length], [d], 0 along open axes.
    """

    search: Array
    pairs: Array
    sides: Array


@functools.partial(compile_program, static_argnames="options")
def find_box_numbers(inputs: Inputs, cutoff: np.floating | Array, options: Options) -> BoxNumbers:
    """Return them for such a list as `can_renew` allows, in a box; `cutoff` is that of its pairs, without a skin."""
    if inputs.box is None or options.images is None:
        raise TypeError("this search has no box.")
    lattice = make_lattice(inputs.box, options.images, np.dtype(inputs.sources.dtype))
    return BoxNumbers(numbers_of_box(inputs, options), numbers_of_pairs(cutoff, lattice), sides_of(lattice))


def can_ask(inputs: Inputs, options: Options, skin: float, platform: str) -> bool:
    """Say whether a kernel may tell that a list is stale: of all particles, with one cutoff, in open space or an upright box."""
    images, cutoff = options.images, inputs.cutoff
    plain = options.engine.native and isinstance(cutoff, Cutoff) and not cutoff.scaled
    alone = inputs.queries is None and inputs.active is None
    boxed = images is None or (images.orthogonal and not images.per_system)
    # kernels compare squares of motions as they are: those of a very short skin, or a very long one, are compared in another unit
    moderate = not make_cutoff(skin / 2, np.dtype(inputs.sources.dtype), closed=False).scaled
    here = inputs.sources.shape[0] > 0 and PLATFORMS.get(platform_of(inputs.sources)) == platform
    return plain and moderate and alone and boxed and here


def can_renew(inputs: Inputs, options: Options, skin: float, capacity: int) -> bool:
    """Say whether such a list renews itself, on CUDA: then none of its pairs has several images."""
    images, alone = options.images, inputs.batch is None and inputs.exclude is None
    boxed = images is None or (images.nearest and not images.counts_short)
    return can_ask(inputs, options, skin, "cuda") and alone and boxed and capacity > 0 and inputs.sources.shape[0] < MOST_IN_BOX


def has_moved(inputs: Inputs, options: Options, reference: Array, of_then: Box | None, limit: np.floating | Array) -> Array:
    """Say on the CPU whether any point has moved from its reference by the root of `limit`, or the box is another one, [] bool."""
    now, box, dtype = inputs.sources, inputs.box, np.dtype(inputs.sources.dtype)
    operands = [now, jnp.full(1, limit, dtype), reference]
    if box is not None and of_then is not None and options.images is not None:
        lattice = make_lattice(box, options.images, dtype)
        operands.append(numbers_of_pairs(_one_cutoff(inputs).radius, lattice))
        operands += [jnp.asarray(x, dtype) for x in (box.vectors, box.origin, of_then.vectors, of_then.origin)]
    found, _ = _moved_callable(now.shape[1], dtype == np.float64, box is not None)(*operands, output_dims={"moved": 1, "info": 2})
    return found[0] != 0


@kernel
def _moved_callable(dim: int, double: bool, boxed: bool) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        n, found = shapes["now"][0], renew.moved_kernel(dim, double, boxed, constants_of(double))
        steps = [Clear("moved", 4), Clear("info", 8), share(found, n, renew.POINTS_PER_THREAD)]
        return Plan(steps, {"n": n}, absent=[] if boxed else of_box)

    of_box = ["cutoff", "vectors", "origin", "vectors_of_then", "origin_of_then"]
    given = ("now", "limit", "reference", *(of_box if boxed else ()))
    name = f"jfrnn_moved_{dim}d_{'f64' if double else 'f32'}{'_boxed' * boxed}"
    return Call(name, given, dict.fromkeys(("moved", "info"), np.int32), plan)


def constants_of(double: bool) -> tuple[tuple[str, int], ...]:
    """Return what kernels are told of bits of a status, and of far points, as array programs have it."""
    bits = {f"BIT_{name}": bit.value for name, bit in _BITS.items()}
    return tuple((bits | constants_of_far(double)).items())


def numbers_of_box(inputs: Inputs, options: Options) -> Array:
    """Return what a search in a box is given, and whether pairs have no other images: a row for each of `renew.MOST_TURNS`."""
    box, images, dtype = inputs.box, options.images, np.dtype(inputs.sources.dtype)
    if box is None or images is None:
        raise TypeError("this search has no box.")
    lattice, radius = make_lattice(box, images, dtype), jnp.asarray(_one_cutoff(inputs).radius, dtype)
    known = find_bounding(lattice, radius)

    def row(most: Array) -> Array:
        bounds = bound_wrapping(most, lattice, known)
        whole = bounds.enough.astype(dtype)
        return jnp.concatenate([radius[None], lattice_numbers(lattice, bounds.reach, bounds.slack, most), whole[None]])

    return jax.vmap(row)(jnp.asarray(renew.MOST_TURNS, dtype))


def renew_list(inputs: Inputs, options: Options, kept: KeptRows, limit: np.floating | Array, known: BoxNumbers | None) -> KeptRows:
    """Return a list that holds at these positions: the same one if no point has moved by the root of `limit`, in the same box.

    `known`: the numbers of this box, if they are known.
    """
    now, box, cutoff, ordered = inputs.sources, inputs.box, _one_cutoff(inputs), kept.order is not None
    (n, dim), dtype = now.shape, np.dtype(now.dtype)
    few, blocks = all_meet((n, n), False), renew.blocks(n)
    variant = Kind(
        dim,
        double=dtype == np.float64,
        own=True,
        closed=cutoff.closed,
        drop_self=options.filter.drop_self,
        later=options.filter.later_only,
        lists=True,
        periodic=int(box is not None),
    )
    written: dict[str, Any] = dict(zip(_KEPT, kept[: len(_KEPT)], strict=True))
    made: dict[str, int | tuple[int, ...]] = {}
    operands = [now, jnp.full(1, limit, dtype)]
    if box is None:
        operands.append(jnp.full(1, cutoff.radius, dtype))
    else:
        numbers = numbers_of_box(inputs, options) if known is None else known.search
        operands += [numbers, *(jnp.asarray(x, dtype) for x in (box.vectors, box.origin))]
        written |= dict(zip(_KEPT_OF_BOX, jax.tree.leaves(kept.box), strict=True))
        made = {"positions": (n, dim + 1), "cutoff": numbers.shape[1] - 1}
    written |= {"order": kept.order} if ordered else {}
    words = (few_cuda if few else cells_cuda).scratch_words(n, n, dim, 2 if variant.double else 1, True)
    made |= {"longest": (), "bits": (), "scratch": max(words, 1), "stale": blocks, "parts": (blocks, 2)}
    dims = {name: x.shape for name, x in written.items()} | made
    found = _renew_callable(variant, few, ordered)(*operands, *written.values(), output_dims=dims)
    new = dict(zip(written, found, strict=False))
    leaves = [new[name] for name in _KEPT_OF_BOX if name in new]
    at_that_time = jax.tree.unflatten(jax.tree.structure(kept.box), leaves)
    return KeptRows(**{name: new[name] for name in _KEPT}, box=at_that_time, order=new.get("order"))


def _one_cutoff(inputs: Inputs) -> Cutoff:
    if not isinstance(inputs.cutoff, Cutoff):
        raise TypeError("these lists have one cutoff.")
    return inputs.cutoff


@kernel
def _renew_callable(variant: Kind, few: bool, ordered: bool) -> Call:
    boxed, real = variant.periodic > 0, np.float64 if variant.double else np.float32
    floats = ["reference", *_KEPT_OF_BOX * boxed, *["positions", "cutoff"] * boxed]
    kept = [*_KEPT, *_KEPT_OF_BOX * boxed, *["order"] * ordered]
    results = [*kept, *["positions", "cutoff"] * boxed, "longest", "bits", "scratch", "stale", "parts"]
    given = ["now", "limit", *(["cutoffs", "vectors", "origin"] if boxed else ["cutoff"])]
    before = {name: f"{name} before" for name in kept}
    plan = functools.partial(_plan, variant, few, ordered)
    search = describe_call(f"renew_{'few' if few else 'cells'}{'_ordered' * ordered}", variant, plan)
    types = {name: real if name in floats else np.int32 for name in results}
    return Call(search.name, [*given, *before.values()], types, plan, before)


def _plan(variant: Kind, few: bool, ordered: bool, shapes: Shapes, multiprocessors: int) -> Plan:
    """Return what says whether the list is stale, and what is launched then."""
    n, boxed = shapes["now"][0], variant.periodic > 0
    same = {"count": "counts"} | ({"queries": "positions"} if boxed else {"positions": "now", "queries": "now"})
    search = (plan_few if few else plan_on_cuda)(variant, dict(shapes) | {"positions": (n,), "queries": (n,)}, multiprocessors)
    around = renew.renew_kernels(variant.dim, variant.double, boxed, ordered, constants_of(variant.double))
    blocks = renew.blocks(n)
    threads = blocks * renew.BLOCK
    check, prepare, keep, decide = (Launch(each, threads) for each in (around.check, around.prepare, around.keep, around.decide))
    cleared = [Clear(name, 4) for name in ("longest", "bits")]  # by what settles
    rest = [step for step in search.steps if step not in cleared]
    steps = [check, prepare, Launch(around.settle, renew.BLOCK), *rest, keep]
    numbers = {**search.numbers, "blocks": blocks}
    lacking = [*["order"] * (not ordered), *["cutoffs", "vectors", "origin", *_KEPT_OF_BOX] * (not boxed)]
    return search._replace(
        steps=steps, numbers=numbers, absent=[*search.absent, "condition", *lacking], asked="stale", decide=decide, same=same
    )
