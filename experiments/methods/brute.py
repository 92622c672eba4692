"""`jfrnn.search` with the backend `brute`: every particle against every other, so only for small scenes."""

from experiments.methods._padded import of_backend, read

MAX_POINTS = 20_000
allocate, prepare, plan = of_backend("brute")
