"""`jfrnn.search` with the backend `jax`: a padded full list inside `jax.jit`."""

from functools import partial

from experiments.methods._padded import prepare_backend, read

__all__ = ["prepare", "read"]

prepare = partial(prepare_backend, backend="jax")
