"""The native sources in `kernels/native`: C++ (`*.h`) for the CPU and for all devices, CUDA (`*.cuh`).

A source is a header that includes those it needs. `resolve` puts them together: no compiler looks for files, and the text of a
kernel tells all of what it is. Some files hold named parts instead. Each part begins behind a line `// --- part: NAME` and ends
where the next one begins.
"""

import functools
import re
from collections.abc import Mapping
from importlib.resources import files
from types import MappingProxyType

_PART = re.compile(r"^// --- part: (\w+)\n", re.MULTILINE)
_INCLUDE = re.compile(r'^#include "(.+)"\n', re.MULTILINE)


@functools.cache
def read_part(file: str, part: str) -> str:
    """Return a part of a native source."""
    _, *found = _PART.split(_read(file))
    return dict(zip(found[::2], found[1::2], strict=True))[part]


def fill(text: str, **names: str) -> str:
    """Return the text with names replaced."""
    return re.sub("|".join(rf"\b{name}\b" for name in names), lambda match: names[match[0]], text)


def resolve(*headers: str, given: Mapping[str, str] = MappingProxyType({"constants.h": ""})) -> str:
    """Return the text of headers, each behind those that it includes, and each once.

    Args:
        headers: Files of `kernels/native`.
        given: Texts in place of files: of constants, and of what users' functions become.
    """
    seen, texts = set(), []

    def take(header: str) -> None:
        if header in seen:
            return
        seen.add(header)
        text = (given[header] if header in given else _read(header)).replace("#pragma once\n", "", 1)
        for included in _INCLUDE.findall(text):
            take(included)
        texts.append(_INCLUDE.sub("", text))

    for header in headers:
        take(header)
    return "".join(texts)


@functools.cache
def _read(file: str) -> str:
    return (files(__package__) / "native" / file).read_text("utf-8")
