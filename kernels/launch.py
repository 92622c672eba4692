"""The program that stands between XLA and all kernels (`native/launch/launch.h`), which Clang compiles like those for the CPU."""

import re

from jfrnn.kernels._program import Program
from jfrnn.kernels._text import resolve

# What C's own headers give to that of XLA.
_TYPES = """typedef __SIZE_TYPE__ size_t;
typedef __INT8_TYPE__ int8_t;
typedef __INT32_TYPE__ int32_t;
typedef __INT64_TYPE__ int64_t;
typedef __UINT8_TYPE__ uint8_t;
typedef __UINT32_TYPE__ uint32_t;
typedef __UINT64_TYPE__ uint64_t;
#define offsetof(type, member) __builtin_offsetof(type, member)
"""


def write_launcher(header: str, file: str = "launch.h") -> str:
    """Return the text of the program, or of a file of it.

    Args:
        header: That of XLA's foreign function interface (`xla/ffi/api/c_api.h`).
        file: A file of `kernels/native`.
    """
    interface = _TYPES + re.sub(r"^#include <.*>\n", "", header, flags=re.MULTILINE)
    return resolve(file, given={"xla_ffi.h": interface})


def launcher(header: str) -> Program:
    """Return the program, with the functions `open_desk`, `answer_on_cpu`, `answer_on_cuda`, `keep_plan` and `drop_plan`."""
    return Program(
        "launch", write_launcher(header), cuda=False, inlined=False
    )  # everybody waits for it, and it has no loop over pairs
