"""`jfrnn.search` with the backend `brute`: every particle against every other, so only for small scenes."""

from functools import partial

from experiments.methods._padded import prepare_backend, read

__all__ = ["MAX_POINTS", "prepare", "read"]

MAX_POINTS = 20_000
prepare = partial(prepare_backend, backend="brute")
