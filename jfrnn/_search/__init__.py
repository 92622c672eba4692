"""Searches and counts, the neighbor list, its geometry and its exports."""

from jfrnn._search.chunks import run_chunk
from jfrnn._search.edge_list import EdgeList
from jfrnn._search.edges import flatten
from jfrnn._search.exports import MOST_PAIRS, check_total, saturating_add
from jfrnn._search.geometry import find_ends, kept_list, kept_shifts, lattice_of_rows, norms
from jfrnn._search.neighbor_list import NeighborList
from jfrnn._search.present import MOST_SLOTS, Reverse, Topology
from jfrnn._search.problem import Asked, Problem, check_problem, list_radius, round_capacity
from jfrnn._search.search import count, search, search_edges
from jfrnn._search.verlet import has_moved_too_far
