"""Small C++ adapters of libraries that have no Python package: compiled when they are first asked for, called through ctypes."""

import ctypes
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

SOURCES = Path(__file__).parent / "native"
BUILD = Path(__file__).resolve().parent.parent / "build" / "native"
FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC")
PAIRS = (("pairs_size", ctypes.c_int64), ("pairs_data", ctypes.c_void_p), ("pairs_release", None))


def load(name: str, header: str, package: str, libraries: tuple[str, ...] = ()) -> ctypes.CDLL:
    """Return the compiled adapter `native/NAME.cpp`; compiled anew only where its text or the compiler has changed.

    It includes a header, such as ANN/ANN.h, which a package of Debian has, and is linked to libraries. An ImportError says how to
    get the compiler or the library where there is none.
    """
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise ImportError("no C++ compiler: install g++, or name one in the environment variable CXX")
    source = SOURCES / f"{name}.cpp"
    known = hashlib.sha256(source.read_bytes() + _header_state(compiler, header, package)).hexdigest()[:16]
    library = BUILD / f"{name}-{known}.so"
    if not library.exists():
        BUILD.mkdir(parents=True, exist_ok=True)
        partial = library.with_suffix(f".{os.getpid()}.part")
        command = [compiler, *FLAGS, str(source), "-o", str(partial), *(f"-l{each}" for each in libraries)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise ImportError(f"{source.name} cannot be compiled ({package} is what it needs): {done.stderr.strip()[-400:]}")
        partial.replace(library)
    loaded = ctypes.CDLL(str(library))
    for function, result in PAIRS:
        getattr(loaded, function).restype, getattr(loaded, function).argtypes = result, [ctypes.c_void_p]
    return loaded


def _header_state(compiler: str, header: str, package: str) -> bytes:
    """Return what the compiler and the header are; an adapter that was built with another is not taken."""
    command, text = [compiler, "-E", "-M", "-xc++", "-"], f"#include <{header}>"
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ImportError(f"{header} is not installed: apt-get install {package}")
    path = next(part for part in done.stdout.split() if part.endswith(header))
    return f"{compiler} {path} {Path(path).stat().st_mtime_ns}".encode()


class _Owner:
    """Releases the list of an adapter when nothing refers to it any more."""

    def __init__(self, library: ctypes.CDLL, handle: int) -> None:
        self._library, self._handle = library, handle

    def __del__(self) -> None:
        self._library.pairs_release(self._handle)


def take_pairs(library: ctypes.CDLL, handle: int) -> np.ndarray:
    """Return the pairs of an adapter's list without a copy, shape [m, 2], int32; its memory is released with the array."""
    owner, size = _Owner(library, handle), library.pairs_size(handle)
    if size == 0:
        return np.zeros((0, 2), np.int32)
    buffer = (ctypes.c_int32 * (2 * size)).from_address(library.pairs_data(handle))
    buffer._owner = owner  # pyright: ignore[reportAttributeAccessIssue]
    return np.frombuffer(buffer, np.int32).reshape(size, 2)


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """Return where an array is, for a call."""
    return array.ctypes.data_as(ctypes.c_void_p)
