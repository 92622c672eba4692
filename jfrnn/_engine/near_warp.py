"""Particles brought near a periodic box by a kernel, in the rows that kernels of cells read."""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.kept_warp import numbers_of_pairs
from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import as_integer, scalar_of
from jfrnn._engine.plans import Clear, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import Inputs, Options, Search, bits_of, prepare_search
from jfrnn._geometry import FAR, FAR_BITS, FAR_STEP, LARGEST_TURN, NOT_FINITE, TOO_FAR, Lattice, NearRows
from jfrnn._tracing import compile_program, on_platform
from jfrnn.kernels import Kind, near

_FAR = {"FAR": FAR, "FAR_STEP": FAR_STEP, "LARGEST_TURN": LARGEST_TURN, "MET_NOT_FINITE": NOT_FINITE, "MET_TOO_FAR": TOO_FAR}


def constants_of_far(double: bool) -> dict[str, int]:
    """Return what kernels are told of far points, as array programs have it."""
    return _FAR | {"FAR_MOST": 1 << FAR_BITS[8 if double else 4]}


def prepare_for_kernels(inputs: Inputs, options: Options) -> Search:
    """Prepare the operands of a search, particles in a box by a kernel if its engine has some."""
    return prepare_search(inputs, options, _bring if options.engine.native else None)


@functools.partial(compile_program, static_argnames="options")
def find_bits(inputs: Inputs, options: Options) -> Array:
    """Find the bits of `Status` that particles, cutoffs and box set, except that for positions that are not finite; [] int32."""
    return bits_of(prepare_for_kernels(inputs, options).checks)


def _bring(points: Array, lattice: Lattice) -> NearRows:
    """Bring points [n, d] near the box of a lattice."""
    (n, dim), double, skewed = points.shape, points.dtype == jnp.float64, not lattice.images.orthogonal

    def on(cuda: bool) -> Callable[[Array, Array], list[Array]]:
        dims = {"rows": (n, dim + 1), "met": 2, "info": 2}
        return lambda *given: _callable(dim, double, skewed, cuda)(*given, output_dims=dims)[:2]

    rows, met = on_platform(points, numbers_of_pairs(np.float64(0), lattice), cpu=on(False), cuda=on(True))
    return NearRows(rows, rows[:, :dim], as_integer(rows[:, dim]), jnp.bitwise_or(met[0], met[1]))


@kernel
def _callable(dim: int, double: bool, skewed: bool, cuda: bool) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        n, found = shapes["points"][0], near.near_kernel(dim, double, skewed, tuple(constants_of_far(double).items()), cuda)
        if cuda:
            return Plan([Clear("met", 8), Launch(found, near.threads(n, multiprocessors))], {"n": n})
        pages = ask_for_huge_pages("rows", (8 if double else 4) * n * (dim + 1))
        return Plan([Clear("met", 8), Clear("info", 8), *pages, share(found, n, near.POINTS_AT_ONCE)], {"n": n})

    name = f"jfrnn_near_{'cuda' if cuda else 'cpu'}_{dim}d_{'f64' if double else 'f32'}{'_skewed' * skewed}"
    results = {"rows": scalar_of(Kind(dim, double)), "met": np.int32, "info": np.int32}
    return Call(name, ("points", "cutoff"), results, plan)
