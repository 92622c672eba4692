"""The command line: its list, its help texts, and what it says of values that are out of range."""

import numpy as np
import pytest
from commanded import invoke, refused, told
from places import ROOT
from started import run_python

from experiments import _config, _layouts
from experiments._errors import UsageError
from experiments.bench.gpu import Config

CONFIGS = ROOT / "experiments" / "configs"
TOP = ("run", "init", "report", "tables", "merge", "list", "show", "export", "bench", "sph", "gpu")
BENCH = (
    *("crystals", "distributed", "arrays", "latency", "lj", "options", "peers", "start", "guides"),
    *("structures", "sums", "ties", "triangles"),
)
SPH = ("validate", "speed", "gradients", "peers")
COMMANDS = (*TOP[:8], "gpu", *(f"bench {name}" for name in BENCH), *(f"sph {name}" for name in SPH))


# --- lists and help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("group", "names"), [((), TOP), (("bench",), BENCH), (("sph",), SPH)])
def test_the_list_of_commands_fits_a_screen(group, names):
    lines = told(*group, "--help").splitlines()
    assert (len(lines) <= 24, max(map(len, lines)) <= 80) == (True, True)
    assert [line.split()[0] for line in lines[1:]] == list(names)
    assert told(*group) == told(*group, "--help")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_keeps_what_stands_in_brackets(command):
    units = {"show": ["[m]"], "export": ["[m]"], "run": ["[s]"]}
    units |= {"bench triangles": ["[modules]"], "bench peers": ["[s]", "--group peers"]}
    units |= {"bench latency": ["[µs]"], "bench start": ["[s]"], "bench structures": ["angstrom"]}
    text = told(*command.split(), "--help")
    assert text.startswith(f"Usage: python -m experiments {command} ")
    assert [unit for unit in units.get(command, []) if unit not in text] == []


def test_list_says_what_there_is():
    names = told("list")
    assert all(word in names for word in ("clustersN", "scipy-kdtree", "thesis"))
    assert max(map(len, names.splitlines())) <= 80


# --- values out of range ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench", "lj", "--steps", "0"), "--steps 0: "),
        (("bench", "arrays", "--repeats=1"), "--repeats 1: "),
        (("show", "corners", "--spacing", "nan"), "--spacing nan: "),
        (("show", "corners", "--spacing", "-1"), "--spacing -1: "),
        (("bench", "triangles", "--points", "10000000000"), "--points 10000000000: "),
        (("bench", "triangles", "--points", "abc"), "--points abc: "),
        (("bench", "triangles", "--rounds", "1"), "--rounds 1: "),
        (("bench", "options", "--backend", "cuda"), "--backend cuda: allowed: auto, jax, warp, brute"),
        (("bench", "ties", "--backend", "cuda"), "--backend cuda: allowed: auto, jax, warp, brute"),
        (("bench", "ties", "--cube", "1"), "--cube 1: "),
        (("bench", "triangles", "--backend", "brute"), "--backend brute: allowed: warp, bvh, jax"),
        (("bench", "triangles", "--cutoff", "0"), "--cutoff 0: "),
        (("bench", "triangles", "--faces", "1"), "--faces 1: "),
        (("bench", "structures", "--repeats", "1"), "--repeats 1: "),
        (("bench", "peers", "--limit", "nan"), "--limit nan: "),
        (("bench", "latency", "--sizes", "1"), "--sizes 1: "),
        (("bench", "lj", "--sizes", "124"), "--sizes 124: "),  # narrower than two cutoffs
        (("bench", "latency", "--repeats", "1"), "--repeats 1: "),
        (("bench", "start", "--repeats", "0"), "--repeats 0: "),
        (("bench", "start", "--before", "none"), "--before none: is no checkout of this project; there is no jfrnn/__init__.py"),
        (("bench", "peers", "ann"), "no peer 'ann'; allowed: jfrnn, scipy, "),
        (("show", "corners", "--dim", "4"), "--dim 4: "),
        (("show", "corners", "--fill", "nan"), "--fill nan: "),
        (("show", "corners", "--seed", "-1"), "--seed -1: "),
        (("show", "corners", "--spacing", "1e-3", "--out", "p.abc"), "--out p.abc: unknown ending '.abc'; allowed: "),
        (("bench", "crystals", "--sizes", "3"), "Invalid value for --sizes: 3: say systems x atoms of each"),
        (("sph", "validate", "sea"), "no case 'sea'; allowed: one, two, three, four, taylor-green"),
        (("sph", "gradients", "sea"), "no problem 'sea'; allowed: viscosity, jet, droplet, memory"),
        (("sph", "gradients", "--evaluations", "0"), "--evaluations 0: "),
        (("run", "none.toml", "--most-seconds", "nan"), "--most-seconds nan: "),
        (("run", "none.toml", "--most-seconds", "0"), "--most-seconds 0: 0.0 is not in the range x>0."),
        (("run", "none.toml", "--processes", "0"), "--processes 0: "),
        *(
            (("run", "none.toml", "--shard", part), f"--shard {part}: expected K/N with 1 <= K <= N, such as 2/8")
            for part in ("3/2", "0/2", "2", "a/b")
        ),
        (("export", "corners", "--out", "points.xyz"), "--out points.xyz: unknown ending '.xyz'; allowed: .csv, .vtp, .vtk"),
        (("export", "corner", "--out", "points.csv"), "unknown layout 'corner'; allowed: full, corners, diagonal, "),
        (("show", "clusters0"), "unknown layout 'clusters0'; allowed: full, "),
        (("show", "corners", "--fill", "2"), "layout 'corners': fill must "),
        (("show", "clusters9", "--spacing", "1e-3"), "layout 'clusters9': tiles must not exceed the 5 lattice sites "),
        (("export", "corners", "--dtype", "float16", "--out", "points.csv"), "layout 'corners': dtype must be "),
        (("rum",), "No such command 'rum'. Did you mean 'run'?"),
    ],
)
def test_an_option_that_is_out_of_range(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert refused(*arguments).startswith(message)
    assert list(tmp_path.iterdir()) == []


BROKEN = {"cut.toml": b"methods = [", "bytes.toml": b"\xff\xfe\x00", "unknown.toml": b"speed = 1\n"}


@pytest.mark.parametrize("command", ["run", "bench sums", "bench ties", "bench distributed", "gpu", "sph speed"])
def test_configs_that_are_none(tmp_path, command):
    none = tmp_path / "none.toml"
    assert refused(*command.split(), none, "--out", tmp_path / "out").startswith(f"{none}: cannot be read (No such")
    assert refused(*command.split(), tmp_path, "--out", tmp_path / "out").startswith(f"{tmp_path}: cannot be read (Is a directory)")
    for name, text in BROKEN.items():
        (tmp_path / name).write_bytes(text)
        code, _, said = invoke(*command.split(), tmp_path / name, "--out", tmp_path / "out")
        assert code == 2
        assert all(line.startswith(("error: ", str(tmp_path / name))) for line in said.splitlines())
        assert str(tmp_path / name) in said.splitlines()[0]
    assert "speed: unknown key (value 1); allowed: " in said
    assert not (tmp_path / "out").exists()


def test_a_key_in_a_table_of_a_config_is_told_what_its_table_allows(tmp_path):
    path = tmp_path / "gpu.toml"
    path.write_text('[[exactness]]\nbackend = "warp"\ndtypes = ["float16"]\ndims = []\ncapacity = 0\nspeed = 1\n')
    with pytest.raises(UsageError) as caught:
        _config.load(path, Config)
    lines = str(caught.value).splitlines()
    allowed = "backend, dtypes, dims, capacity, cases, least_rows"
    assert f"{path}: exactness[0].speed: unknown key (value 1); allowed: {allowed}" in lines
    assert f"{path}: exactness[0].dtypes[0]: got 'float16'; input should be 'float32' or 'float64'" in lines


def test_steps_are_timed_of_scenes_that_have_an_nx(tmp_path):
    path = tmp_path / "steps.toml"
    path.write_text('scene = "jet"\nnx = [4]\n')
    assert refused("sph", "speed", path).startswith(f"{path}: scene: fluid scene 'jet' has no nx")


# --- folders that cannot be written, and what they hold ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", CONFIGS / "smoke.toml"),
        ("bench", "sums", CONFIGS / "sums_smoke.toml"),
        ("bench", "distributed", CONFIGS / "distributed_smoke.toml"),
        ("gpu", CONFIGS / "h200.toml"),
        ("sph", "speed", CONFIGS / "sph_speed.toml"),
        ("sph", "validate", "one"),
        ("sph", "gradients", "memory"),
        ("sph", "peers"),
        *(("bench", name) for name in ("options", "ties", "triangles", "latency", "start")),
        ("bench", "peers", "scipy"),
    ],
    ids=lambda arguments: " ".join(map(str, arguments[:2])),
)
def test_a_folder_that_cannot_be_written_names_its_option(tmp_path, arguments):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        said = refused(*arguments, "--out", place)
        assert said == f"--out {place}: cannot be written (there is a file of that name); name a folder that can be"


def test_files_that_cannot_be_written_name_their_option(tmp_path):
    (tmp_path / "folder.png").mkdir()
    said = refused("show", "corners", "--spacing", "1e-3", "--out", tmp_path / "folder.png")
    assert said == f"--out {tmp_path / 'folder.png'}: cannot be written (there is a folder of that name); name a file that can be"
    (tmp_path / "file").write_text("")
    for command, name in (("show", "p.png"), ("export", "p.csv")):
        said = refused(command, "corners", "--spacing", "1e-3", "--out", tmp_path / "file" / name)
        assert said.startswith(f"--out {tmp_path / 'file'}: cannot be written (there is a file of that name)")


def test_folders_that_hold_something_else(tmp_path):
    rows = tmp_path / "rows.jsonl"
    for text in (b"no json\n", b"[]\n", b"\xff\xff\n"):
        rows.write_bytes(text)
        assert refused("report", tmp_path).startswith(f"{rows}: line 1 is no row")
    assert refused("merge", tmp_path, tmp_path / "none").startswith(f"{rows}: line 1 is no row")


def test_too_little_memory_is_said_in_a_line(monkeypatch):
    monkeypatch.setattr(_layouts, "make", lambda name, **options: np.empty((1 << 40, 1 << 10)))
    assert refused("show", "corners").startswith("this takes more memory than there is; ask for fewer particles: ")


def test_a_mistake_ends_a_process_with_2_and_a_line():
    done = run_python("-m", "experiments", "show", "corners", "--dim", 4, ends=2)
    assert done.stdout == ""
    assert done.stderr.startswith("error: --dim 4: ")
    assert done.stderr.endswith("(see python -m experiments show --help)\n")
