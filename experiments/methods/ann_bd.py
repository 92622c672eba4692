"""ANN's bd-tree, whose boxes shrink around clusters, with a list of unordered pairs; distance <= cutoff, float64."""

from functools import partial

from experiments.methods._ann import SANE, read
from experiments.methods._ann import prepare as prepare_tree

prepare = partial(prepare_tree, tree="bd", processing=SANE)
