"""A fresh process up to its first results, for `bench start`: `python -P first_result.py search|gradient` prints a line of JSON.

Nothing but the standard library is imported before the clock runs. It asks of the library what every version of it can do.
"""

import json
import math
import sys
from time import perf_counter
from typing import Any

N = 1000
NEIGHBORS = 30


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
    main(sys.argv[1])
