"""`jfrnn.search` with the backend `jax`: a padded full list inside `jax.jit`."""

from experiments.methods._padded import of_backend, read

allocate, prepare, plan = of_backend("jax")
