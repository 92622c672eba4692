"""nanoflann's dynamic index in C++: every particle is taken out and put in again where it has moved to."""

from functools import partial

from experiments.methods._nanoflann import STEPS, read
from experiments.methods._nanoflann import follow as follow_tree

follow = partial(follow_tree, dynamic=True)
