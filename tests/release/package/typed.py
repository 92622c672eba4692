"""What types have to accept and to tell: `pyright` reads this file, nothing runs it."""
# pyright: reportUnnecessaryTypeIgnoreComment=true

from typing import assert_type

import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn

points, one, three = np.zeros((4, 3), np.float32), np.float32(1), np.int64(3)
nbrs = jfrnn.search(points, one, skin=one, slack=np.float64(1.5), capacity=three, half=np.bool_(True), radius_rule="either")
nbrs = nbrs.update(points).grow(points, slack=one)
assert_type(nbrs, jfrnn.NeighborList)
jfrnn.run_chunk(lambda state, nbrs: (state, nbrs), points, nbrs, lambda state: state, cutoff=lambda state: np.ones(4))
jfrnn.search([[0.0, 1.0], [2, 3]], 1, exclude=[[0, 1]], batch=[0, 1], active=[True, False], backend="warp")
jfrnn.search(points, np.ones(4), queries=jnp.zeros((2, 3)), radius_rule="scatter")
jfrnn.search(points, [1.0, 2, 3, 4])
jfrnn.search(points, ([1.0, 2, 3, 4], np.ones(2)), queries=points[:2], radius_rule="sum")
jfrnn.search(points, jnp.ones((2, 2)), species=np.zeros(4, int))
jfrnn.search(points, 1, backend="wrap")  # pyright: ignore[reportArgumentType]
jfrnn.search(points, 1, radius_rule="gathers")  # pyright: ignore[reportArgumentType]
assert_type(jfrnn.pair_sum(lambda r, i, j: r @ r, points, one, {"m": np.ones(4)}), Array)
assert_type(jfrnn.pair_sum(lambda r, i, j: (r, r @ r), points, None, neighbors=nbrs), tuple[Array, Array])
jfrnn.pair_sum(lambda r, i, j: r, points, 1, reduce="mean")  # pyright: ignore[reportArgumentType]
jfrnn.count(points, one, closed=True)
jfrnn.memory_plan(three, one, capacity=three)
jfrnn.search_triangles(points, points, [[0, 1, 2]], one)
jfrnn.sort_order(points, one, curve="row")
jfrnn.Box([1.0, 1.0, 1.0], periodic=[True, False, True])
jfrnn.distributed.search(jfrnn.distributed.scatter(points, one, mesh=None), 1)  # pyright: ignore[reportArgumentType]
print(jfrnn.serach)  # pyright: ignore[reportAttributeAccessIssue]
