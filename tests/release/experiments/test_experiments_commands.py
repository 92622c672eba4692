"""The command line: its list, its help texts, and what it says of values that are out of range."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from experiments import _commands, _config
from experiments._cli import app
from experiments._errors import UsageError
from experiments.gpu.config import Config
from experiments.sph import ranges, settings, snapshots

ROOT = Path(_commands.__file__).resolve().parent.parent
CONFIGS = ROOT / "experiments" / "configs"
TOP = ("run", "report", "tables", "merge", "list", "show", "export", "gpu", "bench", "sph")
BENCH = (
    *("crossover", "crystals", "distributed", "domain", "house", "arrays", "latency", "lj", "options", "peers", "skin", "start"),
    *("structures", "sums", "ties", "triangles", "use"),
)
SPH = ("run", "validate", "speed", "gradients")
COMMANDS = (*TOP[:8], *(f"bench {name}" for name in BENCH), *(f"sph {name}" for name in SPH))


def refused(*arguments):
    """Run a command that is refused, in this process; return what it says, a line, without the "error: "."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], prog_name="python -m experiments")
    if result.exit_code != 2:
        raise AssertionError(f"exit code {result.exit_code}: {result.output}") from result.exception
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr.removeprefix("error: ").rstrip("\n")


def told(*arguments):
    result = CliRunner().invoke(
        app, [str(argument) for argument in arguments], catch_exceptions=False, prog_name="python -m experiments"
    )
    assert result.exit_code == 0
    return result.stdout


# --- lists and help ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("group", "names"), [((), TOP), (("bench",), BENCH), (("sph",), SPH)])
def test_the_list_of_commands_fits_a_screen(group, names):
    lines = told(*group, "--help").splitlines()
    assert (len(lines) <= 24, max(map(len, lines)) <= 80) == (True, True)
    assert [line.split()[0] for line in lines[1:]] == list(names)
    assert told(*group) == told(*group, "--help")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_keeps_what_stands_in_brackets(command):
    units = {"show": ["[m]"], "export": ["[m]"], "run": ["[s]"], "bench skin": ["[m]"], "bench domain": ["[cutoffs]"]}
    units |= {"bench triangles": ["[modules]"], "bench peers": ["[s]", "--group peers"]}
    units |= {"bench latency": ["[µs]"], "bench start": ["[s]"], "bench structures": ["angstrom"]}
    text = told(*command.split(), "--help")
    assert text.startswith(f"Usage: python -m experiments {command} ")
    assert [unit for unit in units.get(command, []) if unit not in text] == []


def test_list_says_what_scenes_there_are_and_what_each_can_be_told():
    names = told("list")
    assert [name for name in settings.SCENES if f"\n  {name} " not in names] == []
    assert all(word in names for word in ("clustersN", "scipy-kdtree", "thesis"))
    assert max(map(len, names.splitlines())) <= 80
    text = told("list", "dam-break-3d")
    assert max(map(len, text.splitlines()[1:])) <= 80
    assert "  nx=20\n      Particles along it. (from 1 to 10 000)\n" in text
    assert "  gravity=[0.0, 0.0, -9.81]\n      Acceleration [m/s²], one number per axis. (finite)\n" in text
    assert refused("list", "sea").startswith("list sea: no such scene; there are one, two, ")


def test_every_number_that_can_be_set_has_a_range_and_defaults_are_within():
    for name, scene in settings.SCENES.items():
        make = inspect.signature(scene).parameters
        physics = scene().physics
        kinds = settings.physics_of(name) | settings.parameters(name)
        for key, kind in kinds.items():
            default = make[key].default if key in make else getattr(physics, key)
            bounds = ranges.of(name, key)
            assert (bounds is not None) == bool(re.search(r"\b(int|float)\b", str(kind))), key
            assert ranges.read(kind, default, bounds) == default, (name, key)


# --- values out of range ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "setting", "message"),
    [
        ("dam-break-2d", "nx=-4", "--set nx: got '-4'; input should be greater than or equal to 1 (from 1 to 10 000)"),
        ("dam-break-2d", "nx=0", "--set nx: got '0'; input should be greater than or equal to 1 (from 1 to 10 000)"),
        ("dam-break-2d", "nx=2.5", "--set nx: got '2.5'; input should be a valid integer, "),
        ("taylor-green", "nx=-2", "--set nx: got '-2'; input should be greater than or equal to 1 (from 1 to 10 000)"),
        ("taylor-green", "dim=4", "--set dim: got '4'; input should be less than or equal to 3 (from 2 to 3)"),
        ("dam", "smoothing=0", "--set smoothing: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "smoothing=-1", "--set smoothing: got '-1'; input should be greater than 0 (above 0)"),
        ("dam", "exponent=0", "--set exponent: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "duration=NaN", "--set duration: got 'NaN'; input should be a finite number (above 0)"),
        ("dam", "duration=-1", "--set duration: got '-1'; input should be greater than 0 (above 0)"),
        ("dam", "duration=0", "--set duration: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "duration=1e999", "--set duration: got '1e999'; input should be a finite number (above 0)"),
        ("dam", "step=0", "--set step: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "density=-1000", "--set density: got '-1000'; input should be greater than 0 (above 0)"),
        ("dam", "sound_speed=0", "--set sound_speed: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "spacing=1e-5", "--set spacing: got '1e-5'; input should be greater than or equal to 0.002 (from 0.002 to 1)"),
        ("dam", "gravity=[0,NaN]", "--set gravity: got '[0,NaN]'; input should be a finite number (finite)"),
        ("droplet", "radius=-1", "--set radius: got '-1'; input should be greater than 0 (above 0)"),
        ("poiseuille", "viscosity=-1", "--set viscosity: got '-1'; input should be greater than 0 (above 0)"),
        ("hydrostatic", "viscosity=-1", "--set viscosity: got '-1'; input should be greater than or equal to 0 (from 0)"),
        ("dam", "gravity=[0,0,-9.81]", "scene 'dam' --set gravity=[0,0,-9.81]: gravity has 3 components, expected 2 in 2D"),
        ("dam", "gravity=[]", "scene 'dam' --set gravity=[]: gravity has 0 components, expected 2 in 2D"),
        (
            "dam",
            "smoothing=1e-9",
            "scene 'dam' --set smoothing=1e-9: smoothing is 1e-09 m, expected 0.1 to 50 particle spacings of ",
        ),
        ("dam", "step=1e-300", "scene 'dam' --set step=1e-300: takes steps of 1e-300 s for 2 s, expected up to 1e+09 steps"),
        ("droplet", "radius=1e-3", "scene 'droplet' --set radius=1e-3: has no particle of fluid: "),
        ("jet", "duration=1e-9", "scene 'jet' --set duration=1e-9: has no particle of fluid: "),
        ("jet", "duration=1e300", "scene 'jet' --set duration=1e300: cannot be made ("),
        ("jet-gear", "teeth=4", "--set teeth: got '4'; input should be greater than or equal to 5 (from 5 to 1 000)"),
        ("one", "restitution=none", "scene 'one': restitution must be a number from 0 to 1 in a tank, got None"),
        ("taylor-green", "nx=4", "scene 'taylor-green': periodic box must be 2.05 cutoffs wide along x"),
    ],
)
def test_a_setting_of_a_fluid_that_is_out_of_range(tmp_path, scene, setting, message):
    assert refused("sph", "run", scene, "--set", setting, "--out", tmp_path / "out").startswith(message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", settings.SCENES)
def test_no_number_of_a_scene_ends_in_anything_but_a_sentence(name):
    for key, kind in (settings.physics_of(name) | settings.parameters(name)).items():
        for text in ("-1", "0", "NaN", "1e-300", "[]", "x", ""):
            if ranges.of(name, key) is not None and (key, text) != ("spacing", "x"):
                try:
                    settings.make_scene(name, [f"{key}={text}"])
                except UsageError as error:
                    assert f"{key}" in str(error), (key, text, kind)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.npz", None, "--initial {}: cannot be read (No such file or directory); expected a file .npz or .csv"),
        ("none.csv", None, "--initial {}: cannot be read ("),
        ("text.npz", b"no archive", "{}: cannot be read: "),
        ("cut.npz", b"PK\x03\x04 cut", "{}: cannot be read: "),
        ("empty.npz", b"", "{}: cannot be read: "),
        ("words.csv", b"x,y\n1,a\n", "{}: positions must be finite; particle 0 is not"),
        ("masses.csv", b"x,y,m\n1,1,0\n", "{}: expected at least one particle, and masses above 0"),
    ],
)
def test_particles_that_cannot_be_used(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert refused("sph", "run", "dam", "--initial", path, "--out", tmp_path / "out").startswith(message.format(path))
    assert not (tmp_path / "out").exists()


def test_arrays_of_words_are_no_particles(tmp_path):
    path = tmp_path / "words.npz"
    np.savez(path, positions=np.array([["a", "b"]]))
    assert refused("sph", "run", "dam", "--initial", path).startswith(f"{path}: holds what are no numbers: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench", "skin", "--steps", "0"), "--steps 0: "),
        (("bench", "skin", "--repeats=1"), "--repeats 1: "),
        (("bench", "skin", "--spacing", "nan"), "--spacing nan: "),
        (("bench", "skin", "--spacing", "-1"), "--spacing -1: "),
        (("bench", "domain", "nan"), "Invalid value for "),
        (("bench", "domain", "0"), "Invalid value for "),
        (("bench", "domain", "--points", "1"), "--points 1: "),
        (("bench", "domain", "--points", "10000000000"), "--points 10000000000: "),
        (("bench", "use", "--points", "abc"), "--points abc: "),
        (("bench", "use", "--rounds", "1"), "--rounds 1: "),
        (("bench", "options", "--backend", "cuda"), "--backend cuda: allowed: auto, jax, warp, brute"),
        (("bench", "ties", "--backend", "cuda"), "--backend cuda: allowed: auto, jax, warp, brute"),
        (("bench", "ties", "--cube", "1"), "--cube 1: "),
        (("bench", "triangles", "--backend", "brute"), "--backend brute: allowed: warp, bvh, jax"),
        (("bench", "triangles", "--cutoff", "0"), "--cutoff 0: "),
        (("bench", "triangles", "--faces", "1"), "--faces 1: "),
        (("bench", "crossover", "--repeats", "1"), "--repeats 1: "),
        (("bench", "peers", "--limit", "nan"), "--limit nan: "),
        (("bench", "latency", "--sizes", "1"), "--sizes 1: "),
        (("bench", "latency", "--repeats", "1"), "--repeats 1: "),
        (("bench", "start", "--repeats", "0"), "--repeats 0: "),
        (("bench", "start", "--before", "none"), "--before none: is no checkout of this project; there is no jfrnn/__init__.py"),
        (("bench", "peers", "ann"), "no peer 'ann'; allowed: jfrnn, scipy, "),
        (("show", "corners", "--dim", "4"), "--dim 4: "),
        (("show", "corners", "--fill", "nan"), "--fill nan: "),
        (("show", "corners", "--seed", "-1"), "--seed -1: "),
        (("show", "corners", "--spacing", "1e-3", "--out", "p.abc"), "--out p.abc: unknown ending '.abc'; allowed: "),
        (("sph", "run", "dam", "--skin", "nan"), "--skin nan: "),
        (("sph", "run", "dam", "--frames", "0"), "--frames 0: "),
        (("sph", "run", "jet", "--solid", "part.stl", "--solid-unit", "-1"), "--solid-unit -1: "),
        (("sph", "run", "jet", "--solid", "part.stl", "--solid-unit", "nan"), "--solid-unit nan: "),
        (("sph", "run", "jet", "--solid", "part.stl"), "--solid part.stl is no file: name an STL, OBJ or PLY."),
        (
            ("sph", "run", "jet", "--solid-unit", "0.001"),
            "--solid-unit 0.001: is the unit of the file of --solid; name that file too",
        ),
        (("sph", "run", "dam", "--neighbors", "tree"), "--neighbors tree: allowed: auto, pair_sum, list"),
        (("sph", "validate", "sea"), "no case 'sea'; allowed: "),
        (("sph", "gradients", "sea"), "no problem 'sea'; allowed: "),
        (("sph", "gradients", "--evaluations", "0"), "--evaluations 0: "),
        (("run", "none.toml", "--most-seconds", "nan"), "--most-seconds nan: "),
        (("run", "none.toml", "--processes", "0"), "--processes 0: "),
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
    assert refused(*command.split(), tmp_path / "none.toml", "--out", tmp_path / "out").startswith(
        f"{tmp_path / 'none.toml'}: cannot be read (No such"
    )
    assert refused(*command.split(), tmp_path, "--out", tmp_path / "out").startswith(f"{tmp_path}: cannot be read (Is a directory)")
    for name, text in BROKEN.items():
        (tmp_path / name).write_bytes(text)
        said = CliRunner().invoke(app, [*command.split(), str(tmp_path / name), "--out", str(tmp_path / "out")])
        assert said.exit_code == 2
        assert all(line.startswith(("error: ", str(tmp_path / name))) for line in said.stderr.splitlines())
        assert str(tmp_path / name) in said.stderr.splitlines()[0]
    assert "speed: unknown key (value 1); allowed: " in said.stderr
    assert not (tmp_path / "out").exists()


def test_a_key_in_a_table_of_a_config_is_told_what_its_table_allows(tmp_path):
    path = tmp_path / "gpu.toml"
    path.write_text(
        (CONFIGS / "h200.toml").read_text()
        + "\n[[triangles]]\npoints = [1]\nfaces = 500\ncutoffs = [nan]\ndtypes = []\nspeed = 1\n"
    )
    with pytest.raises(UsageError) as caught:
        _config.load(path, Config)
    lines = str(caught.value).splitlines()
    assert f"{path}: triangles[0].speed: unknown key (value 1); allowed: points, faces, cutoffs, dtypes" in lines
    assert f"{path}: triangles[0].cutoffs[0]: got nan; input should be a finite number" in lines


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ('methods = ["cll"]\ntimeout = 1e9\n[[scenes]]\nlayouts = ["full"]\n', "timeout: got 1000000000.0; "),
        ('methods = ["cll"]\nprocesses = 0\n[[scenes]]\nlayouts = ["full"]\n', "processes: got 0; "),
    ],
)
def test_a_number_of_a_config_that_is_out_of_range(tmp_path, config, message):
    path = tmp_path / "sweep.toml"
    path.write_text(config)
    assert refused("run", path).startswith(f"{path}: {message}")


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
        ("sph", "run", "one"),
        ("sph", "validate", "one"),
        ("sph", "gradients", "memory"),
        *(("bench", name) for name in ("options", "ties", "crossover", "triangles", "skin", "use", "domain", "latency", "start")),
        ("bench", "peers", "scipy"),
        ("bench", "house", "HEAD"),
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
    rows.write_bytes(b'{"kind": "ceiling"}\n')
    assert refused("report", tmp_path).startswith(f"{rows}: holds no rows of a GPU run")
    for text in (b"no json\n", b"[]\n", b"\xff\xff\n"):
        rows.write_bytes(text)
        assert refused("report", tmp_path).startswith(f"{rows}: line 1 is no row")
    assert refused("merge", tmp_path, tmp_path / "none").startswith(f"{rows}: line 1 is no row")
    (tmp_path / "run.json").write_text("[1]")
    assert refused("sph", "run", "one", "--out", tmp_path).startswith(f"{tmp_path / 'run.json'}: says no run (")


def test_a_snapshot_that_is_cut_off_is_named(tmp_path):
    scene = settings.make_scene("one", [])
    (tmp_path / "000000010.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(UsageError, match=r"000000010\.npz: is no snapshot .*; remove it, and the run goes on from the one before"):
        snapshots.latest(tmp_path, scene)


def test_too_little_memory_is_said_in_a_line(capsys):
    with pytest.raises(typer.Exit) as ended, _commands.usage_errors():
        np.empty((1 << 40, 1 << 10))
    assert ended.value.exit_code == 2
    assert capsys.readouterr().err.startswith("error: this takes more memory than there is; ask for fewer particles: ")


def test_a_mistake_ends_a_process_with_2_and_a_line():
    done = subprocess.run(
        [sys.executable, "-m", "experiments", "bench", "skin", "--steps", "0"], cwd=ROOT, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --steps 0: ")
    assert done.stderr.endswith("(see python -m experiments bench skin --help)\n")
