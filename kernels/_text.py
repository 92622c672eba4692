"""The native sources in `kernels/native`: C++ (`*.h`) for the CPU and for all devices, CUDA (`*.cuh`).

A source is a header that includes those it needs, by their names, whatever folder of `native` they stand in. `resolve` puts them
together: no compiler looks for files, and the text of a kernel tells all of what it is.
"""

import functools
import re
from collections.abc import Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from types import MappingProxyType

_INCLUDE = re.compile(r'^#include "(.+)"\n', re.MULTILINE)


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
    return native_files()[file].read_text("utf-8")


@functools.cache
def native_files() -> dict[str, Traversable]:
    """Return the files in all folders of `kernels/native`, by their names."""
    folders = [folder for folder in (files("jfrnn.kernels") / "native").iterdir() if folder.is_dir()]
    return {file.name: file for folder in folders for file in folder.iterdir()}
