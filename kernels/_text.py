"""The native sources in `kernels/native`: C++ (`*.h`) for the CPU and for all devices, CUDA (`*.cuh`).

A file holds named parts. Each begins behind a line `// --- part: NAME` and ends where the next one begins.
"""

import functools
import re
from importlib.resources import files

_PART = re.compile(r"^// --- part: (\w+)\n", re.MULTILINE)


@functools.cache
def read_part(file: str, part: str) -> str:
    """Return a part of a native source."""
    return _parts(file)[part]


@functools.cache
def _parts(file: str) -> dict[str, str]:
    _, *found = _PART.split((files(__package__) / "native" / file).read_text("utf-8"))
    return dict(zip(found[::2], found[1::2], strict=True))
