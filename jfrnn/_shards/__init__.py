"""Particles distributed over the devices of a mesh."""

from jfrnn._shards.calls import halo, on_each
from jfrnn._shards.halo import Halo
from jfrnn._shards.migrate import migrate
from jfrnn._shards.particles import Particles, Required, Sizes
from jfrnn._shards.scatter import collect, scatter
from jfrnn._shards.sharded_list import Neighbors
from jfrnn._shards.verbs import connect, count, pair_sum, search
