"""The gallery's pictures: its programs are run, as users run them, when the pages are built; one that fails ends the build.

All run in one process, on four virtual devices of the CPU. A program is not run again while neither it nor the library changes.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PROGRAMS = ROOT / "examples" / "gallery"
_PICTURE = re.compile(r"\(pictures/gallery/((\w+)\.(?:png|gif))\)")
_RUN = """
import contextlib, pathlib, runpy, sys

given = sys.argv[1:]
for program, picture in zip(given[::2], given[1::2], strict=True):
    sys.argv = [program, picture]
    print(f"gallery: {pathlib.Path(program).stem}, {given.index(program) // 2 + 1} of {len(given) // 2}", flush=True)
    with pathlib.Path(picture).with_suffix(".txt").open("w", encoding="utf-8") as said, contextlib.redirect_stdout(said):
        runpy.run_path(program, run_name="__main__")
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
"""


def run(page: Path, folder: Path) -> list[str]:
    """Run the programs whose pictures a page shows, and return the names of those that were run; a RuntimeError: one failed.

    The page names each picture, `pictures/gallery/NAME.png` or `.gif`, of a program NAME. Pictures go into the folder, and beside
    each, as `.txt`, what its program printed.
    """
    pictures = {name: folder / file for file, name in _PICTURE.findall(page.read_text(encoding="utf-8"))}
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "made_of.json"
    made = json.loads(note.read_text(encoding="utf-8")) if note.exists() else {}
    wanted = {name: _fingerprint(PROGRAMS / f"{name}.py") for name in pictures}
    names = [name for name, picture in pictures.items() if made.get(name) != wanted[name] or not picture.exists()]
    if not names:
        return []
    note.unlink(missing_ok=True)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    told = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg"}
    asked = [str(path) for name in names for path in (PROGRAMS / f"{name}.py", pictures[name])]
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", _RUN, *asked]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False, env=told)  # what it says is seen meanwhile
    if done.returncode:
        raise RuntimeError(f"a program of the gallery failed:\n{done.stderr}")
    note.write_text(json.dumps(wanted, indent=1), encoding="utf-8")
    return names


def _fingerprint(program: Path) -> str:
    """Return what tells whether a picture may differ from the one that is there."""
    library = (path for part in ("jfrnn", "kernels", "cases") for path in sorted((ROOT / part).rglob("*.*")))
    files = [program, *(path for path in library if path.suffix in (".py", ".h", ".cuh"))]
    versions = " ".join(version(name) for name in ("jax", "numpy", "matplotlib"))
    return hashlib.sha256(b"\0".join([versions.encode(), *(path.read_bytes() for path in files)])).hexdigest()
