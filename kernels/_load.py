"""Kernels from Warp's cache where its files are whole; compiled anew where they are not, elsewhere where it cannot be written.

A full disk or a job that was killed leaves files that are cut or empty. Warp takes what is there: it fails at the text, and the
linker ends the process at the binary. So digests of the files are kept beside them, and files without one are looked at.
"""

import atexit
import hashlib
import json
import shutil
import tempfile
import warnings
from glob import escape
from pathlib import Path
from typing import Any

import warp as wp

_DIGESTS = "jfrnn.json"
_READ = (".meta", ".o", ".ptx", ".cubin")  # kinds of files that are read again
_ROOM = 1 << 22  # bytes that a module may take while it is compiled


def load_module(module: Any, device: Any, block_dim: int | None = None) -> None:
    """Load a module on a device, and compile it where the cache does not hold it whole.

    Raises:
        RuntimeError: It was compiled and still cannot be loaded.
    """
    wp.init()
    _drop_broken(module)
    if not _folders(module) and not _has_room(Path(wp.config.kernel_cache_dir)):
        _compile_elsewhere()
    try:
        wp.load_module(module, device=device, block_dim=block_dim)
    except Exception as error:
        if not _is_of_files(error):
            raise
        _load_again(module, device, block_dim, error)
    for folder in _folders(module):
        _keep_digests(folder)


def temporary_folder() -> str:
    """Let kernels be compiled into a folder that is removed when the process ends; return what users should know.

    Raises:
        RuntimeError: There is none that can be written.
    """
    before = wp.config.kernel_cache_dir
    place = "the folder in which Warp keeps compiled kernels" + (f", {before}," if before else "")
    hint = "Set the environment variable WARP_CACHE_PATH to a folder that can be written"
    try:
        folder = tempfile.mkdtemp(prefix="jfrnn-warp-")
    except OSError as error:
        raise RuntimeError(f"{place} cannot be written, nor is there a temporary one ({error}). {hint}.") from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if not _has_room(Path(folder)):
        raise RuntimeError(f"{place} cannot be written, nor can {folder}. {hint}.")
    wp.config.kernel_cache_dir = folder
    return f"{place} cannot be written: kernels are compiled into {folder} for this process alone. {hint} to keep them."


def _compile_elsewhere() -> None:
    warnings.warn(temporary_folder(), RuntimeWarning, stacklevel=2)


def _load_again(module: Any, device: Any, block_dim: int | None, error: Exception) -> None:
    for folder in _folders(module):
        shutil.rmtree(folder, ignore_errors=True)
    if not _has_room(Path(wp.config.kernel_cache_dir)):
        _compile_elsewhere()
    module.mark_modified()  # else it remembers that it could not be built
    try:
        wp.load_module(module, device=device, block_dim=block_dim)
    except Exception as again:
        where = f"the kernels {module.name!r} cannot be loaded from {wp.config.kernel_cache_dir}"
        hint = "Remove that folder, or set the environment variable WARP_CACHE_PATH to another one."
        raise RuntimeError(f"{where}: {error}; compiled anew: {again}. {hint}") from again


def _is_of_files(error: Exception) -> bool:
    return isinstance(error, OSError | ValueError) or str(error).startswith("Failed to load")


def _folders(module: Any) -> list[Path]:
    return [path for path in Path(wp.config.kernel_cache_dir).glob(f"wp_{escape(module.name)}_???????") if path.is_dir()]


def _has_room(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder) as stream:
            stream.write(bytes(_ROOM))
    except OSError:
        return False
    return True


def _drop_broken(module: Any) -> None:
    for folder in _folders(module):
        known = _digests(folder)
        if not all(_is_whole(path, known.get(path.name)) for path in _files(folder)):
            shutil.rmtree(folder, ignore_errors=True)


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix in _READ]


def _digests(folder: Path) -> dict[str, str]:
    try:
        known = json.loads((folder / _DIGESTS).read_bytes())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _keep_digests(folder: Path) -> None:
    """Write down what the files of a folder are, where that is not known; another process may do the same."""
    try:
        found = {path.name: _digest(path.read_bytes()) for path in _files(folder)}
        if found == _digests(folder):
            return
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as stream:
            json.dump(found, stream)
        Path(stream.name).replace(folder / _DIGESTS)
    except OSError:  # a cache that can only be read
        return


def _is_whole(path: Path, known: str | None) -> bool:
    try:
        data = path.read_bytes()
    except OSError:  # another process has just replaced it
        return True
    if known is not None:
        return _digest(data) == known
    if path.suffix == ".meta":
        return _is_json(data)
    if data.startswith(b"\x7fELF"):
        return _elf_end(data) <= len(data)
    return bool(data.rstrip(b"\0 \n")) and (path.suffix != ".ptx" or data.rstrip(b"\0 \n").endswith(b"}"))


def _is_json(data: bytes) -> bool:
    try:
        json.loads(data)
    except ValueError:
        return False
    return True


def _elf_end(data: bytes) -> int:
    """Return where the table of sections ends, which stands last in an object file of 64 bits."""
    if len(data) < 64:
        return 64
    start, size, count = (int.from_bytes(data[at : at + n], "little") for at, n in ((0x28, 8), (0x3A, 2), (0x3C, 2)))
    return start + size * count
