"""The neighbor lists of jax-md, found by jfrnn: `partition.neighbor_list` and `custom_partition.neighbor_list_multi_image`.

The functions take the arguments of jax-md's and return what its energies, `smap` and simulations read. Where jax-md is installed,
lists, formats and errors are of its own types, and every other name of its two modules is found here, too: it is jax-md's.

>>> import jax.numpy as jnp
>>> from jfrnn import jax_md
>>> fns = jax_md.neighbor_list(lambda a, b, **_: a - b, 10.0, 1.5)
>>> nbrs = fns.allocate(jnp.array([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0]]))
>>> nbrs.idx.tolist(), bool(nbrs.update(jnp.zeros((3, 2))).did_buffer_overflow)
([[1], [0], [3]], True)
"""

from typing import Any

from jfrnn._jax_md import Dense, NeighborListFormat, OrderedSparse, Sparse, name_of_jax_md, neighbor_list, neighbor_list_multi_image

__all__ = ["Dense", "NeighborListFormat", "OrderedSparse", "Sparse", "neighbor_list", "neighbor_list_multi_image"]


def __getattr__(name: str) -> Any:  # noqa: ANN401
    return name_of_jax_md(name)
