"""How Sphinx builds these pages: `make docs`, or `python -m sphinx -W docs out/docs`."""

import re
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent))

import objects

import jfrnn
from experiments.pages import gallery, pictures

project = "jfrnn"
author = "jfrnn developers"
release = version = jfrnn.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
default_role = "py:obj"  # a name in single quotation marks becomes a link where it is documented
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
add_module_names = False
toc_object_entries_show_parents = "hide"
python_maximum_signature_line_length = 88
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # tests/release/pages/test_notebooks.py runs them
nb_merge_streams = True
smartquotes_action = "D"  # dashes alone: strings in docstrings are those of Python
html_theme = "furo"
html_title = f"jfrnn {release}"
html_show_copyright = False
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_js_files = ["pages.js"]

HERE = Path(__file__).parent
STUDIES = HERE.parent / "notebooks"
_GUIDE = re.compile(r'"([^"]+)"\s+\(docs/(guides/[\w-]+)\.md\)')


def setup(app):
    """Draw pictures, run the gallery, copy the notebooks; keep formulas of docstrings as they are."""
    print("drawing pictures, running programs of the gallery: minutes the first time", flush=True)
    pictures.draw(HERE / "pictures")
    gallery.run(HERE / "gallery.md", HERE / "pictures" / "gallery")
    objects.write()
    (HERE / "notebooks").mkdir(exist_ok=True)
    for notebook in STUDIES.glob("*.ipynb"):
        shutil.copyfile(notebook, HERE / "notebooks" / notebook.name)
    app.connect("source-read", objects.link)
    app.connect("missing-reference", objects.explain)
    app.connect("autodoc-process-signature", objects.shorten)
    app.connect("autodoc-process-docstring", _escape, priority=100)  # before Napoleon


def _escape(app, what, name, obj, options, lines):
    """Link guides, and escape what stands for itself: |x| is a distance and *rows are arguments."""
    lines[:] = _GUIDE.sub(r":doc:`\1 </\2>`", "\n".join(lines)).split("\n")
    for k, line in enumerate(lines):
        if k and lines[k - 1].strip() == "Returns:":  # what stands before a colon is no type
            line = re.sub(r"(?=\S)", ": ", line, count=1)
        if not line.lstrip().startswith((">>>", "...")):
            lines[k] = re.sub(r"(?<=[\[(])\*(?=\w)|(?<=, )\*(?=\w)", r"\\*", line.replace("|", "\\|"))
