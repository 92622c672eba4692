"""nanoflann's kd-tree in C++, made anew in every step: what `nanoflann-dynamic` is to be compared with."""

from functools import partial

from experiments.methods._nanoflann import STEPS, read
from experiments.methods._nanoflann import follow as follow_tree

follow = partial(follow_tree, dynamic=False)
