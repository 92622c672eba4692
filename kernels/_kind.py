"""What is static about a search or a sum: one value, from which names of programs and their constants follow.

To add an option, add a field and, if native code reads it, a constant. Whoever makes a kind of a search (`kind_of_search` in
`jfrnn/_engine/variants.py`) sets the field.
"""

from typing import NamedTuple

RULES = ("gather", "scatter", "either", "both", "mean", "table")  # by which the cutoff of a pair follows from both, in native order
SKEWED = 2
OWN_BOXES = 2
_TOLD = ("own", "closed", "drop_self")  # numbers that kernels are given when they run: programs do not depend on them
_WORDS = {  # of options that have more values than two
    "periodic": ("", "nearest", "images", "nearest_skewed", "images_skewed"),
    "batched": ("", "batched", "boxes"),
    "excluding": ("", "excluding", "excludingimages"),
    "drop_self": ("", "dropself"),
    "lists": ("", "list"),
}


class Kind(NamedTuple):
    """All that is static about a search or a sum by kernels, apart from shapes and the text of a term.

    Attributes:
        dim: Dimension of the positions.
        double: Whether they are float64.
        scaled: Whether squares of cutoffs need a unit: these are very small or very large, or differ.
        own: Whether the queries are the sources.
        closed: Whether a pair may be as far apart as the cutoff.
        drop_self: Whether a particle is left out of its own row.
        later: Whether only pairs with a later source are listed, as in half lists.
        lists: Whether rows are written, not only their counts.
        flat: Whether rows follow each other without gaps.
        periodic: 0 in an open space, 1 where the nearest image is the only one that can be a neighbor, 2 where images are told
            apart, and SKEWED more where vectors of the lattice do not lie along the axes.
        batched: 1 where a particle knows its system, OWN_BOXES where each system has a box of its own.
        excluding: 1 where queries exclude sources, 2 where they exclude images of sources.
        rule: One of `RULES`, "" where all pairs have one cutoff.
        tree: Whether sources stand in the tree of `jfrnn.kernels.tree_cuda`; on the CPU `rule` alone says so.
        compensated: Whether rounding errors of sums are added up, too.
        extremes: Whether the largest summands are found in place of sums.
    """

    dim: int
    double: bool
    scaled: bool = False
    own: bool = False
    closed: bool = False
    drop_self: bool = False
    later: bool = False
    lists: bool = False
    flat: bool = False
    periodic: int = 0
    batched: int = 0
    excluding: int = 0
    rule: str = ""
    tree: bool = False
    compensated: bool = False
    extremes: bool = False

    @property
    def name(self) -> str:
        """The words of the options that are chosen: it tells this kind from all others."""
        values = zip(self._fields[2:], self[2:], strict=True)
        chosen = [value if isinstance(value, str) else _WORDS.get(field, ("", field))[value] for field, value in values if value]
        return "_".join([f"{self.dim}d", "f64" if self.double else "f32", *chosen])

    def compiled(self, *without: str) -> "Kind":
        """Return what of this kind a program depends on: nothing that kernels are told when they run, nor options `without`."""
        return self._replace(**dict.fromkeys((*_TOLD, *without), 0))

    def only(self, *options: str) -> "Kind":
        """Return the kind of this dimension and dtype with some of its options."""
        return Kind(self.dim, self.double, **{option: getattr(self, option) for option in options})

    def constants(self) -> dict[str, int]:
        """Return what native code calls the options that every program can read."""
        return {
            "PERIODIC": self.periodic,
            "BATCHED": self.batched > 0,
            "SUM": self.rule == "mean",
            "SCALED": self.scaled,
            "EXCLUDING": self.excluding,
            "FLAT": self.flat,
            "RULE": RULES.index(self.rule) if self.rule else -1,
            "BOXES": self.batched == OWN_BOXES,
            "TREE": self.tree,
        }
