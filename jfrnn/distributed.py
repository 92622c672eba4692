"""Search and pair sums over many devices: the same pairs as on one, exactly, wherever the particles lie.

Particles are spread over a mesh of devices by space, evenly (`scatter`). Each device sees its own and those of others within reach,
its halo, which alone travel; it asks `jfrnn.search` or `jfrnn.pair_sum` about them. Everything runs inside `jax.jit`.
"""

from jfrnn._shards import Particles, Required, Sizes
from jfrnn._shards_calls import halo, on_each
from jfrnn._shards_connect import connect
from jfrnn._shards_halo import Halo
from jfrnn._shards_list import Neighbors
from jfrnn._shards_migrate import migrate
from jfrnn._shards_scatter import collect, scatter
from jfrnn._shards_verbs import count, pair_sum, search

__all__ = [
    "Halo",
    "Neighbors",
    "Particles",
    "Required",
    "Sizes",
    "collect",
    "connect",
    "count",
    "halo",
    "migrate",
    "on_each",
    "pair_sum",
    "scatter",
    "search",
]
