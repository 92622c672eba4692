"""The pages: they build without a warning, their code runs as it stands, their figures are those of the rows."""

import os
import re

import pasted
import pytest
import soon
from checked import refuses
from places import ROOT
from started import run_python

import jfrnn
from experiments import pages
from experiments._errors import UsageError
from experiments.pages.rows import TIMES
from jfrnn import distributed, sph
from jfrnn._engine import ENGINES, Features
from jfrnn._shards.calls import BACKENDS
from jfrnn._triangles.engines import TRIANGLE_ENGINES

BUILD = f"""
import sys

from experiments.pages import gallery
from sphinx.cmd.build import main

gallery._RUN = {soon.PROGRAM!r} + gallery._RUN
sys.exit(main(sys.argv[1:]))
"""
GROUPS = {
    "readme": ["README.md", "docs/index.md", "docs/start.md"],
    "guides": sorted(f"docs/guides/{path.name}" for path in (ROOT / "docs/guides").glob("*.md")),
    "coming_from": sorted(f"docs/coming-from/{path.name}" for path in (ROOT / "docs/coming-from").glob("*.md")),
    "rest": [
        "docs/sph.md",
        "docs/own-scene.md",
        *sorted(f"docs/developers/{path.name}" for path in (ROOT / "docs/developers").glob("*.md")),
    ],
}


@pytest.fixture(scope="module")
def ran():
    """Run the blocks of all pages in one process, those of a page in order and in a namespace of its own.

    As a user finds the library: no 64-bit mode, here four virtual devices. Returns lines of code by page, and errors.
    """
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    given = [page for pages in GROUPS.values() for page in pages]
    done = run_python("-W", "error::RuntimeWarning", "-c", pasted.PROGRAM, *given, PYTHONPATH=str(ROOT), XLA_FLAGS=flags)
    return pasted.lines_run(done.stdout), done.stderr


@pytest.mark.parametrize("group", GROUPS)
def test_code_of_pages(group, ran):
    lines, errors = ran
    assert [page for page in GROUPS[group] if page not in lines] == [], errors
    assert sum(lines[page] for page in GROUPS[group]) > 0


def test_pages_build(tmp_path):
    """With warnings as errors: links, anchors and cross-references are there, docstrings can be read, no page is left out."""
    theme = ("-D", "html_theme=basic")  # to draw the navigation of the theme of `make docs` on each page takes a third of the time
    options = ("-W", "--keep-going", "--quiet", "--builder", "html", *theme)
    run_python("-c", BUILD, *options, ROOT / "docs", tmp_path, PYTHONPATH=str(ROOT))
    html = {path.stem: path.read_text(encoding="utf-8") for path in (tmp_path / "api" / "objects").glob("*.html")}
    public = [f"{module.__name__}.{name}" for module in (jfrnn, distributed, sph) for name in module.__all__]
    missing = [name for name in public if f'id="{name}"' not in html.get(name, "")]
    assert missing == []


@pytest.mark.parametrize("page", [path for path in pages.pages() if pages.names_in(path)], ids=lambda path: path.stem)
def test_figures_are_those_of_the_rows(page):
    text = page.read_text(encoding="utf-8")
    assert pages.fill_in(text) == text, "python -m experiments tables"


def test_engines_can_what_the_readme_says():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.split("## What each engine can")[1].splitlines()]
    lines = [line[:5] for line in lines if len(line) == 6]  # the last column tells of costs
    names = [cell.strip("`") for cell in lines[0][1:]]
    said = {line[0]: dict(zip(names, line[1:])) for line in lines}
    assert set(names) == set(ENGINES)
    asked = {"periodic boxes, batches": Features(periodic=True, batch=True), "`pair_sum`": Features(summed=True)}
    asked |= {"a cutoff per particle or per pair of species": Features(radii=True), "excluded pairs": Features(excluding=True)}
    for title, kind in asked.items():
        for name, engine in ENGINES.items():
            assert (said[title][name] == "no") == (engine.refuse(kind) is not None), (title, name)
    tables = {"many devices": BACKENDS, next(title for title in said if title.startswith("triangles")): TRIANGLE_ENGINES}
    for title, table in tables.items():
        assert [name for name in names if said[title][name] == "yes"] == [name for name in names if name in table]


NOTES = ("docs/benchmarks/tried.md", "docs/benchmarks/paper.md")  # of the laboratory, and arithmetic
NO_MEASUREMENTS = {  # bounds, defaults and definitions
    "README.md": ["2 GB"],
    "docs/benchmarks/cpu.md": ["60 s", "16 GiB"],
    "docs/benchmarks/gpu.md": ["11 %"],
    "docs/benchmarks/many-devices.md": ["20 B"],
    "docs/explanation/array-engine.md": [f"3 {TIMES}", "64 MB", "1 GB", "100 B", "125 B"],
    "docs/guides/kept-lists.md": ["4 B"],
    "docs/guides/many-devices.md": ["20 s"],
    "docs/guides/memory.md": ["64 MB", "1 GB", "32 B", "400 kB", "4 B", "4 B", "4 B", "8 B", "4 B", "4 B"],
    "docs/guides/search.md": [
        *("4 B", "8 B", "4 B", "8 B", "4 B", "4 B", "8 B", "4 B", "4 B", "4 B"),
        *("64 B", "84 B", "100 B", "125 B", "64 MB", "1 GB", "20 B", "40 B", "140 B", "180 B"),
    ],
    "docs/guides/sums-in-full.md": ["16 MB", "16 B"],
    "docs/guides/triangles.md": ["4 B", "100 to 132 B", "30 B", "12 B", "0.6 kB", "58 MB"],
    "docs/start.md": ["4 B", "4 B", "8 B"],
    "docs/thesis.md": ["95 %", "0.1 to 100 %", "10 %"],
}


def test_no_figure_is_written_by_hand():
    loose = {str(page.relative_to(ROOT)): pages.loose_figures(page.read_text(encoding="utf-8")) for page in pages.pages()}
    assert {name: found for name, found in loose.items() if found and name not in NOTES} == NO_MEASUREMENTS


def test_a_figure_written_by_hand_is_found():
    text = (
        "It takes 3.2 ms, 4 to 5 times as long, `5 ms` <!-- value jet-steps -->7 s<!-- end -->, 1 024 particles.\n```\n8 s\n```\n"
    )
    assert pages.loose_figures(text) == ["3.2 ms", "4 to 5 times"]


def test_every_table_and_figure_stands_in_a_page():
    assert {name for page in pages.pages() for name in pages.names_in(page)} == {*pages.TABLES, *pages.VALUES}


def test_a_figure_that_is_none_of_the_rows_is_found():
    text = "<!-- table ties -->\n\n<!-- end -->\n"
    filled = pages.fill_in(text)
    spoiled = re.sub(r"\d\.\d\d", "0.10", filled, count=1)
    assert spoiled != filled == pages.fill_in(spoiled)
    refuses(UsageError, "there is no such table", pages.fill_in, text.replace("ties", "knots"))
    text = "<!-- value jet-steps -->1 000<!-- end -->"
    assert pages.fill_in(text) == text.replace("1 000", pages.VALUES["jet-steps"]()) != text
    refuses(UsageError, "there is no such value", pages.fill_in, text.replace("jet", "oil"))


def test_no_head_of_a_table_breaks_inside_a_number():
    """Numbers of heads are written with spaces that do not break."""
    broken = re.compile(r"^\|.*\d \d{3}.*\|\n\|[ :|-]+\|$", re.MULTILINE)
    assert [page.name for page in pages.pages() if broken.search(page.read_text(encoding="utf-8"))] == []
