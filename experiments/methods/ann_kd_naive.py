"""ANN's kd-tree with the list of the thesis: each pair is looked for in all the pairs so far, which is quadratic in their number.

The thesis does not give its code. On all six scenes its t_processing is 5e-10 to 8e-10 s times the square of the number of pairs:
a linear search through the list. Hours on the larger scenes: `configs/thesis_naive.toml`.
"""

from functools import partial

from experiments.methods._ann import NAIVE, read
from experiments.methods._ann import prepare as prepare_tree

MAX_POINTS = 40_000
prepare = partial(prepare_tree, tree="kd", processing=NAIVE)
