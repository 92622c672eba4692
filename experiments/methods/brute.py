"""`jfrnn.search` with the backend `brute`: every particle against every other, so only for small scenes."""

from functools import partial

from experiments.methods._padded import allocate_backend, plan_backend, prepare_backend, read

MAX_POINTS = 20_000
allocate = partial(allocate_backend, backend="brute")
prepare = partial(prepare_backend, backend="brute")
plan = partial(plan_backend, backend="brute")
