"""A page for each public object, from directives of the pages in api/, which become lists of links."""

import importlib
import inspect
import re
from pathlib import Path

from sphinx.util.nodes import make_refnode
from sphinx.util.typing import stringify_annotation

from jfrnn._tracing import arguments

API = Path(__file__).parent / "api"
_BLOCK = re.compile(r"```\{eval-rst\}\n(.*?)```\n", re.DOTALL)
_MODULE = re.compile(r"^\.\. currentmodule:: (\S+)\n", re.MULTILINE)
_OBJECT = re.compile(
    r"^\.\. auto(?:function|class|exception):: ([\w.]+)(?:\(\))?\n(?:   .*\n)*", re.MULTILINE
)
_ALIASES = (
    "AnyCutoff",
    "Points",
    "Numbers",
    "IndexRows",
    "Indices",
    "Flags",
    "Number",
    "Real",
    "Size",
    "Flag",
    "Backend",
    "RadiusRule",
)


def write():
    """Write the pages of all objects; those of earlier names go."""
    made = {}
    for page in sorted(API.glob("*.md")):
        for module, name, directive in _objects(page.read_text(encoding="utf-8")):
            place, last = _place(module, name), name.rpartition(".")[2]
            offered = hasattr(importlib.import_module(module), last)  # types of some results are not
            title = place if offered else last
            text = f"# {title}\n\n```{{eval-rst}}\n.. currentmodule:: {module}\n{directive}```\n"
            made[API / "objects" / f"{place}.md"] = text
    (API / "objects").mkdir(exist_ok=True)
    for path in set((API / "objects").glob("*.md")) - set(made):
        path.unlink()
    for path, text in made.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def link(app, docname, source):
    """Put links, each with the first sentence of what it leads to, in the place of directives."""
    if docname.rpartition("/")[0] != "api":
        return
    module = ""

    def listed(block):
        nonlocal module
        found = _MODULE.search(block[1])
        module = found[1] if found else module
        items = [
            (_place(module, name), name) for name in (each[1] for each in _OBJECT.finditer(block[1]))
        ]
        lines = [
            f"- [`{name.rpartition('.')[2]}`](objects/{place}.md): {_first(module, name)}"
            for place, name in items
        ]
        entries = [f"{name.rpartition('.')[2]} <objects/{place}>" for place, name in items]
        tree = ["", "```{toctree}", ":hidden:", "", *entries, "```"]
        return "\n".join([*lines, *tree, ""]) if items else ""

    source[0] = _BLOCK.sub(listed, source[0])


def explain(app, env, node, shown):
    """Link the names of `shorten` to the table that says what each stands for."""
    if node.get("reftarget") not in _ALIASES:
        return None
    return make_refnode(app.builder, node["refdoc"], "api/jfrnn", "what-arguments-may-be", shown)


def _objects(text):
    module = ""
    for block in _BLOCK.finditer(text):
        found = _MODULE.search(block[1])
        module = found[1] if found else module
        yield from ((module, each[1], each[0]) for each in _OBJECT.finditer(block[1]))


def _place(module, name):
    return f"{module}.{name.rpartition('.')[2]}"


def _first(module, name):
    """Return the first sentence of a docstring."""
    place, _, last = name.rpartition(".") if name.startswith("jfrnn.") else (module, "", name)
    lines = inspect.getdoc(getattr(importlib.import_module(place), last)).split("\n\n")[0]
    return " ".join(lines.split()).replace("|", "\\|").replace("'", "`")


def shorten(app, what, name, obj, options, signature, returns):
    """Write types of arguments by their names in the library: `Points`, not all that it may be."""
    for alias in _ALIASES:
        signature = signature and signature.replace(
            stringify_annotation(getattr(arguments, alias), "smart"), alias
        )
    return signature, returns
