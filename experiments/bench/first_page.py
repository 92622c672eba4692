"""A fresh process through the code of a page: `python -P first_page.py PAGE.md` prints a line of JSON.

Nothing but the standard library is imported before the clock runs.
"""

import json
import re
import sys
from pathlib import Path
from time import perf_counter


def main(page: str) -> None:
    """Print how long the page's Python blocks take one after the other, and what is compiled for them."""
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
    seconds = perf_counter() - begin
    told = {"page_s": seconds, "programs": len(compiled), "compile_s": sum(compiled)}
    print(json.dumps({**told, "platform": device.platform, "device": device.device_kind}))


if __name__ == "__main__":
    main(sys.argv[1])
