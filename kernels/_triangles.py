"""The native text of triangles: where a particle and a triangle are decided, and which cell a coordinate is in.

C++17 for a function body, for Clang on the CPU and for NVRTC on CUDA alike, joined by `jfrnn.kernels._native.snippet`; in 2D
"triangles" are segments. What is decided, and why it is right, stands in `jfrnn/_triangles_exact.py` and
`jfrnn/_triangles_integers.py`; which cells hold a triangle, in `jfrnn/_triangles_cells.py`. Here, step 1 works in the precision of
the positions, then in float64, and integers have limbs of 24 bits, only as many as a number needs.
"""

from jfrnn.kernels._text import read_part

# What the integers of a pair are: how many in 2D and in 3D, and products of how many coordinates.
_NUMBERS = {
    "x": (4, 9, 1),
    "along": (2, 3, 1),
    "square": (2, 3, 2),
    "limit": (1, 1, 2),
    "side": (0, 9, 2),
    "normal": (0, 3, 2),
    "place": (1, 1, 3),
    "length": (1, 1, 4),
    "rest": (1, 1, 6),
    "other": (1, 1, 6),
    "spare": (2, 2, 6),
}
_LIMBS = {False: 14, True: 90}  # of a coordinate of either width
_ROOM = "Room left{room};" + "".join(
    f"const Wholes {name} = left.take(DIM == 3 ? {three} : {two}, {degree});" for name, (two, three, degree) in _NUMBERS.items()
)


def constants(dim: int, double: bool, stride: int) -> dict[str, int]:
    """Return the constants that `DECIDE` needs; ROOM is the memory of a pair, in ints, of which threads have every `stride`-th."""
    limbs = _LIMBS[double]
    room = sum((two, three)[dim == 3] * (2 + limbs * degree) for two, three, degree in _NUMBERS.values())
    return {"LIMBS": limbs, "ROOM": room, "STRIDE": stride}


def pending(node: int) -> int:
    """Return how many sets of siblings, `node` at a time, may wait while a tree of at most 2^31 leaves is searched depth first."""
    levels = 1
    while node**levels < 2**31:
        levels += 1
    return (levels - 1) * (node - 1) + 1


# `Shape::sure(p, corners, radius, scale)`: is the distance below the radius? 1: it is, 0: it is not, -1: float64 cannot tell.
# `Shape::near(p, corners, radius, scale, room)` can. p [DIM], corners [DIM][DIM]; room: ROOM ints, each STRIDE behind the last, so
# that threads beside each other use memory side by side.
DECIDE = read_part("triangle_exact.h", "decide").replace("ROOM_OF_NUMBERS", _ROOM)

# Which cell a coordinate is in, and which bucket a cell; a level is the biased exponent of the inverse edge of its cells.
LEVELS = read_part("triangle_cells.h", "levels")

# `bounded(x, near, far)`: step 1 in the precision of the positions, with the bounds of `_triangles_exact.sure_pairs`; what is
# neither is open. x [DIM][DIM]: corners as the particle sees them, times `unit`. `vec` is `real`, or many side by side.
BOUNDS = read_part("triangle_bounds.h", "bounds")
