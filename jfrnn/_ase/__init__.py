"""What `jfrnn.ase`, `jfrnn.matscipy` and `jfrnn.vesin` consist of."""

from jfrnn._ase.names import name_of_ase
from jfrnn._ase.pairs import check_number, half_of, neighbor_list, primitive_neighbor_list
