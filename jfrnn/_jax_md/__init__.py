"""What `jfrnn.jax_md` consists of."""

from jfrnn._jax_md.images import neighbor_list_multi_image
from jfrnn._jax_md.nearest import neighbor_list
from jfrnn._jax_md.spaces import Dense, NeighborListFormat, OrderedSparse, Sparse, name_of_jax_md
