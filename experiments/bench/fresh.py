"""A fresh process for `bench start` and `bench guides`: `python -P fresh.py search|gradient|PAGE.md` prints a line of JSON.

Nothing but the standard library is imported before the clock runs. It asks of the library what every version of it can do.
"""

import json
import math
import re
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

N = 1000
NEIGHBORS = 30


def read_page(page: str) -> None:
    """Print how long a page's Python blocks take one after the other, and what is compiled for them."""
    blocks = re.findall(r"^```python\n(.*?)^```", Path(page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    import jax

    device = jax.block_until_ready(jax.numpy.zeros(1)).device
    compiled: list[float] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            compiled.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    begin = perf_counter()
    exec(compile("\n".join(blocks), page, "exec"), {"__name__": "page"})  # what a reader pastes
    jax.block_until_ready(jax.live_arrays())  # what is left to be done
    told = {"page_s": perf_counter() - begin, "programs": len(compiled), "compile_s": sum(compiled)}
    print(json.dumps({**told, "platform": device.platform, "device": device.device_kind}))


def main(what: str) -> None:
    """Print the seconds of each part, where it ran, and a number that is the same wherever the answer is."""
    ask = {"search": _search, "gradient": _gradient}[what]
    parts, clock = dict[str, Any](), [perf_counter()]

    def end(part: str) -> None:
        clock.append(perf_counter())
        parts[part] = clock[-1] - clock[-2]

    import jax
    import numpy as np

    end("import_jax_s")
    cutoff = (3 * NEIGHBORS / (4 * math.pi * N)) ** (1 / 3)
    some, others = (jax.block_until_ready(jax.numpy.asarray(_points(np, n))) for n in (N, N + 100))
    end("array_s")
    import jfrnn

    end("import_jfrnn_s")
    answer = ask(jax, jfrnn, some, cutoff)
    end("first_s")
    ask(jax, jfrnn, others, cutoff)
    end("again_s")
    device = jax.devices()[0]
    print(json.dumps({**parts, "answer": answer, "platform": device.platform, "device": device.device_kind}))


def _points(np: Any, n: int) -> Any:  # noqa: ANN401
    return np.random.default_rng(n).random((n, 3)).astype(np.float32)


def _search(jax: Any, jfrnn: Any, x: Any, cutoff: float) -> float:  # noqa: ANN401
    del jax
    return float(jfrnn.search(x, cutoff).count.sum())


def _gradient(jax: Any, jfrnn: Any, x: Any, cutoff: float) -> float:  # noqa: ANN401
    def energy(x: Any) -> Any:  # noqa: ANN401
        return jfrnn.pair_sum(lambda r, i, j: jax.numpy.maximum(1 - (r @ r) / cutoff**2, 0) ** 3, x, cutoff).sum()

    value, slope = jax.value_and_grad(energy)(x)
    jax.block_until_ready(slope)
    return float(value)


if __name__ == "__main__":
    (read_page if sys.argv[1].endswith(".md") else main)(sys.argv[1])
