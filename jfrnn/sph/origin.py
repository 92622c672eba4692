"""Where a run came from: versions, machine, commit."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

import jfrnn


def tell() -> dict[str, Any]:
    """Return versions, the device, the usable cores, and the commit of a checkout; no names of hosts or users."""
    try:
        jaxlib = version("jaxlib")
    except PackageNotFoundError:
        jaxlib = None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "jfrnn": jfrnn.__version__,
        "commit": _commit(),
        "jax": jax.__version__,
        "jaxlib": jaxlib,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {cores} cores",
        "device": jax.devices()[0].device_kind,
    }


def _commit() -> str | None:
    """Return the commit of the checkout that jfrnn stands in; None where it is installed, or there is no git."""
    root = Path(jfrnn.__file__).parent.parent
    if not (root / ".git").exists():
        return None
    asked = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=True, timeout=20).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
