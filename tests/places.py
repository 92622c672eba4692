"""Where things stand, for tests in whatever folder."""

import subprocess
from pathlib import Path

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent


def list_files() -> list[str]:
    """Return the files of a checkout that git does not ignore, or those of an unpacked source distribution."""
    if not (ROOT / ".git").exists():
        held = (ROOT / "jfrnn.egg-info" / "SOURCES.txt").read_text(encoding="utf-8")
        listed = [*held.splitlines(), "jfrnn/cases", "jfrnn/kernels"]
    else:
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    return [name for name in listed if name and (ROOT / name).exists() and "egg-info" not in name]
