"""`jfrnn.search` with the backend `warp`: a padded full list inside `jax.jit`, filled by fused kernels."""

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._padded import of_backend, read

allocate, prepare, plan = of_backend("warp", kernels=True)
