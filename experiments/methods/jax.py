"""`jfrnn.search` with the backend `jax`: a padded full list inside `jax.jit`."""

from functools import partial

from experiments.methods._padded import allocate_backend, plan_backend, prepare_backend, read

allocate = partial(allocate_backend, backend="jax")
prepare = partial(prepare_backend, backend="jax")
plan = partial(plan_backend, backend="jax")
