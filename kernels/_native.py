"""The native text that every Warp kernel shares: where a pair is decided, which cell a coordinate is in, where scratch lies.

Each piece is C++17 for a function body, for Clang on the CPU and for NVRTC on CUDA alike; `snippet` joins them. Warp gives snippets
no way to call each other, so they share text, which the compiler inlines; and it defines `int` and `float` as macros with an
argument, hence the casts in C's style. `real` is the scalar type of the positions, `DIM` their dimension.

Why no pair is ever outside the cells that are searched: `cell_of` is a monotone function of the coordinate (a rounded product, a
floor, a clamp: each is monotone), and so is rounding. A source within the cutoff r of a query q has x between q - r and q + r; x is
a float, hence also between fl(q - r) and fl(q + r); its cell is therefore between theirs. This needs no bound on rounding errors,
holds far from the origin, and whatever the compiler contracts, as long as every use of `cell_of` is the same code.
"""

from jfrnn.kernels._text import read_part

CELLS_PER_PARTICLE = 4  # size of the cell table; 16 B per particle
SMALLEST_TABLE = 4096


# Where space is periodic, the radius in the array `cutoff` is followed by the lattice: its vectors and the transform,
# row by row (3 x 3 each); origin, half the width of the stencil in units of the transform, images within reach (3 each); slack.
# Where it is skewed, its vectors as they were given follow, and which whole numbers of those the vectors are (3 x 3 each).
# Of a batch, the highest number of a system comes last.


def snippet(scalar: str, dim: int, *pieces: str, **constants: int) -> str:
    """Return a block of native code for a scalar type ("float" or "double"), a dimension and named integer constants.

    The function around it must have the argument `cutoff`, an array of one scalar, and what the pieces need. PERIODIC is 0 in an
    open space, 1 where the nearest image is the only one that can be a neighbor, 2 where images are told apart: `cutoff` then goes
    on with the numbers of the lattice, and a row of positions goes on with its packed turns (see `jfrnn._box`). Where vectors of it
    do not lie along the axes, it is given as two more, and the text finds SKEWED. BATCHED is 1 where a row ends with the number of
    its system (see `jfrnn._batch`). Such integers are the bits of a float, or the value of a double. SUM is 1 where the cutoff of a
    pair is the sum of two numbers. SHIFTED is 0 where all pairs that are decided are those of points as they are, though space is
    periodic.
    """
    lines = [f"using real = {scalar};", f"using whole = {'long long' if scalar == 'double' else 'int'};"]
    lines += [f"constexpr int DIM = {dim};", f"constexpr bool DOUBLE = {int(scalar == 'double')};"]
    constants = {**_DEFAULTS, "SHIFTED": constants.get("PERIODIC", 0), **constants}
    constants["SKEWED"] = constants["PERIODIC"] > SKEWED
    constants |= {name: constants[name] - SKEWED for name in ("PERIODIC", "SHIFTED") if constants[name] > SKEWED}
    lines += [f"constexpr int {name} = {int(value)};" for name, value in constants.items()]
    return "\n".join(["", "{", _NO_CONTRACTION, *lines, _PORTABLE, *pieces, "}", ""])


SKEWED = 2
SPACES = ("", "_nearest", "_images", "_nearest_skewed", "_images_skewed")  # in names of variants
_DEFAULTS = {"PERIODIC": 0, "BATCHED": 0, "SUM": 0}


def table_cells(sources: int) -> int:
    """Return the number of cells in the table for a number of sources."""
    return min(max(SMALLEST_TABLE, CELLS_PER_PARTICLE * sources), 2**30)


# Arithmetic that no compiler contracts or flushes, and bits of floats.
_NO_CONTRACTION = read_part("portable.h", "no_contraction")
_PORTABLE = read_part("portable.h", "portable")

# XLA's threads flush denormals to zero on the CPU: undo that while native code runs. In between, what users compute is flushed, as
# XLA does, and for its speed; what decides about pairs is kept.
KEEP = read_part("float_control.h", "keep")
FLUSH = read_part("float_control.h", "flush")
ENTER = read_part("float_control.h", "enter") + KEEP
LEAVE = read_part("float_control.h", "leave")

# Where a pair is decided. Step 1 belongs to the kernels: working precision and a band of 8 eps around r^2 (4 on the CPU, see
# jfrnn/_exact.py). `Exact::pair` answers for what falls into the band: in twice the precision (float32), then by error-free sums,
# then in integers as wide as the float format. It is a call, not inlined, so that what it needs is not held in registers elsewhere.
EXACT = read_part("exact.h", "exact")

# Which cell a coordinate is in: REACH cells fit into a cutoff along y and z, REACH_X along x. Needs `radius`.
CELLS = read_part("cells.h", "cells")
