"""ANN's kd-tree with a list of unordered pairs, each noted where it is met first, on one thread; distance <= cutoff, float64."""

from functools import partial

from experiments.methods._ann import SANE, read
from experiments.methods._ann import prepare as prepare_tree

prepare = partial(prepare_tree, tree="kd", processing=SANE)
