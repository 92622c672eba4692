"""The constants of triangles: how many limbs the integers of a pair have, and how many boxes wait while a tree is searched."""

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


def constants(dim: int, double: bool, stride: int) -> dict[str, int]:
    """Return the constants of `triangle_exact.h`: ROOM is the memory of a pair in ints; threads have every `stride`-th."""
    limbs = _LIMBS[double]
    room = sum((two, three)[dim == 3] * (2 + limbs * degree) for two, three, degree in _NUMBERS.values())
    return {"LIMBS": limbs, "ROOM": room, "STRIDE": stride}


def pending(node: int) -> int:
    """Return how many sets of siblings, `node` at a time, may wait while a tree of at most 2^31 leaves is searched depth first."""
    levels = 1
    while node**levels < 2**31:
        levels += 1
    return (levels - 1) * (node - 1) + 1
