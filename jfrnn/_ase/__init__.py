"""What `jfrnn.ase`, `jfrnn.matscipy` and `jfrnn.vesin` consist of."""

from jfrnn._ase.pairs import check_number, half_of, name_of_ase, neighbor_list, primitive_neighbor_list
