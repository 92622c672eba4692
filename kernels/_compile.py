"""Programs compiled by the compilers that Warp ships (Clang for the CPU, NVRTC for CUDA), loaded, and kept in a folder.

Files stand in the folder in which Warp keeps kernels, `wp_jfrnn` there, so that `warp.clear_kernel_cache` clears them, too. A file
is named after all that it was made of, and ends with a digest of what stands before: a file that is cut or spoiled, after a full
disk or in a job that was killed, is compiled anew. It is written elsewhere and moved, so that processes do not see each other's
halves.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import platform
import re
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from jfrnn.kernels import _clang, _driver, _jobs, _nvrtc
from jfrnn.kernels._jobs import one_at_a_time
from jfrnn.kernels._program import Program
from jfrnn.kernels._text import resolve

Handle = Any  # of a program that is loaded, by Clang or by CUDA
_FOLDER = "wp_jfrnn"
_END = b"\n//"  # a comment of PTX, and nothing to objects
_DIGEST = 64  # hexadecimal digits
_WITH_CONDITIONS = ".version 8.3"  # the PTX of CUDA 12.3, whose drivers are the first that know conditions of graphs
_ROOM = 1 << 22  # bytes that a compiler may need
_ATTEMPTS = 10
Build = Callable[[Program, Path], Path]
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
notes: list[str] = []  # what users should be warned of, until they are
_left: list[Callable[[], None]] = []  # what unloads programs
_moving = threading.Lock()  # of who finds that programs cannot be kept
_loaded: weakref.WeakValueDictionary[tuple[Program, str], "Library"] = weakref.WeakValueDictionary()


class Library:
    """A program that is loaded on a device; it is unloaded when nothing refers to it any longer."""

    def __init__(self, program: Program, device: str) -> None:
        self._program = program
        self._device = _driver.find_device(int(device.partition(":")[2])) if program.cuda else None
        self._handle = self._load()
        weakref.finalize(self, _unload, self._unloading()).atexit = False  # programs may still run while the interpreter exits

    def address_of(self, function: str) -> int:
        """Return the address of a function on the CPU, or its handle in CUDA.

        Raises:
            RuntimeError: The library does not hold it.
        """
        if self._device is not None:
            found = _driver.find_function(self._handle, function)
        else:
            found = _clang.find_function(self._handle, function)
        if not found:
            raise RuntimeError(f"the compiled program {self._program.name!r} holds no function {function!r}")
        return found

    def _load(self) -> Handle:
        path = find_binary(self._program, self._device)
        found = self._take(path)
        if not found:
            path.unlink(missing_ok=True)
            found = self._take(find_binary(self._program, self._device))
        if not found:
            raise RuntimeError(f"the compiled program {path} cannot be loaded")
        return found

    def _take(self, path: Path) -> Handle:
        if self._device is not None:
            return _driver.load_module(self._device, path.read_bytes()[: -_DIGEST - len(_END)])
        return _clang.load_object(path, f"jfrnn_{id(self)}_{path.stem}")

    def _unloading(self) -> Callable[[], None]:
        if self._device is not None:
            return functools.partial(_driver.unload_module, self._device, self._handle)
        return functools.partial(_clang.unload_object, self._handle)


def load(program: Program, device: str = "cpu") -> Library:
    """Return a program that is loaded on a device; it is compiled where no whole file of it is kept.

    Args:
        program: What is loaded.
        device: As Warp names it.

    Raises:
        RuntimeError: It does not compile, or cannot be loaded.
    """
    with one_at_a_time:
        while _left:
            _left.pop()()
        found = _loaded.get((program, device))
        if found is None:
            found = _loaded[program, device] = Library(program, device)
        return found


def begin(program: Program, device: str = "cpu") -> Future[Path] | None:
    """Let another thread compile a program, beside others, if no whole file of it is kept; return what waits for that, or None.

    Not for a thread that holds `one_at_a_time`. Arguments and errors are those of `load`; the latter come when it is waited for.
    """
    found = _driver.find_device(int(device.partition(":")[2])) if program.cuda else None
    name, build = _name(program, found, None), _builder(program, found, None)
    if _is_whole(kernel_folder() / _FOLDER / name):
        return None
    with contextlib.suppress(RuntimeError):  # the job meets it again
        _find_folder()  # in the thread of who asks, whom the warning names
    return _jobs.begin((kernel_folder(), name), functools.partial(_make, program, build, name))


def can_compile() -> bool:
    """Say whether there is a compiler for the CPU, and room for it."""
    try:
        _clang.library()
        with _new_folder(kernel_folder()):
            return True
    except (OSError, RuntimeError):
        return False


def kernel_folder() -> Path:
    """Return the folder in which programs are kept, and in which Warp may keep its own."""
    return _folders()[-1]


def keeps_no_programs() -> bool:
    """Say whether programs are kept for this process alone, since their folder could not be written."""
    return len(_folders()) > 1


@functools.cache
def _folders() -> list[Path]:
    """Return where programs are kept, in a list of which the last one counts."""
    return [_clang.cache_folder()]


def write_launcher(header: str, file: str = "launch.h") -> str:
    """Return the text of the program that stands between XLA and all kernels (`native/launch/launch.h`), or of a file of it.

    Args:
        header: That of XLA's foreign function interface (`xla/ffi/api/c_api.h`).
        file: A file of `kernels/native`.
    """
    interface = _TYPES + re.sub(r"^#include <.*>\n", "", header, flags=re.MULTILINE)
    return resolve(file, given={"xla_ffi.h": interface})


def launcher(header: str) -> Program:
    """Return the program, with the functions `open_desk`, `answer_on_cpu`, `answer_on_cuda`, `keep_plan` and `drop_plan`."""
    return Program("launch", write_launcher(header), cuda=False, inlined=False)  # it has no loop over pairs, and is waited for


def find_binary(program: Program, device: _driver.CudaDevice | None = None, arch: int | None = None) -> Path:
    """Return a file that holds the compiled program, whole.

    Args:
        program: What is compiled.
        device: For CUDA, a device.
        arch: The architecture in place of a device, as in 90; then PTX is made.
    """
    name = _name(program, device, arch)
    kept = kernel_folder() / _FOLDER / name
    return kept if _is_whole(kept) else _make(program, _builder(program, device, arch), name)


def _name(program: Program, device: _driver.CudaDevice | None, arch: int | None) -> str:
    """Return the name of the file of a program."""
    target = _target(program, device, arch)
    key = hashlib.sha256("\0".join((*map(str, program), *target, _clang.warp_version())).encode()).hexdigest()[:20]
    return f"{program.name[:80]}_{key}{target[0]}"


def _builder(program: Program, device: _driver.CudaDevice | None, arch: int | None) -> Build:
    """Return what compiles a program to a file beside its source."""
    if program.cuda:
        return functools.partial(_build_cuda, device, arch)
    return functools.partial(_build_object, _options(program))


def _options(program: Program) -> tuple[str, ...]:
    """Return the options of Clang for a program."""
    return _clang.OPTIONS if program.inlined else (*_clang.OPTIONS, *_clang.APART)


def _make(program: Program, build: Build, name: str) -> Path:
    """Compile a program to a file that is kept, or where none can be, in a temporary folder."""
    try:
        return _compile(program, build, kernel_folder() / _FOLDER / name)
    except OSError:
        _move()
        return _compile(program, build, kernel_folder() / _FOLDER / name)


def _find_folder() -> None:
    """Move to a temporary folder where files cannot be kept."""
    try:
        _check_folder(kernel_folder() / _FOLDER)
    except OSError:
        _move()


def _check_folder(folder: Path) -> None:
    """Raise an OSError where no files can be written."""
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()


def _move() -> None:
    """Let programs be kept for this process alone, and users be warned of it.

    Raises:
        RuntimeError: There is no folder that can be written.
    """
    with _moving:
        if not keeps_no_programs():
            notes.append(temporary_folder())


def temporary_folder() -> str:
    """Let kernels be compiled into a folder that is removed when the process ends; return what users should know.

    Raises:
        RuntimeError: There is none that can be written.
    """
    place = f"the folder in which Warp keeps compiled kernels, {_folders()[0]},"
    hint = "Set the environment variable WARP_CACHE_PATH to a folder that can be written"
    try:
        folder = tempfile.mkdtemp(prefix="jfrnn-warp-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _check_room(Path(folder))
    except OSError as error:
        raise RuntimeError(f"{place} cannot be written, nor is there a temporary one ({error}). {hint}.") from error
    _folders().append(Path(folder))
    return f"{place} cannot be written: kernels are compiled into {folder} for this process alone. {hint} to keep them."


def _target(program: Program, device: _driver.CudaDevice | None, arch: int | None) -> tuple[str, str]:
    """Return the kind of file, and what it runs on: objects use all instructions of the processor that compiles them."""
    if not program.cuda:
        return ".o", " ".join((*_options(program), _processor()))
    if arch is not None:
        return ".ptx", str(arch)
    assert device is not None
    return ".cuda", f"{device.arch} {_driver.version()}"


@functools.cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.machine())


def _build_object(options: Sequence[str], program: Program, source: Path) -> Path:
    binary = source.with_suffix(".o")
    _clang.compile_object(program.text, source, binary, program.fused, options)
    return binary


def _build_cuda(device: _driver.CudaDevice | None, arch: int | None, program: Program, source: Path) -> Path:
    """Compile for a device, to PTX if NVRTC does not know it yet; or to PTX for an architecture in its place."""
    if program.linked:
        return _build_linked(program, source)
    known, asked = _nvrtc.known_archs(), device.arch if arch is None and device is not None else arch or 0
    fitting = [each for each in known if each <= asked]
    if not fitting:
        raise RuntimeError(f"the compiler that Warp ships knows the compute capabilities {list(known)}, none of which fits {asked}")
    binary = source.with_suffix(".cubin" if arch is None and fitting[-1] == asked else ".ptx")
    _nvrtc.compile_cuda(program.text, source.name, binary, fitting[-1], program.fused)
    return binary


def _build_linked(program: Program, source: Path) -> Path:
    """Compile to PTX of any device. Drivers link it that are older than the compiler, if it names a version that they know."""
    binary = source.with_suffix(".ptx")
    _nvrtc.compile_cuda(program.text, source.name, binary, _nvrtc.known_archs()[0], program.fused)
    binary.write_text(re.sub(r"^\.version .*$", _WITH_CONDITIONS, binary.read_text("utf-8"), count=1, flags=re.MULTILINE), "utf-8")
    return binary


def _compile(program: Program, build: Build, path: Path) -> Path:
    """Compile a program to a file.

    Raises:
        OSError: It cannot be written.
        RuntimeError: It does not compile.
    """
    _check_folder(path.parent)  # before the compiler has worked for nothing
    with _new_folder(path.parent) as folder:
        source = folder / f"program.{'cu' if program.cuda else 'cpp'}"
        source.write_text(program.text, "utf-8")
        try:
            binary = build(program, source)
        except Exception as error:
            _check_room(folder)
            raise RuntimeError(f"the program {program.name!r} does not compile: {error}") from error
        whole = binary.read_bytes()
        if not whole:
            raise OSError(f"{binary} is empty")
    _put(path, whole + _END + hashlib.sha256(whole).hexdigest().encode())
    return path


@contextlib.contextmanager
def _new_folder(place: Path) -> Iterator[Path]:
    """Make a folder for a compiler, which is gone afterwards.

    Clang ends the process where it cannot write. So there is room, and the folder is none in which others clear kernels, unless
    there is no other.
    """
    for parent in (None, place):
        folder = None
        try:
            folder = Path(tempfile.mkdtemp(prefix="jfrnn-", dir=parent))
            _check_room(folder)
            break
        except OSError:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            if parent is not None:
                raise
    assert folder is not None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check_room(folder: Path) -> None:
    """Raise an OSError where a compiler has no room."""
    (folder / "room").write_bytes(bytes(_ROOM))
    (folder / "room").unlink()


def _put(path: Path, data: bytes) -> None:
    """Write a file that others see as a whole, into a folder that others may clear."""
    part = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}")
    for attempt in range(_ATTEMPTS):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(data)
            part.replace(path)
            return
        except FileNotFoundError:
            if attempt == _ATTEMPTS - 1:
                raise
        except OSError:
            part.unlink(missing_ok=True)
            if _is_whole(path):  # another process was first, and has it open, which Windows does not let go
                return
            raise


def _is_whole(path: Path) -> bool:
    try:
        data = path.read_bytes()
    except OSError:
        return False
    body, digest = data[: -_DIGEST - len(_END)], data[-_DIGEST:]
    return hashlib.sha256(body).hexdigest().encode() == digest


def _unload(work: Callable[[], None]) -> None:
    """Unload a program, or leave that to the next who loads one.

    Python gives programs back at any time, also in a thread for which the holder of the lock waits.
    """
    if one_at_a_time.acquire(blocking=False):
        try:
            work()
        finally:
            one_at_a_time.release()
    else:
        _left.append(work)
