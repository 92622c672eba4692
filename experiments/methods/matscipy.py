"""matscipy: a cell list in C with all ordered pairs, float64."""

from functools import partial

from matscipy.neighbours import neighbour_list  # pyright: ignore[reportMissingImports]

from experiments.methods._pairs import prepare_matscipy
from experiments.methods._pairs import read_ordered as read

PACKAGES = ("matscipy",)
prepare = partial(prepare_matscipy, neighbour_list)
