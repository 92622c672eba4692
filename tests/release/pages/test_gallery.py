"""The gallery: every program is shown, and so run when the pages are built (`test_docs.py`); one that fails ends the build."""

import re

from checked import refuses
from places import ROOT

from experiments.pages import gallery

PAGE = ROOT / "docs" / "gallery.md"


def test_every_program_is_shown():
    programs = {path.stem: path.read_text(encoding="utf-8") for path in gallery.PROGRAMS.glob("*.py")}
    assert len(programs) == 7
    assert max(text.count("\n") for text in programs.values()) <= 95
    page = PAGE.read_text(encoding="utf-8")
    for shown in (
        r"literalinclude} \.\./examples/gallery/(\w+)\.py",
        r"\(pictures/gallery/(\w+)\.",
        r"literalinclude} pictures/gallery/(\w+)\.txt",
    ):
        assert sorted(re.findall(shown, page)) == sorted(programs)


def test_a_program_that_fails_ends_the_build(tmp_path, monkeypatch):
    """What ran before and has not changed is not run again."""
    monkeypatch.setattr(gallery, "PROGRAMS", tmp_path)
    program, page = tmp_path / "dots.py", tmp_path / "page.md"
    page.write_text("![Dots](pictures/gallery/dots.png)", encoding="utf-8")
    program.write_text("import sys; open(sys.argv[1], 'w').close(); print('seven')", encoding="utf-8")
    assert gallery.run(page, tmp_path / "made") == ["dots"]
    assert (tmp_path / "made" / "dots.txt").read_text(encoding="utf-8") == "seven\n"
    assert gallery.run(page, tmp_path / "made") == []
    program.write_text("raise ValueError('no dots')", encoding="utf-8")
    refuses(RuntimeError, "no dots", gallery.run, page, tmp_path / "made")
