import csv
import gzip
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from commanded import refused, told
from matplotlib.image import imread

from experiments import _look, _plots, _report, _table, _thesis
from experiments._rows import RowFile, SearchRow, values_of

PICTURES = ("runtime_by_layout", "memory_by_layout", "runtime_by_fill", "memory_by_fill", "speed_against_error")
PICTURES += ("memory_against_error", "speed_against_sum_error", "runtime_of_all", "memory_of_all")
MACHINE = {"cpu": "Some CPU", "cores": 2, "memory_bytes": 8 * 2**30, "system": "Linux 6"}
VERSIONS = {"jax": "0.10.2", "scipy": "1.17.1", "warp-lang": None}
SCENES = (
    ("corners", 0.02, 7200, 0.0288),
    ("corners", 0.11, 28158, 0.112632),
    ("diagonal", 0.11, 29168, 0.116672),
    ("full", 1.0, 250_000, 1.0),
)


def make_row(scene, method, seconds, megabytes, **options):
    layout, fill_asked, points, fill = scene
    row = SearchRow(
        **{"key": f"{layout} {fill_asked} {method}", "layout": layout, "method": method, "fill_asked": fill_asked, "fill": fill},
        **{"spacing": 1e-4, "cutoff_ratio": 3.0, "dtype": "float32", "dim": 3, "seed": 0, "status": "ok", "points": points},
        **{"compile_s": 0.5, "first_s": seconds, "median_s": seconds, "p10_s": 0.9 * seconds, "p90_s": 1.2 * seconds, "repeats": 5},
        **{"search_bytes": int(1e6 * megabytes), "peak_bytes": int(3e6 * megabytes), "list_bytes": 1000, "scratch_bytes": 2000},
        **{"pairs": 90, "exact_pairs": 90, "missing": 0, "extra": 0, "compared": "pairs", "density_error": 0.0, "jump_error": 0.01},
        **{"others_cores": 0.0, "machine": MACHINE, "versions": VERSIONS},
        **{"commit": "0123456789abcdef", "dirty": False, "config": "thesis", "time": "2031-02-03T04:05:06+00:00"},
    )
    return replace(row, **options)


def make_rows():
    rows = []
    skipped = {"status": "skipped", "reason": "too many", "median_s": None, "search_bytes": None, "missing": None}
    for number, scene in enumerate(SCENES, start=1):
        rows.append(make_row(scene, "jax", 0.5 * number, 40.0 * number))
        rows.append(make_row(scene, "brute", 0, 0, **skipped))
        rows.append(make_row(scene, "scipy-kdtree", 0.75 * number, 20.0 * number, extra=300 * number))
        rows.append(make_row(scene, "cll", 0.25 * number, 10.0 * number, missing=2 * number, extra=7))
    return rows


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A folder with nothing but rows, after `report`."""
    folder = tmp_path_factory.mktemp("reported")
    for row in reversed(make_rows()):
        RowFile(folder).append(row)
    return folder, told("report", folder)


def read_table(folder):
    with (folder / "table.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    return {(line["scene"], line["method"]): line for line in lines}


def test_table_sets_our_figures_beside_the_thesis(reported):
    table = read_table(reported[0])
    assert len(table) == 16
    cll = table["full 100 %", "cll"]
    assert (cll["median_s"], cll["search_mb"], cll["peak_mb"], cll["missing"], cll["extra"]) == ("1.0", "40.0", "120.0", "8", "7")
    assert (cll["thesis_method"], cll["thesis_s"], cll["thesis_mb"], cll["thesis_points"]) == ("CLL", "2.14", "116.75", "250000")
    assert table["diagonal 11.67 %", "cll"]["thesis_points"] == "29424"
    tree = table["corners 11.26 %", "scipy-kdtree"]
    assert (tree["thesis_method"], tree["thesis_s"]) == ("ANN", "1340.39")


def test_ratios_are_those_to_cll_on_either_side(reported):
    table = read_table(reported[0])
    for (scene, method), line in table.items():
        if method in ("jax", "scipy-kdtree", "cll"):
            seconds, megabytes = {"jax": (2, 4), "scipy-kdtree": (3, 2), "cll": (1, 1)}[method]
            assert float(line["seconds_ratio"]) == pytest.approx(seconds), scene
            assert float(line["mb_ratio"]) == pytest.approx(megabytes), scene
    tree = table["corners 2.88 %", "scipy-kdtree"]
    assert float(tree["thesis_s_to_cll"]) == pytest.approx(63.40 / 0.02)
    assert float(tree["thesis_mb_to_cll"]) == pytest.approx(16.02 / 8.84)
    skipped = table["full 100 %", "brute"]
    assert (skipped["status"], skipped["reason"], skipped["seconds_ratio"]) == ("skipped", "too many", "")


def test_scenes_of_another_lattice_are_not_compared_with_the_thesis():
    row = make_row(SCENES[0], "cll", 1.0, 1.0)
    assert _thesis.figures(row) == _thesis.Figures("CLL", 7200, 0.02, 8.84)
    for change in (
        {"spacing": 5e-4},
        {"cutoff_ratio": 2.0},
        {"dim": 2},
        {"fill_asked": 0.03},
        {"layout": "random"},
        {"order": "shuffled"},
        {"method": "jax"},
    ):
        assert _thesis.figures(replace(row, **change)) is None, change
    assert _thesis.figures(make_row(SCENES[3], "cll", 1.0, 1.0, fill_asked=None)).seconds == 2.14


def test_scenes_stand_by_size_and_are_told_apart():
    rows = make_rows()
    assert [row.layout for row in _table.in_order(rows[::-1])[::4]] == ["corners", "corners", "diagonal", "full"]
    other = replace(rows[0], dtype="float64", key="other")
    names = _table.name_scenes([rows[0], other])
    assert sorted(names.values()) == ["corners 2.88 %, float32", "corners 2.88 %, float64"]
    skipped = replace(rows[0], fill=None, points=None, key="skipped")
    assert set(_table.name_scenes([rows[0], skipped]).values()) == {"corners 2.88 %"}, "the fill that was made"


def test_printed_table_and_paths(reported):
    folder, printed = reported
    lines = printed.splitlines()
    assert lines[-10] == str(folder / "table.csv")
    assert lines[-9:] == [str(folder / f"{name}.png") for name in PICTURES]
    assert ["s", "MB", "missing", "extra"] in [line.split() for line in lines]
    full = lines.index(next(line for line in lines if line.strip() == "full 100 %, 250 000 points"))
    shown = [line.split() for line in lines[full + 1 : full + 5]]
    assert shown[:2] == [["cll", "1.0000", "40.0", "8", "7"], ["scipy-kdtree", "3.0000", "80.0", "0", "1", "200"]]
    assert (shown[2][:2], shown[3]) == (["brute", "skipped"], ["jax", "2.0000", "160.0", "0", "0"])
    assert "Some CPU, 2 cores, 8 GiB · jax 0.10.2, scipy 1.17.1 · commit 0123456789 · 2031-02-03" in lines


def test_printed_table_fits_80_columns_and_names_what_is_not_installed_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(_plots, "draw_all", lambda rows, folder, origin: [])
    names = ("scipy-kdtree-nolist", "freud", "jax-md")
    for number, method in enumerate(names):
        scene = ("corners", 0.11, 28158, 0.112632)
        row = make_row(scene, method, 1234.5678, 123456.7, missing=24_012_345, extra=6_152_345, others_cores=1.5, compared="counts")
        lost = {"status": "missing", "reason": "not there", "median_s": None, "points": None}
        RowFile(tmp_path).append(row if number == 0 else replace(row, **lost))
        RowFile(tmp_path).append(replace(row, key=f"{method}, turned", layout="turned4", angle=45.0, order="shuffled"))
    lines = told("report", tmp_path).splitlines()
    start = lines.index(next(line for line in lines if "missing" in line))
    end = lines.index(next(line for line in lines if line.startswith("not installed: ")))
    table = [line.rstrip() for line in lines[start:end]]
    assert max(map(len, table)) <= 80
    assert len(table) > 5
    cells = ["scipy-kdtree-nolist", "*1234.5678", "123456.7", "~24", "012", "345", "~6", "152", "345"]
    assert sum(line.split() == cells for line in table) == 2
    assert sum(line.split()[0] in names[1:] for line in table if line) == 2, "those that are there, of the other scene"
    assert lines[end].startswith("not installed: freud, jax-md (make peers; ")
    assert [line[:2] for line in lines[end + 1 : end + 4]] == ["*:", "~:", "s:"]


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_show_the_library_in_blue_and_others_in_colors_of_their_own(reported, name):
    picture = (255 * imread(reported[0] / f"{name}.png")[..., :3]).round().astype(int)
    assert picture.shape[1] >= 700
    colors = [_look.OURS, *_look.PEERS_COLORS[:2]][: 1 if name.endswith("of_all") else 3]
    for color in colors:
        assert (abs(picture - [int(color[at : at + 2], 16) for at in (1, 3, 5)]) < 3).all(axis=2).sum() > 60, color


def texts_of(figure):
    return [text.get_text() for axes in figure.axes for text in (*axes.texts, *axes.get_yticklabels(), axes.title)]


MANY = ("warp", "pair-sum", "jax", "hashgrid", "cll", "vesin", "scipy-kdtree", "nvalchemi", "freud", "matscipy", "another")
DRAWN = {
    "runtime_by_layout": lambda rows: _plots.by_layout(rows, _plots.TIME),
    "memory_by_fill": lambda rows: _plots.by_fill(rows, _plots.MEMORY),
    "speed_against_error": lambda rows: _plots.against_error(rows, _plots.TIME),
    "speed_against_sum_error": _plots.against_sum_error,
}


@pytest.fixture(scope="module")
def many():
    """Rows of eleven methods on four scenes: the n-th takes n times as long, and n times the memory; each third is wrong."""
    made = []
    for scene in SCENES:
        for n, method in enumerate(MANY, start=1):
            made.append(make_row(scene, method, 0.1 * n, 5.0 * n, missing=n * (n % 3 == 2), jump_error=0.01 * (n % 3 == 2)))
    return made


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_that_lead_have_eight_methods_each_with_its_name_and_marker(many, name):
    figure = DRAWN[name](many)
    named = [method for method in MANY if _look.name_of(method) in texts_of(figure)]
    assert named == ["warp", "pair-sum", "jax", "cll", "vesin", "scipy-kdtree", "nvalchemi", "freud"]
    lines = [line for axes in figure.axes for line in axes.lines if line.get_marker() not in ("None", "")]
    assert len({line.get_marker() for line in lines}) == len(lines) == 8
    assert sorted(Counter(line.get_color() for line in lines).values()) == [1, 1, 1, 1, 1, 3], "the three of ours are blue"
    assert all(axes.get_legend() is None for axes in figure.axes)


def test_all_methods_are_in_a_second_picture(many):
    titles = {axes.get_title(loc="left") for axes in _plots.of_all(many, _plots.TIME).axes}
    assert {_look.name_of(method) for method in MANY} <= titles


def test_titles_say_what_the_rows_say(many):
    said = {name: draw(many).get_suptitle().replace("\n", " ") for name, draw in DRAWN.items()}
    assert said["runtime_by_layout"] == "jfrnn's list is 5 times as fast as the next, cell lists (thesis), on all 4 scenes"
    lean = "jfrnn's list takes 0.2 times the memory of the leanest other, cell lists (thesis) (means of layouts)"
    assert said["memory_by_fill"] == lean
    exact = "5 of the 7 lists drawn are exact; the fastest of the others, cell lists (thesis), takes 5 times"
    assert said["speed_against_error"].startswith(exact)
    assert said["speed_against_sum_error"].startswith("Wrong pairs change a sum that jumps at the cutoff by up to 1 %")
    slow = [replace(row, median_s=0.05) if row.method == "vesin" and row.layout == "full" else row for row in many]
    title = _plots.by_layout(slow, _plots.TIME).get_suptitle().replace("\n", " ")
    most = "jfrnn's list is first on 3 of 4 scenes, up to 5 times as fast as the next; elsewhere up to 2 times as slow as"
    assert title.startswith(most)


def test_names_beside_marks_cover_neither_a_mark_nor_each_other(many):
    """Five marks at one and the same place but for a hair, and two further off: each name is where nothing else is."""
    figure, axes = _look.make_axes("marks", 3.0)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    marks = [(f"method {k}", 0.5 + 0.03 * k, 0.5, "k") for k in range(5)] + [("left", 0.02, 0.5, "k"), ("right", 0.98, 0.98, "k")]
    _look.write_names_near(figure, axes, marks)
    boxes = [text.get_window_extent() for text in axes.texts]
    points = axes.transData.transform([mark[1:3] for mark in marks])
    assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])
    assert not any(box.contains(*point) for box in boxes for point in points)
    frame = axes.bbox
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1 for box in boxes)


def test_fills_are_those_that_were_made(many):
    axes = DRAWN["memory_by_fill"](many).axes[0]
    assert [axes.xaxis.get_major_formatter()(place, 0) for place in axes.get_xticks()] == ["2.88", "11.5", "100"]


def test_what_is_exact_stands_in_order_each_in_a_line_of_its_own(many):
    exact, wrong = _plots.against_error(many, _plots.TIME).axes
    places = sorted((line.get_ydata()[0], line.get_xdata()[0]) for line in exact.lines)
    assert [place for place, _ in places] == list(range(len(exact.lines)))
    assert [seconds for _, seconds in places] == sorted(seconds for _, seconds in places)
    assert [label.get_text() for label in exact.get_yticklabels()][:2] == ["jfrnn, list", "jfrnn, engine jax"]
    assert all(line.get_ydata()[0] > 0 for line in wrong.lines)


def test_origin_names_all_that_differ():
    rows = make_rows()[:3]
    rows[1] = replace(rows[1], machine=MACHINE | {"cpu": "Other CPU"}, time="2031-02-09T00:00:00+00:00", dirty=True)
    text = _report.describe_origin(rows)
    assert "Some CPU, 2 cores, 8 GiB / Other CPU, 2 cores, 8 GiB" in text
    assert "commit 0123456789 / commit 0123456789 with changes" in text
    assert text.endswith("with changes · 2031-02-03 to 2031-02-09")
    rows[2] = replace(rows[2], others_cores=0.96)
    assert "with changes · others kept up to 1.0 cores busy · 2031-02-03" in _report.describe_origin(rows)


def test_a_sweep_of_one_unknown_method_on_one_scene(tmp_path):
    RowFile(tmp_path).append(make_row(("random", 0.3, 500, 0.3), "peer", 0.5, 1.0))
    told("report", tmp_path)
    line = read_table(tmp_path)["random 30 %", "peer"]
    assert (line["median_s"], line["seconds_ratio"], line["thesis_s"]) == ("0.5", "", "")
    assert all((tmp_path / f"{name}.png").exists() for name in PICTURES)


def test_a_sweep_without_figures_still_has_its_table(tmp_path):
    RowFile(tmp_path).append(make_row(SCENES[0], "cll", 0, 0, status="missing", reason="not there", median_s=None, points=None))
    said = told("report", tmp_path)
    assert list(tmp_path.glob("*.png")) == []
    assert "not installed: cll (make peers; " in said and "not there" not in said


@pytest.mark.parametrize(("cores", "mark"), [(None, "°"), (0.1, ""), (0.4, "*")])
def test_times_are_marked_beside_others_and_where_that_is_not_known(tmp_path, monkeypatch, cores, mark):
    monkeypatch.setattr(_plots, "draw_all", lambda rows, folder, origin: [])
    RowFile(tmp_path).append(make_row(SCENES[0], "cll", 0.25, 10.0, others_cores=cores))
    assert f" {mark}0.2500 " in told("report", tmp_path)


def test_a_folder_without_rows(tmp_path):
    assert refused("report", tmp_path).startswith(f"{tmp_path}: no rows; fill it with `python -m experiments run CONFIG.toml --out")


def test_rows_of_a_bench_that_prints_its_own_table_are_no_broken_rows(tmp_path):
    RowFile(tmp_path, dict).append({"key": "a", "who": "jfrnn", "what": "list", "status": "ok"})
    assert refused("report", tmp_path) == (
        f"{tmp_path}: rows of a bench, whose own command prints their table: give it again, with --out {tmp_path}"
    )


def test_without_memory_there_are_no_pictures_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr(_plots.Figure, "savefig", lambda figure, path, dpi: path.touch())
    file = RowFile(tmp_path)
    for row in make_rows():
        file.append(replace(row, search_bytes=None, peak_bytes=None, scratch_bytes=None))
    _report.report(tmp_path)
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == {"runtime_by_layout", "runtime_by_fill", "speed_against_error", "speed_against_sum_error", "runtime_of_all"}


def test_short_times_keep_three_figures():
    shown = [_report._seconds(value) for value in (12.3456, 0.01234, 0.0099, 0.000151, 0.0, None)]
    assert shown == ["12.3456", "0.0123", "0.00990", "0.000151", "0.0000", "·"]


RESULTS = Path(_report.__file__).parent / "results"


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("*.jsonl*")), ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_rows_of_earlier_runs_are_read_with_their_columns(tmp_path, path):
    """Every study reads the rows that are kept of it: what a row says is what is read."""
    packed = path.suffix == ".gz"
    (tmp_path / f"rows.jsonl{'.gz' * packed}").write_bytes(path.read_bytes())
    kind, _ = _report.kind_of(tmp_path)
    rows = RowFile(tmp_path, kind).read_all()
    text = gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    first, read = json.loads(text.splitlines()[0]), values_of(rows[0])
    assert {name: read[name] for name in first} == first
    assert (kind is dict) == ("fill_asked" not in first)


def test_rows_that_are_packed_come_before_those_that_were_added(tmp_path):
    file, (old, new) = RowFile(tmp_path), make_rows()[:2]
    file.append(old)
    (tmp_path / "rows.jsonl.gz").write_bytes(gzip.compress(file.path.read_bytes()))
    file.path.unlink()
    assert file.read() == [old]
    file.append(new)
    file.append(replace(old, median_s=7.0))
    assert file.read() == [replace(old, median_s=7.0), new]


@pytest.mark.parametrize("damage", [lambda data: data[:60], lambda data: data[:-9] + b"123456789", lambda _: b"no gzip"])
def test_rows_that_cannot_be_unpacked_are_named(tmp_path, damage):
    RowFile(tmp_path).append(make_rows()[0])
    (tmp_path / "rows.jsonl.gz").write_bytes(damage(gzip.compress((tmp_path / "rows.jsonl").read_bytes())))
    assert "rows.jsonl.gz: cannot be unpacked" in refused("report", tmp_path)


def test_a_title_names_what_the_picture_shows_and_claims_nothing_beside_other_work():
    found = {"full": {"warp": 1.0, "hashgrid": 0.5, "vesin": 3.0}}
    assert _plots._only(found, ["warp", "vesin"]) == {"full": {"warp": 1.0, "vesin": 3.0}}
    assert _look.headline(found, "fast", beside=True).startswith("Time of a search, measured beside other work")
    assert "3 times as fast" in _look.headline(found, "fast") and "memory" in _look.headline(found, "lean", beside=True)
    rows = [make_row(SCENES[0], "cll", 1.0, 1.0, others_cores=cores) for cores in (None, 0.4, 0.0)]
    assert _plots._beside(rows) and not _plots._beside(rows[1:])
