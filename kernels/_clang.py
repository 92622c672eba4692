"""Clang as Warp ships it, called without importing Warp, which takes as long as all else that a first search does.

Its functions are those that `warp._src.build` and `warp._src.context` call, with the arguments of Warp 1.18 and 1.19.
"""

import ctypes
import functools
import importlib.util
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

_NAMES = {"win32": ("warp.dll", "warp-clang.dll"), "darwin": ("libwarp.dylib", "libwarp-clang.dylib")}
_LINUX = ("warp.so", "warp-clang.so")
_TEXT, _FLAG, _NUMBER = ctypes.c_char_p, ctypes.c_bool, ctypes.c_int
# What Warp compiles kernels with: all instructions of this processor, and functions that are inlined wherever they are called.
OPTIONS = ("-march=native", "-mllvm", "-inline-threshold=9000", "-mllvm", "-inline-cold-callsite-threshold=3000")
OPTIONS += ("-mllvm", "-slp-recursion-max-depth=4")
# Added where no loop over pairs is compiled, which takes a third of the time then. Threads compile beside each other only where the
# options of LLVM (-mllvm) are the same.
APART = ("-fno-inline-functions",)
_COMPILED_WITH = (_TEXT, _TEXT, _TEXT, _TEXT, _FLAG, _FLAG, _FLAG, _FLAG, ctypes.c_void_p, _NUMBER, _FLAG, _FLAG, _TEXT, _NUMBER)


@functools.cache
def warp_root() -> Path:
    """Return the folder of the package Warp.

    Raises:
        ImportError: It is not installed.
    """
    found = importlib.util.find_spec("warp")
    if found is None or found.origin is None or not (Path(found.origin).parent / "config.py").exists():
        raise ImportError("no package warp-lang")
    return Path(found.origin).parent


@functools.cache
def warp_version() -> str:
    """Return the version of Warp, as in "1.19.0"."""
    found = re.search(r'^version: str = "([^"]+)"', (warp_root() / "config.py").read_text("utf-8"), re.MULTILINE)
    return "unknown" if found is None else found[1]


def cache_folder() -> Path:
    """Return the folder in which Warp keeps compiled kernels, as it finds it when it starts."""
    started = sys.modules.get("warp")
    known = None if started is None else started.config.kernel_cache_dir
    if known is not None:
        return Path(known)
    given = os.environ.get("WARP_CACHE_PATH")
    if given is not None:
        return Path(given).resolve() / warp_version()
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home)) / "NVIDIA" / "warp" / "Cache" / warp_version()
    caches = home / "Library" / "Caches" if sys.platform == "darwin" else Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))
    return caches / "warp" / warp_version()


@functools.cache
def core_library() -> ctypes.CDLL:
    """Return the native code of Warp, which is loaded, and of which nothing is started.

    Raises:
        RuntimeError: It cannot be loaded.
    """
    return _load(_NAMES.get(sys.platform, _LINUX)[0])


def _load(name: str) -> ctypes.CDLL:
    folder = warp_root() / "bin"
    if sys.platform == "win32":
        os.add_dll_directory(str(folder))
    try:
        return ctypes.CDLL(str(folder / name), winmode=0)
    except OSError as error:
        raise RuntimeError(f"the compiler that Warp ships cannot be loaded: {error}") from error


@functools.cache
def library() -> ctypes.CDLL:
    """Return Warp's compiler for the CPU, which is loaded.

    Raises:
        RuntimeError: This Warp has none, or it does not start.
    """
    name = _NAMES.get(sys.platform, _LINUX)[1]
    if not (warp_root() / "bin" / name).exists():
        raise RuntimeError("this Warp was built without its CPU compiler")
    core, clang = core_library(), _load(name)
    core.wp_cpu_block_runtime_get_api.restype = ctypes.c_void_p
    clang.wp_compile_cpp.argtypes = _COMPILED_WITH
    clang.wp_load_obj.argtypes = (_TEXT, _TEXT, _FLAG)
    clang.wp_lookup.argtypes, clang.wp_lookup.restype = (_TEXT, _TEXT), ctypes.c_uint64
    clang.wp_unload_obj.argtypes = (_TEXT,)
    clang.wp_llvm_set_cpu_block_runtime.argtypes = (ctypes.c_void_p,)
    if not clang.wp_llvm_set_cpu_block_runtime(core.wp_cpu_block_runtime_get_api()):
        raise RuntimeError("the compiler that Warp ships does not start")
    return clang


def compile_object(text: str, source: Path, target: Path, fused: bool, options: Sequence[str]) -> None:
    """Compile C++ for this processor. Threads may do so beside each other.

    Args:
        text: What is compiled.
        source: Its file, of which messages speak.
        target: The object file that is written.
        fused: Whether products may be contracted with sums.
        options: Those of Clang.

    Raises:
        RuntimeError: It does not compile.
    """
    files = str(source).encode(), str(warp_root() / "native").encode(), str(target).encode()
    flags = (ctypes.c_char_p * (len(options) + 1))(*(option.encode() for option in options), None)
    more = False, False, fused, True, ctypes.addressof(flags), 2, False, False, None, 256
    if library().wp_compile_cpp(text.encode(), *files, *more):
        raise RuntimeError("see what Clang says on standard error")


def load_object(path: Path, handle: str) -> bytes | None:
    """Load an object file by a name of its own; return that name, or None where it cannot be loaded."""
    return None if library().wp_load_obj(str(path).encode(), handle.encode(), False) else handle.encode()


def find_function(handle: bytes, name: str) -> int:
    """Return the address of a function, or 0."""
    return library().wp_lookup(handle, name.encode())


def unload_object(handle: bytes) -> None:
    """Give back the memory of an object file."""
    library().wp_unload_obj(handle)
