"""`python -m jfrnn.sph`: its help, its lists, and what it says of values that are out of range."""

import contextlib
import functools
import inspect
import io
import os
import re
import subprocess
import sys

import commanded
import numpy as np
import pytest
from places import ROOT
from started import run_python

from jfrnn.sph import ranges, settings, snapshots
from jfrnn.sph.commands import main
from jfrnn.sph.errors import SceneError


def invoke(*arguments):
    """Run a command in this process; return its exit code, and what it says on stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return code, out.getvalue(), err.getvalue()


refused = functools.partial(commanded.refused, by=invoke)


def read_table(path):
    """Return the columns of a table by their heads without units."""
    heads = path.read_text().partition("\n")[0].split(",")
    columns = np.genfromtxt(path, delimiter=",", skip_header=1, ndmin=2).T
    return {head.partition(" [")[0]: column for head, column in zip(heads, columns, strict=True)}


def told(*arguments):
    code, out, err = invoke(*arguments)
    assert (code, err) == (0, "")
    return out


def test_list_says_what_scenes_there_are_and_what_each_can_be_told():
    names = told("list")
    assert [name for name in settings.SCENES if f"\n  {name} " not in names] == []
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


@pytest.mark.parametrize(
    ("scene", "setting", "message"),
    [
        ("dam-break-2d", "nx=0", "--set nx: got '0'; input should be greater than or equal to 1 (from 1 to 10 000)"),
        ("dam-break-2d", "nx=2.5", "--set nx: got '2.5'; input should be a valid integer, "),
        ("taylor-green", "nx=-2", "--set nx: got '-2'; input should be greater than or equal to 1 (from 1 to 10 000)"),
        ("taylor-green", "dim=4", "--set dim: got '4'; input should be less than or equal to 3 (from 2 to 3)"),
        ("dam", "smoothing=0", "--set smoothing: got '0'; input should be greater than 0 (above 0)"),
        ("dam", "exponent=0", "--set exponent: got '0'; input should be greater than or equal to 1 (from 1 to 1 000)"),
        ("dam", "duration=NaN", "--set duration: got 'NaN'; input should be a finite number (above 0)"),
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
        ("dam", "step=1e-300", "scene 'dam' --set step=1e-300: step: takes steps of 1e-300 s for 2 s, expected up to 1e+09 steps"),
        ("droplet", "radius=1e-3", "scene 'droplet' --set radius=1e-3: positions has no particle of fluid: "),
        ("jet", "duration=1e-9", "scene 'jet' --set duration=1e-9: wall: there is no particle of fluid"),
        ("jet", "duration=1e300", "scene 'jet' --set duration=1e300: cannot be made ("),
        ("jet-gear", "teeth=4", "--set teeth: got '4'; input should be greater than or equal to 5 (from 5 to 1 000)"),
        ("jet-gear", "teeth=true", "--set teeth: got 'true'; input should be a valid integer (from 5 to 1 000)"),
        ("one", "restitution=none", "scene 'one': restitution must be a number from 0 to 1 in a tank, got None"),
        ("taylor-green", "nx=4", "scene 'taylor-green': periodic box must be 2.05 cutoffs wide along x"),
    ],
)
def test_a_setting_of_a_fluid_that_is_out_of_range(tmp_path, scene, setting, message):
    assert refused("run", scene, "--set", setting, "--out", tmp_path / "out").startswith(message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", settings.SCENES)
def test_no_number_of_a_scene_ends_in_anything_but_a_sentence(name):
    for key, kind in (settings.physics_of(name) | settings.parameters(name)).items():
        for text in ("-1", "0", "NaN", "1e-300", "[]", "x", ""):
            if ranges.of(name, key) is not None and (key, text) != ("spacing", "x"):
                try:
                    settings.make_scene(name, [f"{key}={text}"])
                except SceneError as error:
                    assert f"{key}" in str(error), (key, text, kind)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.npz", None, "initial {}: cannot be read (No such file or directory); expected a file .npz or .csv"),
        ("none.csv", None, "initial {}: cannot be read ("),
        ("text.npz", b"no archive", "{}: cannot be read: "),
        ("cut.npz", b"PK\x03\x04 cut", "{}: cannot be read: "),
        ("empty.npz", b"", "{}: cannot be read: "),
        ("empty.csv", b"\n", "{}: cannot be read: it is empty"),
        ("words.csv", b"x,y\n1,a\n", "{}: positions must be finite; particle 0 is not"),
        ("speeds.csv", b"x,y,vx\n1,1,0\n", "{}: cannot be read: of vx, vy, there is vx alone; columns are x, y, vx, vy, m"),
        ("depth.csv", b"x,y,z\n1,1,0\n", "{}: cannot be read: z means nothing; columns are x, y, vx, vy, m"),
        ("masses.csv", b"x,y,m\n1,1,0\n", "{}: expected at least one particle, and masses above 0"),
    ],
)
def test_particles_that_cannot_be_used(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    assert refused("run", "dam", "--initial", path, "--out", tmp_path / "out").startswith(message.format(path))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("positions", [np.array([["a", "b"]]), np.ones((5, 2)) + 1j])
def test_arrays_of_words_are_no_particles(tmp_path, positions):
    path = tmp_path / "words.npz"
    np.savez(path, positions=positions)
    assert refused("run", "dam", "--initial", path).startswith(f"{path}: holds what are no numbers: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("dam", "--skin", "nan"), "--skin: got 'nan'; input should be a finite number (from 0.01 to 100)"),
        (("dam", "--frames", "0"), "--frames: got '0'; input should be greater than or equal to 1 (from 1 to 1 000 000)"),
        (("jet", "--solid", "part.stl", "--solid-unit", "-1"), "--solid-unit: got '-1'; "),
        (("jet", "--solid", "part.stl", "--solid-unit", "nan"), "--solid-unit: got 'nan'; "),
        (("jet", "--solid", "part.stl"), "solid part.stl is no file: name an STL, OBJ or PLY."),
        (("jet", "--solid-unit", "0.001"), "--solid-unit 0.001: is the unit of the file of --solid; name that file too"),
        (("dam", "--neighbors", "tree"), "--neighbors: got 'tree'; allowed: auto, pair_sum, list"),
        (("dam", "--frame", "3"), "unrecognized arguments: --frame 3"),
        (("sea",), "unknown fluid scene 'sea'; allowed: one, two, "),
        (("dam", "--set", "spaced=1"), "--set spaced: unknown; of dam: spacing, duration, step; physics: density, "),
        (("dam", "--set", "spacing"), "--set spacing: expected key=value"),
        (("dam", "--set", "spacing=wide"), "--set spacing: got 'wide'; input should be a valid number"),
        (("dam", "--set", "integrator=euler"), "--set integrator: got 'euler'; input should be 'leapfrog', "),
        (("dam", "--dtype", "float16"), "--dtype: got 'float16'; allowed: float32, float64"),
        (("dam", "--initial", "particles.txt"), "particles.txt: unknown ending '.txt'; allowed: .csv, .npz"),
        ((), "the following arguments are required: SCENE"),
    ],
)
def test_an_option_that_is_out_of_range(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert refused("run", *arguments).startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_cannot_be_written_or_hold_something_else(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        said = refused("run", "one", "--out", place)
        assert said == f"{place}: cannot be written (there is a file of that name); name a folder that can be"
    (tmp_path / "run.json").write_text("[1]")
    assert refused("run", "one", "--out", tmp_path).startswith(f"{tmp_path / 'run.json'}: says no run (")


def test_a_snapshot_that_is_cut_off_is_named(tmp_path):
    scene = settings.make_scene("one", [])
    (tmp_path / "000000010.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(SceneError, match=r"000000010\.npz: is no snapshot .*; remove it, and the run goes on from the one before"):
        snapshots.latest(tmp_path, scene)


def test_a_process_says_its_mistakes():
    done = run_python("-m", "jfrnn.sph", "run", "one", "--frames", 0, ends=2)
    assert done.stdout == ""
    assert done.stderr.startswith("error: --frames: got '0'; ") and done.stderr.endswith("(see python -m jfrnn.sph run --help)\n")


def test_a_process_ends_quietly_where_nobody_reads_what_it_says():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "jfrnn.sph", "list"], stdout=writer, stderr=subprocess.PIPE, cwd=ROOT, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


def test_help_keeps_what_stands_in_brackets(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["run", "--help"])
    assert ended.value.code == 0
    assert "unit of that file [m]: 0.001 for mm" in " ".join(capsys.readouterr().out.split())
