"""NVRTC, CUDA's compiler, as Warp ships it, called without importing Warp.

Its functions are those that `warp._src.build` and `warp._src.context` call, with the arguments of Warp 1.18 and 1.19.
"""

import ctypes
import functools
from pathlib import Path

from jfrnn.kernels._clang import core_library

_TEXT, _FLAG, _NUMBER, _SIZE = ctypes.c_char_p, ctypes.c_bool, ctypes.c_int, ctypes.c_size_t
_COMPILED_WITH = (_TEXT, _TEXT, _NUMBER, _TEXT, _TEXT, _NUMBER, ctypes.c_void_p, _FLAG, _NUMBER, *[_FLAG] * 7, _TEXT, _TEXT, _SIZE)
_COMPILED_WITH += (ctypes.c_void_p,) * 3


@functools.cache
def _compiler() -> ctypes.CDLL:
    core = core_library()
    core.wp_cuda_compile_program.argtypes, core.wp_cuda_compile_program.restype = _COMPILED_WITH, _SIZE
    core.wp_nvrtc_supported_arch_count.restype = _NUMBER
    return core


@functools.cache
def known_archs() -> tuple[int, ...]:
    """Return the compute capabilities for which it compiles, as in 90, ascending; none where this Warp is without CUDA."""
    count = _compiler().wp_nvrtc_supported_arch_count()
    found = (_NUMBER * count)()
    if count:
        _compiler().wp_nvrtc_supported_archs(found)
    return tuple(sorted(found))


def compile_cuda(text: str, name: str, target: Path, arch: int, fused: bool) -> None:
    """Compile CUDA C++. Threads may do so beside each other.

    Args:
        text: What is compiled.
        name: Of which messages speak.
        target: The file that is written: PTX where its name ends so, else a cubin.
        arch: The compute capability.
        fused: Whether products may be contracted with sums.

    Raises:
        RuntimeError: It does not compile.
    """
    source, called, path = text.encode(), name.encode(), str(target).encode()
    nowhere = str(target.parent).encode()  # a program includes nothing
    # debug, 3: how far it optimizes, verbose, verify_fp, fast_math, fuse_fp, lineinfo, compile_time_trace, precompiled_headers
    options = False, 3, False, False, False, fused, False, False, False
    if _compiler().wp_cuda_compile_program(source, called, arch, b"", nowhere, 0, None, *options, path, None, 0, None, None, None):
        raise RuntimeError("see what NVRTC says on standard error")
