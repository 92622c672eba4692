"""ANN's kd-tree without a list: neighbors are counted and fetched, as in the thesis's ANN-NL; distance <= cutoff, float64."""

from functools import partial

from experiments.methods._ann import NO_LIST
from experiments.methods._ann import prepare as prepare_tree
from experiments.methods._ann import read_counts as read

prepare = partial(prepare_tree, tree="kd", processing=NO_LIST)
