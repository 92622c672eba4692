"""Where the time of a program goes on the devices that run it, by JAX's profiler."""

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax


class Busy(NamedTuple):
    """One device during one run.

    Attributes:
        span_s: From its first kernel to the end of its last one [s].
        busy_s: Of this, while at least one kernel or copy is at work [s].
        kernels: What ran longest, by name: seconds in all, most first.
    """

    span_s: float
    busy_s: float
    kernels: dict[str, float]


def of_run(run: Callable[[], Any], most: int = 20) -> list[Busy]:
    """Trace a run that is compiled already; return what each GPU did, the `most` longest kernels of it. On a CPU: nothing."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(run())
        traces = sorted(Path(folder).rglob("*.xplane.pb"))
        planes = [plane for trace in traces for plane in jax.profiler.ProfileData.from_file(str(trace)).planes]
        return [busy for plane in planes if "GPU" in plane.name for busy in _busy(plane, most)]


def _busy(plane: Any, most: int) -> Iterator[Busy]:  # noqa: ANN401
    events = [event for line in plane.lines if line.name.startswith("Stream") for event in line.events]
    if not events:
        return
    kernels = Counter[str]()
    spans = sorted((event.start_ns, event.start_ns + event.duration_ns) for event in events)
    busy, end = 0.0, spans[0][0]
    for start, stop in spans:
        busy += max(0, stop - max(start, end))
        end = max(end, stop)
    for event in events:
        kernels[event.name[:80]] += event.duration_ns
    yield Busy(1e-9 * (end - spans[0][0]), 1e-9 * busy, {name: 1e-9 * ns for name, ns in kernels.most_common(most)})
