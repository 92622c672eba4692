"""How large the house is: files, lines, the longest ones, floors of imports and parameters, at some commits of the checkout."""

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from experiments._commands import take_folder
from experiments.bench import table

FOLDERS = {"library": ("jfrnn", "kernels"), "experiments": ("experiments", "jfrnn/sph")}
ON_TOP = "jfrnn/sph/"  # uses the library and is none of it; once it stood among the experiments
SOURCES = (".py", ".h", ".cuh")
COLUMNS = (
    *("commit", "part", "files", "lines", "lines_native", "longest_file", "longest_file_lines", "longest_function"),
    *("longest_function_lines", "most_parameters", "floors", "noqa_and_ignore"),
)


def command(
    commits: Annotated[list[str], typer.Argument(help="Commits to compare, the oldest first.")],
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "house",
) -> str:
    """Count files, lines, floors and parameters of the sources at some commits."""
    take_folder(out)
    rows = [count_part(commit, part) for commit in commits for part in FOLDERS]
    frame = table.pd.DataFrame(rows, columns=list(COLUMNS))
    frame.to_csv(out / "house.csv", index=False)
    return table.text(frame, COLUMNS)


def count_part(commit: str, part: str) -> dict[str, str | int]:
    """Return the row of a part of the sources at a commit."""
    texts = {path: text for path, text in _sources(commit, FOLDERS[part]) if part != "library" or not path.startswith(ON_TOP)}
    lines = {path: text.count("\n") for path, text in texts.items()}
    trees = {path: ast.parse(text) for path, text in texts.items() if path.endswith(".py")}
    functions = [
        (f"{path}: {node.name}", node)
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]
    longest, file = max(functions, key=lambda named: _length(named[1])), max(lines, key=lambda path: lines[path])
    return {
        "commit": _git("rev-parse", "--short=10", commit).strip(),
        "part": part,
        "files": len(texts),
        "lines": sum(lines.values()),
        "lines_native": sum(count for path, count in lines.items() if not path.endswith(".py")),
        "longest_file": file,
        "longest_file_lines": lines[file],
        "longest_function": longest[0],
        "longest_function_lines": _length(longest[1]),
        "most_parameters": max(len(node.args.args) + len(node.args.kwonlyargs) for _, node in functions),
        "floors": _floors(trees),
        "noqa_and_ignore": sum(text.count("# noqa") + text.count("pyright: ignore") for text in texts.values()),
    }


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout


def _sources(commit: str, folders: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    for path in _git("ls-tree", "-r", "--name-only", commit, *folders).splitlines():
        if path.endswith(SOURCES):
            yield path, _git("show", f"{commit}:{path}")


def _length(function: ast.FunctionDef) -> int:
    """Return the lines of a function without its docstring."""
    told = ast.get_docstring(function, clean=False)
    return (function.end_lineno or 0) - function.lineno + 1 - (told.count("\n") + 1 if told else 0)


def _floors(trees: dict[str, ast.Module]) -> int:
    """Return the length of the longest chain of rooms of which each imports the next: packages, and modules beside them."""
    below: dict[str, set[str]] = {}
    for path, tree in trees.items():
        taken = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        taken |= {
            f"{node.module}.{alias.name}" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
        }
        below.setdefault(_room(path.removesuffix(".py").replace("/", ".")), set()).update(map(_room, taken))
    below = {room: others - {room} for room, others in below.items()}
    floors = 0
    while below:
        free = {room for room, others in below.items() if not others & below.keys()} or set(below)  # a circle is one floor
        below, floors = {room: others for room, others in below.items() if room not in free}, floors + 1
    return floors


def _room(module: str) -> str:
    """Return the first two names of a module, of the kernels the first."""
    names = module.split(".")[:2]
    return "kernels" if "kernels" in names else ".".join(names)
