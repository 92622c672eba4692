"""What the commands know by name: layouts, methods, configs."""

import textwrap
from pathlib import Path

from experiments import _layouts, methods

CONFIGS = Path(__file__).parent / "configs"
WIDTH = 80


def names() -> str:
    """Return all names, those of a kind in a row."""
    absent = [name for name in methods.names() if methods.lacks(name)]
    parts = {
        "Layouts (show, export, configs; N is any number of tiles)": _layouts.names(),
        "Methods (configs of run)": [name for name in methods.names() if name not in absent],
        "Methods that are not installed": absent,
        "Configs (experiments/configs)": sorted(path.stem for path in CONFIGS.glob("*.toml")),
    }
    return "\n\n".join(f"{title}:\n{_wrap(', '.join(known))}" for title, known in parts.items() if known)


def _wrap(text: str, indent: str = "  ") -> str:
    return textwrap.fill(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
