"""Search and pair sums over many devices: the same pairs as on one, exactly, wherever the particles lie.

Particles are spread over a mesh of devices by space, evenly (`scatter`). Each device sees its own and those of others within reach,
its halo, which alone travel; it asks `jfrnn.search` or `jfrnn.pair_sum` about them. Everything runs inside `jax.jit`.
"""

from jfrnn._shards import (
    Halo,
    Neighbors,
    Particles,
    Required,
    Sizes,
    collect,
    connect,
    count,
    halo,
    migrate,
    on_each,
    pair_sum,
    scatter,
    search,
)

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
