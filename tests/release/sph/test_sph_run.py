"""`python -m jfrnn.sph run`: what a run writes, how it goes on after a kill, and what it says when it goes wrong."""

import errno
import json
import os
import re
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import pyvista
import trimesh
from checked import slow
from test_sph_commands import invoke as command
from test_sph_commands import read_table, refused

from jfrnn._triangles.winding import is_closed
from jfrnn.cases import fluids, meshes
from jfrnn.sph import frames, health, runs
from jfrnn.sph.files import read_solid, with_solid
from jfrnn.sph.model import make_model, make_state
from jfrnn.sph.settings import make_scene

FEW = ("--frames", 3, "--set", "duration=0.003")


def invoke(*arguments):
    return command("run", *arguments)


def load(folder, step):
    with np.load(folder / "snapshots" / f"{step:09d}.npz") as saved:
        return {name: saved[name] for name in saved}


def test_a_run_writes_snapshots_energies_frames_and_a_gif(tmp_path):
    code, out, _ = invoke("four", *FEW, "--out", tmp_path)
    assert (code, out.split()[-1]) == (0, str(tmp_path))
    names = [f"{step:09d}" for step in (0, 10, 20, 30)]
    for folder, ending in (("snapshots", "npz"), ("snapshots", "vtp"), ("frames", "png")):
        assert sorted(path.stem for path in (tmp_path / folder).glob(f"*.{ending}")) == names
    assert (tmp_path / "four.gif").read_bytes()[:4] == b"GIF8"
    table = read_table(tmp_path / "energies.csv")
    np.testing.assert_allclose(table["time"], [0, 0.001, 0.002, 0.003], atol=1e-12)
    np.testing.assert_allclose(table["total"], table["kinetic"] + table["potential"], rtol=1e-9)
    cloud = pyvista.read(tmp_path / "snapshots" / "000000030.vtp")
    np.testing.assert_array_equal(cloud.points[:, :2], load(tmp_path, 30)["x"])
    np.testing.assert_array_equal(cloud.point_data["velocity"][:, :2], load(tmp_path, 30)["v"])


@pytest.mark.parametrize("neighbors", ["pair_sum", slow("list")])
def test_a_killed_run_goes_on_to_the_same_end(tmp_path, neighbors):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    options = ("dam", "--set", "spacing=0.008", *FEW, "--no-pictures", "--neighbors", neighbors)
    invoke(*options, "--out", whole)
    invoke(*options, "--out", killed)
    for step in (20, 30):
        (killed / "snapshots" / f"{step:09d}.npz").unlink()
    invoke(*options, "--out", killed)
    tables = [read_table(folder / "energies.csv")["kinetic"] for folder in (whole, killed)]
    tolerance = 0 if neighbors == "pair_sum" else 1e-9  # a list that is made anew may order its rows, and their sums, otherwise
    np.testing.assert_allclose(*tables, rtol=tolerance)
    np.testing.assert_allclose(load(whole, 30)["x"], load(killed, 30)["x"], rtol=tolerance)


@pytest.mark.parametrize("step", [20, 30])
def test_a_run_that_was_killed_after_a_snapshot_brings_its_series_up_to_it(tmp_path, step):
    invoke("four", *FEW, "--no-pictures", "--out", tmp_path)
    series = tmp_path / "four.pvd"
    whole = series.read_text()
    for later in range(step + 10, 40, 10):
        (tmp_path / "snapshots" / f"{later:09d}.npz").unlink()
    series.write_text("\n".join(line for line in whole.splitlines() if f"{step:09d}" not in line) + "\n")
    invoke("four", *FEW, "--no-pictures", "--out", tmp_path)
    assert series.read_text() == whole


@pytest.mark.parametrize("longer", [False, True])
def test_a_disk_that_is_full_while_run_json_is_written_leaves_a_folder_to_go_on_in(tmp_path, monkeypatch, longer):
    options = ("four", "--set", "step=1e-4", "--no-pictures", "--out", tmp_path)
    if longer:
        invoke(*options, "--set", "duration=0.001", "--frames", 1)
    write = Path.write_text

    def fill(path, text):
        if path.stem != "run":
            return write(path, text)
        write(path, text[: len(text) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_text", fill)
    code, _, err = invoke(*options, "--set", "duration=0.002", "--frames", 2)
    assert code == 2
    assert "No space left on device" in err
    monkeypatch.undo()
    assert invoke(*options, "--set", "duration=0.002", "--frames", 2)[0] == 0
    assert load(tmp_path, 20)["time"] == pytest.approx(0.002)


def test_stopped_runs_go_on_to_the_same_end(tmp_path, tries=3):
    """Ctrl-C at any time, also while JAX calls back into Python, ends a run with 130; the same command then ends as a whole one."""
    options = ("four", "--set", "duration=0.004", "--frames", 4, "--no-pictures")
    whole, random, stopped, late = tmp_path / "whole", np.random.default_rng(0), 0, []
    invoke(*options, "--out", whole)
    before = signal.signal(signal.SIGINT, lambda *_: late.append(1))  # what comes before or after a run
    start = time.perf_counter()
    invoke(*options, "--out", tmp_path / "again")
    seconds = time.perf_counter() - start
    try:
        for k in range(tries):
            folder = tmp_path / f"{k}"
            timer = threading.Timer(random.uniform(0, seconds), os.kill, (os.getpid(), signal.SIGINT))
            timer.start()
            code, _, said = invoke(*options, "--out", folder)
            timer.join()
            assert (code, "stopped; the same command goes on" in said) in ((0, False), (130, True))
            stopped += code == 130
            assert code == 0 or invoke(*options, "--out", folder)[0] == 0
            for name in ("x", "v", "time"):
                np.testing.assert_array_equal(load(folder, 40)[name], load(whole, 40)[name])
            assert (folder / "energies.csv").read_bytes() == (whole / "energies.csv").read_bytes()
    finally:
        signal.signal(signal.SIGINT, before)
    assert stopped + len(late) >= tries - 1  # the last may come after the end of its run, before the timer is joined
    assert stopped > tries // 4


@pytest.mark.slow
def test_each_of_200_stopped_runs_goes_on_to_the_same_end(tmp_path):
    test_stopped_runs_go_on_to_the_same_end(tmp_path, 200)


def test_given_particles_replace_those_of_the_scene(tmp_path):
    table = tmp_path / "given.csv"
    table.write_text("x,y,vx,vy\n0.3,0.5,1.0,0.0\n0.7,0.5,-1.0,0.0\n")
    invoke("dam", *FEW, "--initial", table, "--out", tmp_path / "csv")
    np.savez(tmp_path / "given.npz", positions=[[0.3, 0.5], [0.7, 0.5]], velocities=[[1.0, 0.0], [-1.0, 0.0]])
    invoke("dam", *FEW, "--initial", tmp_path / "given.npz", "--out", tmp_path / "npz")
    first, second = (load(tmp_path / kind, 30) for kind in ("csv", "npz"))
    np.testing.assert_array_equal(first["x"], second["x"])
    np.testing.assert_allclose(first["x"], [[0.303, 0.5], [0.697, 0.5]], atol=1e-4)


def test_a_folder_of_another_run_is_refused(tmp_path):
    invoke("one", *FEW, "--out", tmp_path, "--no-pictures")
    assert "holds a run with another physics" in refused("run", "one", *FEW, "--out", tmp_path, "--set", "restitution=0.4")
    assert json.loads((tmp_path / "run.json").read_text())["physics"]["restitution"] == 0.5


def test_a_run_that_diverges_names_step_and_particle(tmp_path):
    wild = ("--set", "spacing=0.008", "--set", "sound_speed=1e160", "--no-pictures")
    said = refused("run", "dam", *FEW, *wild, "--out", tmp_path)
    assert "dam: diverged in step 1, t = 0.0001 s: particle 0 has position [nan nan]" in said


@pytest.mark.slow
def test_the_step_in_which_a_particle_crossed_a_wall():
    scene = make_scene("one", ["restitution=0.5"])
    model = make_model(scene, backend="brute")
    fast = make_state(scene)._replace(v=np.array([[0.0, -300.0]]))
    through = model.__class__(**{**vars(model), "tank": None})  # the same without a tank
    with pytest.raises(health.DivergedError, match=r"in step 117, t = 0.0017 s: particle 0 went through a wall, to \[ 0.5 "):
        health.check(scene, through, fast, None, health.solver.advance(through, fast, None, 50)[0], 50, 100)


def test_values_of_settings_have_their_kind():
    scene = make_scene("dam", ["gravity=[0, -1.62]", "artificial=0.1", "viscosity=none"])
    assert scene.physics.gravity == (0.0, -1.62)
    assert (scene.physics.artificial, scene.physics.viscosity) == (0.1, None)
    assert fluids.fluid("dam").physics.viscosity == 1.0


def write_cube(path, center=(0.0, 0.0, 0.0), edge=1.0, faces=range(12)):
    """Write a cube as STL, each of its triangles with corners of its own."""
    vertices, named = meshes.cube(edge, 1)
    trimesh.Trimesh(vertices + center, named[list(faces)], process=False).export(path)
    return path


def test_a_wall_from_a_file(tmp_path):
    path = write_cube(tmp_path / "cube.stl", (1.0, 2.0, 4.0), 2.0)
    scene = with_solid(make_scene("jet", []), path, 0.001)
    assert scene.solid.turning is None
    assert scene.solid.vertices.shape == (8, 3)
    assert np.allclose([scene.solid.vertices.min(axis=0), scene.solid.vertices.max(axis=0)], [[0, 1e-3, 3e-3], [2e-3, 3e-3, 5e-3]])
    assert is_closed(scene.solid.faces)
    assert make_state(scene).solid.tri.faces.shape == (12, 3)  # also beside particles that are a wall


@pytest.mark.parametrize(
    ("scene", "center", "edge", "unit", "message"),
    [
        ("dam", (0, 0, 0), 1.0, 1, "triangles are a wall in 3D; dam is in 2D"),
        ("jet", (30, 0, 4), 2.0, 1, "reaches from (29, -1, 3) to (31, 1, 5) m, the scene from (-0.008, -0.008,"),
        ("jet", (0, 0, 0), 9.0, 1, "is 9 m long, from (-4.5, "),
        ("jet", (0, 0, 4), 1e-3, 1e-3, "is 1e-06 m long"),
    ],
)
def test_walls_that_cannot_be_meant_are_refused(tmp_path, scene, center, edge, unit, message):
    path = write_cube(tmp_path / "cube.stl", center, edge)
    assert message in refused("run", scene, "--solid", path, "--solid-unit", unit, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "txt"])
def test_files_that_hold_no_wall_are_refused(tmp_path, ending):
    missing, broken = (tmp_path / f"{name}.{ending}" for name in ("none", "broken"))
    assert f"solid {missing} is no file: name an STL, OBJ or PLY." in refused("run", "jet", "--solid", missing)
    for text in (b"", b"solid\n facet", b"\x00\xff" * 50, b"ply\nformat ascii 1.0\n", b"f 1 2 3\nv 0 0"):
        broken.write_bytes(text)
        said = refused("run", "jet", "--solid", broken)
        assert re.match(rf"solid {broken} (is no mesh that trimesh reads|holds no triangles)", said), said


def test_a_wall_that_is_open_is_refused_before_a_folder_is_made(tmp_path):
    path = write_cube(tmp_path / "open.stl", (1.0, 2.0, 4.0), 2.0, faces=[*range(11), 0])
    said = refused("run", "jet", "--solid", path, "--solid-unit", 0.001, "--out", tmp_path / "run")
    assert "solid must be a closed mesh" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("platform", "particles", "way"), [("cpu", 1000, "pair_sum"), ("gpu", 107_660, "list"), ("gpu", 1_059_712, "pair_sum")]
)
def test_auto_takes_what_was_measured_to_be_faster(platform, particles, way, tmp_path, monkeypatch):
    assert runs.faster_way(platform, particles) == way
    asked = []
    monkeypatch.setattr(runs, "faster_way", lambda *given: asked.append(given) or way)
    made = []
    monkeypatch.setattr(runs.solver, "list_neighbors", lambda *given: made.append(given))
    invoke("four", "--frames", 1, "--set", "duration=0.001", "--no-pictures", "--out", tmp_path)
    assert asked == [("cpu", 4)]
    assert len(made) == (way == "list")


@pytest.mark.parametrize("kind", ["stl", "obj", "ply"])
def test_meshes_are_read(tmp_path, kind):
    vertices, faces = meshes.sphere(2.0, 3)
    path = tmp_path / f"sphere.{kind}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    solid = read_solid(path)
    points, named = solid.vertices, solid.faces
    assert (points.shape, named.shape, named.dtype) == (vertices.shape, faces.shape, np.int32)
    found, given = (np.sort(corners.reshape(len(faces), -1), axis=0) for corners in (points[named], vertices[faces]))
    assert np.allclose(found, given, atol=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_in_one_line_that_name_no_bounds_are_drawn(tmp_path, dim):
    """Such as those of a nozzle in 2D; in 3D one particle beside a solid, which is seen aslant."""
    scene, column = make_scene("block", []), np.array([[0.2, 0.4], [0.2, 0.6]])
    if dim == 3:
        scene, column = replace(scene, spacing=0.1, solid=fluids.Solid(*meshes.cube(0.5, 1))), np.array([[0.2, 0.2, 0.4]])
    scene, there = replace(scene, positions=column, bounds=None), np.ones(len(column), bool)
    frames.draw(scene, there, column, 0 * column, 0.0, 1.0, tmp_path / "frame.png")
    assert plt.imread(tmp_path / "frame.png")[..., :3].std() > 0.05
