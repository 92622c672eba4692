"""nanoflann's kd-tree in C++ with a list of unordered pairs, float64, one thread: without what a Python package costs."""

from experiments.methods._nanoflann import prepare
from experiments.methods._pairs import read_pairs as read
