"""What users bring and take: own forces, outflow, probes, a run that goes on for longer."""

import json
import subprocess
import sys
from dataclasses import replace

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import pyvista
import trimesh
from checked import refuses, slow
from jax import lax
from jax.tree_util import Partial
from places import ROOT
from poured import changed, scene_of
from test_sph_commands import invoke, read_table
from vtkmodules.vtkIOHDF import vtkHDFReader

import jfrnn
from jfrnn import sph
from jfrnn.cases import fluids
from jfrnn.sph import toml_scenes
from jfrnn.sph.errors import DivergedError, SceneError
from jfrnn.sph.particles import mass_there

FEW = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 20.0]])  # none is near another
PHYSICS = sph.Physics(density=1.0, sound_speed=1.0, smoothing=0.15, pressure="mean", integrator="symplectic")
GIVEN = {"velocities": np.array([[1.0, 0.0], [0.0, 0.0], [0.0, -1.0]]), "masses": np.array([1.0, 2.0, 4.0])}
FREE = scene_of(FEW, 0.1, PHYSICS, name="free", duration=0.5, step=0.01, **GIVEN)


def spring(stiffness, s):
    return -stiffness * s.x


def test_an_own_force_acts_as_it_says_and_its_parameter_is_traced():
    """Free particles on springs."""
    model = sph.make_model(FREE, backend="brute", force=Partial(spring, jnp.asarray(4.0)))
    end, _ = sph.advance(model, sph.begin(model, sph.make_state(FREE)), None, 50)
    t, w = 0.5, 2.0
    np.testing.assert_allclose(end.x, FEW * np.cos(w * t) + FREE.velocities * np.sin(w * t) / w, rtol=1e-3)


@pytest.mark.parametrize(
    ("force", "got"),
    [(lambda s: s.x[0], r"\[2\], float"), (lambda s: None, "NoneType"), (lambda s: lax.complex(s.x, s.x), r"\[3, 2\], complex")],
)
def test_an_own_force_that_returns_something_else_is_refused(force, got):
    message = rf"force must return accelerations \[m/s²\] of shape \[3, 2\], real numbers, got {got}"
    refuses(SceneError, message, sph.begin, sph.make_model(FREE, force=force), sph.make_state(FREE))


@pytest.mark.parametrize("integrator", [slow("symplectic"), "midpoint"])
def test_forces_know_the_time_and_velocities_of_the_positions_they_are_given(integrator):
    """A force of time and velocities, cos 3t - v, is integrated to second order: half the step, a quarter of the error."""
    off = []
    for step in (0.1, 0.05):
        scene = replace(changed(FREE, integrator=integrator), duration=1.0, step=step)
        model = sph.make_model(scene, backend="brute", force=lambda s: jnp.cos(3 * s.time) - s.v)
        end, _ = sph.advance(model, sph.begin(model, sph.make_state(scene)), None, round(1 / step))
        off.append(abs(float(end.v[1, 0]) - (np.cos(3.0) + 3 * np.sin(3.0) - np.exp(-1.0)) / 10))
    assert 0 < off[1] < 0.3 * off[0] < 0.003


def test_a_fluid_that_has_drained_has_empty_frames(tmp_path):
    scene = replace(FREE, outflow=sph.Tank((-1.0, -1.0), (0.3, 0.3)), positions=FEW * 0.01, masses=np.full(3, 1.0))
    scene = replace(scene, velocities=np.array([[5.0, 0.0], [4.0, 0.0], [0.0, 5.0]]))
    sph.run(scene, tmp_path, sph.How(frames=4, pictures=True, hdf=True))
    last = pyvista.read(sorted((tmp_path / "snapshots").glob("*.vtp"))[-1])
    assert last.n_points == 0
    assert {"velocity", "density", "pressure"} <= set(last.point_data)
    with h5py.File(tmp_path / "free.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root["NumberOfPoints"][:].tolist()[0] == 3
        assert root["NumberOfPoints"][:].tolist()[-1] == 0
        assert len(root["Steps/PointDataOffsets/velocity"]) == 5
    (tmp_path / "run.json").unlink()
    refuses(SceneError, "holds snapshots, but no run.json", sph.run, scene, tmp_path, sph.How(frames=4, pictures=False))


def test_probes_and_outflow_meet_particles_in_a_periodic_box():
    """Positions go on beyond it."""
    x = sph.lattice((0.0, 0.0), (10, 10), 0.1)
    box = fluids.Periodic((0.0, 0.0), (1.0, 1.0), (True, True))
    scene = replace(FREE, positions=x, velocities=x * 0 + [1.0, 0.0], masses=np.full(100, 0.01), periodic=box)
    scene = replace(scene, outflow=sph.Tank((-0.01, -0.01), (1.01, 1.01)))
    model, s = sph.make_model(scene, backend="brute"), sph.make_state(scene)
    through, height = sph.flow_through((0.5, 0.5), (1.0, 0.0), 0.2), sph.surface_height((0.5,), 0.2)
    for turns in (0.0, 1.0, -3.0):
        moved = s._replace(x=s.x + jnp.asarray([turns, 0.0], s.x.dtype))
        assert float(through(model, moved)) == pytest.approx(1.0)
        assert float(height(model, moved)) == pytest.approx(0.95)
    end, _ = sph.advance(model, sph.begin(model, s._replace(x=s.x + 1.0)), None, 1)
    assert not np.asarray(end.gone).any()


def test_what_paraview_reads_stays_in_the_periodic_box(tmp_path):
    """Positions of a state go on beyond it, which a run goes on from; a reader sees the box, as in pictures."""
    import pyvista

    box = fluids.Periodic((0.25, 0.0), (1.0, 1.0), (True, False))
    x = np.array([[0.5, 0.5], [1.0, 1.5], [0.25, 0.75]])
    scene = replace(FREE, positions=x, velocities=np.tile([3.0, 0.0], (3, 1)), periodic=box, duration=1.0)
    end = sph.run(scene, tmp_path, sph.How(frames=1, pictures=False))
    clouds = [pyvista.read(path) for path in sorted((tmp_path / "snapshots").glob("*.vtp"))]
    np.testing.assert_array_equal(clouds[0].points[:, :2], x.astype(clouds[0].points.dtype))
    seen = clouds[-1].points
    assert (seen[:, 0] >= 0.25).all() and (seen[:, 0] < 1.25 + 1e-6).all()
    np.testing.assert_allclose(np.asarray(end.x)[:, 0] - seen[:, 0], np.round(np.asarray(end.x)[:, 0] - seen[:, 0]), atol=1e-5)
    np.testing.assert_array_equal(seen[:, 1], np.asarray(end.x)[:, 1].astype(seen.dtype))


def test_who_goes_around_a_periodic_box_stays_in_what_is_sealed(tmp_path):
    box, channel = fluids.Periodic((0.0, 0.0), (1.0, 1.0), (True, False)), sph.Tank((0.0, 0.0), (1.0, 2.0))
    x, v = np.array([[0.5, 0.5], [0.5, 1.0], [0.25, 1.5]]), np.tile([3.0, 0.0], (3, 1))
    scene = replace(FREE, positions=x, velocities=v, periodic=box, sealed=channel)
    end = sph.run(scene, tmp_path / "along", sph.How(frames=1, pictures=False))
    assert (np.asarray(end.x)[:, 0] > 1.0).all()
    across = replace(scene, velocities=np.tile([0.0, 3.0], (3, 1)))
    refuses(
        DivergedError, "particle 2 went through a wall", sph.run, across, tmp_path / "across", sph.How(frames=1, pictures=False)
    )


def test_particles_that_leave_are_gone_and_counted(tmp_path):
    """One of three goes over the border; another one enters later."""
    scene = replace(FREE, outflow=sph.Tank((-1.0, -1.0), (0.3, 30.0)), enters=np.array([0.0, 0.8, 0.0]))
    scene = replace(scene, positions=FEW * [0.5, 1.0], duration=1.0)
    end = sph.run(scene, tmp_path, sph.How(frames=10, pictures=False))
    table = read_table(tmp_path / "energies.csv")
    np.testing.assert_array_equal(table["mass_in"], [5.0] * 8 + [7.0] * 3)
    np.testing.assert_array_equal(table["mass_out"], [0.0] * 4 + [1.0] * 4 + [3.0] * 3)  # 1 kg at 0.3 s, 2 kg at once
    np.testing.assert_array_equal(table["mass"], table["mass_in"] - table["mass_out"])
    np.testing.assert_array_equal(end.gone, [True, True, False])
    np.testing.assert_allclose(end.x[0, 0], 0.31, atol=0.011)  # it rests where it left
    assert table["kinetic"][-1] == pytest.approx(2.0)
    model = sph.make_model(scene)
    np.testing.assert_array_equal(mass_there(model, end), [0.0, 0.0, 4.0])


def test_probes_of_a_lattice():
    """Pressures, a flow and a height that are known of a lattice that moves as one."""
    dx = 0.1
    x = sph.lattice((0.0, 0.0), (10, 10), dx)
    scene = replace(FREE, positions=x, velocities=x * 0 + [3.0, 4.0], masses=np.full(100, 2 * dx**2))
    scene = changed(replace(scene, densities=2.0 + 0.01 * x[:, 1]), density=2.0, state="linear")
    model, s = sph.make_model(scene, backend="brute"), sph.make_state(scene)
    np.testing.assert_allclose(sph.pressure_at([(0.5, 0.5), (9.0, 9.0)])(model, s), [0.005, 0.0], atol=1e-6)
    assert sph.flow_through((0.5, 0.0), (2.0, 0.0), 4 * dx)(model, s) == pytest.approx(2 * 1.0 * 3.0)
    assert sph.surface_height((0.5,), 2 * dx)(model, s) == pytest.approx(0.95)
    force = sph.force_on_walls((0.0, 1.0))(replace(model, force=lambda s: s.x), s._replace(a=s.x - jnp.asarray([1.0, 0.0])))
    np.testing.assert_allclose(force["force"], [2.0, 0.0], atol=1e-12)  # what holds the fluid back is pushed on
    assert force["torque"] == pytest.approx(1.0)
    refuses(SceneError, r"points must have shape \[k, 2\], got \[2\]", sph.pressure_at((0.5, 0.5)), model, s)


def test_the_force_on_walls_knows_what_guides_particles_that_enter():
    """It is that of the same fluid of which no particle is guided."""
    x = sph.lattice((0.0, 0.0), (6, 6), 0.1)
    scene = replace(FREE, positions=x, velocities=x[:, ::-1] ** 2, masses=np.full(36, 0.01), wall=x[:, 1] < 0.2)
    scene = changed(replace(scene, densities=1 + 0.1 * x.sum(axis=1)), viscosity=0.1, gravity=(0.0, -9.81))
    entering, found = replace(scene, enters=np.where(x[:, 0] < 0.3, 0.0, -9.0), guided=1.0), []
    for each in (scene, entering):
        model = sph.make_model(each, backend="brute")
        s = sph.begin(model, sph.make_state(each))
        found.append(np.concatenate(jax.tree.map(np.atleast_1d, list(sph.force_on_walls()(model, s).values()))))
    assert np.abs(found[0]).min() > 0.01
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    model = sph.make_model(changed(scene, integrator="midpoint"), backend="brute")  # whose states at first have no acceleration
    force = sph.force_on_walls()(model, sph.begin(model, sph.make_state(scene)))["force"]
    np.testing.assert_allclose(force, found[0][:2], rtol=1e-9)


@pytest.mark.parametrize(
    ("probe", "message"),
    [
        (sph.flow_through((0.0, 0.0, 0.0), (1.0, 0.0), 0.1), r"point must be 2 finite numbers, got \(0.0, 0.0, 0.0\)"),
        (sph.flow_through((0.0, 0.0), (0.0, 0.0), 0.1), r"normal and width must not be 0, got \(0.0, 0.0\) and 0.1"),
        (sph.flow_through((0.0, 0.0), (1.0, 0.0), 0.0), "normal and width must not be 0"),
        (sph.surface_height((0.1, 0.2), 0.1), r"place must be 1 finite numbers, got \(0.1, 0.2\)"),
        (sph.force_on_walls((0.0, "a")), r"about must be 2 finite numbers, got \(0.0, 'a'\)"),
    ],
)
def test_a_mistake_in_a_probe_is_named(probe, message):
    refuses(SceneError, message, probe, sph.make_model(FREE), sph.make_state(FREE))


@pytest.mark.parametrize(
    ("probes", "message"),
    [
        ([spring], "probes must be a dict of functions by name, got list"),
        ({"a, b": spring}, "probes must be functions by names without a comma, got 'a, b'"),
        ({"a": 1.0}, "probes must be functions by names without a comma, got 'a': 1.0"),
        ({"time": spring}, "probes must not be called 'time'"),
        (
            {"p": lambda model, s: s.time, "a_0": lambda model, s: 1.0, "a": lambda model, s: s.x},
            "probes give two columns 'a_0': take",
        ),
        ({"a": lambda model, s: {"b, c": s.time}}, "probes must return dicts whose keys have no comma, got the column 'a_b, c'"),
        ({"a": lambda model, s: {"b": lax.complex(s.x, s.x)}}, "probes must return real numbers, .* got complex.* column 'a_b'"),
        ({"a": lambda model, s: None}, "probes must return real numbers, arrays or dicts of them, got NoneType for the column 'a'"),
    ],
)
def test_a_mistake_in_probes_is_named(tmp_path, probes, message):
    refuses(SceneError, message, sph.run, FREE, tmp_path / "out", sph.How(pictures=False), probes=probes)
    assert not (tmp_path / "out").exists()


def test_a_run_goes_on_for_longer_and_writes_a_table(tmp_path):
    short, longer = (sph.How(frames=frames, lines=2, pictures=False, dtype="float32") for frames in (1, 2))
    scene, probes = replace(FREE, duration=0.1), {"own": lambda model, s: {"far": s.x[1], "time": s.time}}
    sph.run(scene, tmp_path / "a", short, probes=probes)
    sph.run(replace(scene, duration=0.2), tmp_path / "a", longer, probes=probes)
    sph.run(replace(scene, duration=0.2), tmp_path / "b", longer, probes=probes)
    for name in ("energies.csv", "probes.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    table = read_table(tmp_path / "a" / "probes.csv")
    assert tuple(table) == ("step", "time", "own_far_0", "own_far_1", "own_time")
    np.testing.assert_allclose(table["own_time"], [0, 0.05, 0.1, 0.15, 0.2])
    np.testing.assert_array_equal(table["time"], [0, 0.05, 0.1, 0.15, 0.2])  # what 0.05 of float32 is called, too
    assert 'timestep="0.1"' in (tmp_path / "a" / "free.pvd").read_text()
    assert json.loads((tmp_path / "a" / "run.json").read_text())["duration"] == 0.2
    with pytest.raises(SceneError, match="holds a run with another duration, frames"):
        sph.run(replace(scene, duration=0.3), tmp_path / "a", short, probes=probes)


def test_probes_of_another_table_are_refused_before_the_run_goes_on(tmp_path):
    """A column of a probe is called as the probe is: a unit stands where the library knows it."""
    scene, how = replace(FREE, duration=0.1), sph.How(frames=1, pictures=False)
    probes = {name: lambda model, s: s.time for name in ("mass_flow", "second")}
    sph.run(scene, tmp_path, how, probes=probes)
    assert (tmp_path / "probes.csv").read_text().splitlines()[0] == "step,time [s],mass_flow,second"
    there = (tmp_path / "energies.csv").read_bytes()
    longer, more, fewer = replace(scene, duration=0.2), replace(how, frames=2), {"second": probes["second"]}
    refuses(SceneError, r"has the columns .*,second, and this run .*\]", sph.run, longer, tmp_path, more, probes=fewer)
    assert (tmp_path / "energies.csv").read_bytes() == there


def test_a_folder_is_of_one_run_at_a_time_until_its_process_ends(tmp_path):
    """Another process holds it as a run does, and is killed."""
    how = sph.How(frames=1, pictures=False)
    code = "import fcntl; file = open('lock', 'a'); fcntl.flock(file, fcntl.LOCK_EX); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        refuses(SceneError, f"^{tmp_path}: another run writes there now; wait until it ends, or take", sph.run, FREE, tmp_path, how)
        other.kill()
    sph.run(FREE, tmp_path, how)


FLOWING = scene_of(
    fluids.lattice((0.0, 0.0), (4, 4), 0.1), 0.1, fluids.Physics(density=1000.0, sound_speed=10.0, smoothing=0.15), duration=0.01
)


@pytest.mark.parametrize(
    "change",
    [
        {"periodic": fluids.Periodic((0.0, 0.0), (0.8, 0.8), (True, True))},
        {"outflow": fluids.Tank((-np.inf, -np.inf), (0.2, np.inf))},
        {"enters": np.full(16, 0.005), "guided": 0.01},
        {"wall": np.arange(16) < 4},
        {"spacing": 0.11},
        {"solid": fluids.Solid(np.array([[2.0, 0], [3, 0], [2, 1]]), np.array([[0, 1], [1, 2], [2, 0]]))},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_run_of_a_scene_that_differs_in_anything_is_another(tmp_path, change):
    how = sph.How(frames=1, pictures=False)
    sph.run(FLOWING, tmp_path, how)
    sph.run(replace(FLOWING, bounds=fluids.Tank((0.0, 0.0), (9.0, 9.0))), tmp_path, how)  # what pictures show may change
    refuses(SceneError, f"holds a run with another {next(iter(change))}", sph.run, replace(FLOWING, **change), tmp_path, how)


BATH = """
spacing = 0.1
duration = 0.01
step = 0.005

[physics]
density = 1000.0
sound_speed = 10.0
gravity = [0.0, -9.81]

[[fill]]
lower = [0.0, 0.0]
upper = [0.4, 0.3]
velocity = [0.5, 0.0]

[[walls]]
lower = [0.0, 0.0]
upper = [0.8, 0.5]
open = ["+y"]

[[inflow]]
lower = [0.0, 0.5]
upper = [0.1, 0.6]
velocity = [0.0, -1.0]
duration = 0.3
"""


def test_a_scene_from_a_file(tmp_path):
    (tmp_path / "bath.toml").write_text(BATH.replace("lower = [0.0, 0.0]", "lower = [0, 0]"))
    scene = sph.read_scene(tmp_path / "bath.toml")
    dummies = (8 + 2 * 3) * (5 + 3) - 8 * 5  # three layers, none above
    assert (scene.name, scene.n, scene.wall.sum()) == ("bath", 12 + 3 + dummies, dummies)
    np.testing.assert_allclose(scene.enters[:15], [0.0] * 12 + [0.0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_array_equal(scene.velocities[[0, 12, -1]], [[0.5, 0.0], [0.0, -1.0], [0.0, 0.0]])
    assert scene.positions[scene.wall].min() == pytest.approx(-0.25)
    assert (scene.physics.smoothing, scene.physics.gravity) == (pytest.approx(0.15), (0.0, -9.81))
    code, out, told = invoke("run", tmp_path / "bath.toml", "--frames", 1, "--no-pictures", "--out", tmp_path / "out")
    assert (code, out.strip()) == (0, str(tmp_path / "out"))
    assert told.strip().endswith(" J/m")  # in 2D, as the table has it
    head = (tmp_path / "out" / "energies.csv").read_text().splitlines()[0]
    assert head.startswith("step,time [s],kinetic [J/m],potential [J/m],momentum_x [kg/s],") and ",mass_in [kg/m]," in head
    series = (tmp_path / "out" / "bath.pvd").read_text()
    assert '<DataSet timestep="0.01" file="snapshots/000000002.vtp"/>' in series and series.count("<DataSet") == 2
    assert json.loads((tmp_path / "out" / "run.json").read_text())["made_by"]["jfrnn"] == jfrnn.__version__


def test_all_snapshots_go_into_one_file_that_paraview_reads(tmp_path, monkeypatch):
    """Also where a run was stopped and its series was left half written, and where it is asked for when the run has ended."""
    (tmp_path / "bath.toml").write_text(BATH + "[output]\ninterval = 0.005\nhdf = true\n")
    options = ("run", tmp_path / "bath.toml", "--no-pictures", "--out", tmp_path)
    assert invoke(*options)[0] == 0

    def check():
        reader = vtkHDFReader()
        reader.SetFileName(str(tmp_path / "bath.vtkhdf"))
        reader.UpdateInformation()
        frames = sorted((tmp_path / "snapshots").glob("*.vtp"))
        assert reader.GetNumberOfSteps() == len(frames) == 3
        for step, path in enumerate(frames):
            reader.SetStep(step)
            reader.Update()
            assert reader.GetTimeValue() == step * 0.005
            seen, cloud = pyvista.wrap(reader.GetOutputDataObject(0)), pyvista.read(path)
            np.testing.assert_array_equal(seen.points, cloud.points)
            np.testing.assert_array_equal(seen.verts, cloud.verts)
            assert set(seen.point_data) == set(cloud.point_data) == {"velocity", "density", "pressure", "wall"}
            for name, array in cloud.point_data.items():
                np.testing.assert_array_equal(seen.point_data[name], array)

    check()
    (tmp_path / "snapshots" / "000000002.npz").unlink()  # goes on from step 1
    assert invoke(*options)[0] == 0
    check()
    with h5py.File(tmp_path / "bath.vtkhdf", "r+") as file:
        file.attrs["whole"] = False
        file["VTKHDF/Points"][...] = 0
    assert invoke(*options)[0] == 0
    check()
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert "hdf: a file .vtkhdf is written by h5py, which is not installed: pip install h5py" in invoke(*options)[2]
    assert invoke(*options, "--no-hdf")[0] == 0


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"frames": 0}, r"frames: got 0; input should be greater than or equal to 1 \(from 1 to 1 000 000\)"),
        ({"frames": "few"}, "frames: got 'few'; input should be a valid integer"),
        ({"skin": -1.0}, "skin: got -1.0; input should be greater than or equal to 0.01"),
        ({"neighbors": "verlet"}, "neighbors: got 'verlet'; input should be 'auto', 'pair_sum' or 'list'"),
        ({"pictures": "some"}, "pictures: got 'some'; input should be a valid boolean"),
    ],
)
def test_a_mistake_in_how_a_scene_is_run_is_named(told, message):
    refuses(SceneError, message, sph.How, **told)


@pytest.mark.parametrize("dtype", ["foo", "float16"])
def test_a_dtype_that_is_none_is_named(tmp_path, dtype):
    refuses(SceneError, f"dtype must be float32 or float64, got {dtype}", sph.run, FREE, tmp_path / "out", sph.How(dtype=dtype))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("interval = 0.004", "output.interval: a duration of 0.01 s is no whole number of 0.004 s"),
        ("interval = 0.005\nframes = 2", "output: has an interval and frames, of which one says all"),
        ("frames = 0", "output.frames: input should be greater than or equal to 1, got 0"),
    ],
)
def test_a_mistake_in_what_is_written_is_named(tmp_path, more, message):
    (tmp_path / "bath.toml").write_text(BATH + f"[output]\n{more}\n")
    assert f"bath.toml: {message}" in invoke("run", tmp_path / "bath.toml", "--out", tmp_path / "out")[2]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("spacing = 0.1", "spacing = -0.1", "spacing: input should be greater than 0, got -0.1"),
        ("spacing = 0.1", "spacing = true", "spacing: input should be a valid number, got True"),
        ("upper = [0.4, 0.3]", 'upper = [0.4, "0.3"]', r"fill\[0\].upper\[1\]: input should be a valid number, got '0.3'"),
        ("spacing = 0.1", "spacing = ", "is no TOML"),
        ("step = 0.005", "steps = 0.005", "steps: extra inputs are not permitted"),
        ("sound_speed = 10.0", "sound = 10.0", "physics: got an unexpected keyword argument 'sound'"),
        ("density = 1000.0", "density = -1.0", "physics.density: got -1.0; input should be greater than 0"),
        ("density = 1000.0", "cfl = 0.0\ndensity = 1000.0", "physics.cfl: got 0.0; input should be greater than 0"),
        ("density = 1000.0", 'density = "1000"', "physics.density: got '1000'; input should be a valid number"),
        ("density = 1000.0", 'slip = "no"\ndensity = 1.0', "physics.slip: got 'no'; input should be a valid boolean"),
        ("density = 1000.0", 'kernel = "gauss"\ndensity = 1.0', "physics.kernel: got 'gauss'; input should be 'cubic', "),
        ("upper = [0.4, 0.3]", "upper = [0.04, 0.3]", "fill: from .* there is no room for particles 0.1 m apart"),
        ("upper = [0.4, 0.3]", "upper = [1e300, 1e300]", "fill: asks for inf particles, expected up to 1e.08"),
        ("velocity = [0.5, 0.0]", "velocity = [0.5]", "fill.velocity must have 2 numbers"),
        ('open = ["+y"]', 'open = ["up"]', r"walls\[0\].open\[0\]: input should be '-x', "),
        ("density = 1000.0", "smoothing = 150000\ndensity = 1000.0", "smoothing is 1.5e.05 m, expected 0.1 to 50 particle"),
        ("[0.0, -9.81]", "[0.0, 0.0, -9.81]", "gravity has 3 components, expected 2 in 2D"),
        ("velocity = [0.0, -1.0]", "velocity = [0.0, 0.0]", "inflow.velocity must have 2 numbers that are not all 0"),
        ("upper = [0.1, 0.6]", "upper = [0.1, 0.7]", "inflow must be one spacing of 0.1 m thick along y"),
        ("duration = 0.3", "duration = 0.03", "inflow.duration: in 0.03 s not one layer enters, which takes 0.1 s"),
        ('open = ["+y"]', 'open = ["+z"]', r"walls.open: in 2D there is no side '\+z'"),
        ("upper = [0.4, 0.3]", "upper = [0.4, 0.3]\nunit = 0.001", "fill: name a lower and an upper corner, or a file, which may"),
        ("upper = [0.4, 0.3]", 'upper = [0.4, 0.3]\nfile = "a.stl"', "fill: has corners and file 'a.stl', of which one says all"),
        (
            "upper = [0.4, 0.3]",
            "upper = [0.9, 0.3]",
            r"fill, inflow and walls overlap: the particle at \(0.85, 0.05\) m is within 0.4",
        ),
        ("[[fill]]", "[bounds]\nlower = [-inf, 0.0]\nupper = [1.0, 1.0]\n[[fill]]", "bounds must be finite"),
        (
            "[[fill]]",
            '[periodic]\nlower = [0.0, 0.0]\nupper = [1.0, 1.0]\naxes = "xz"\n[[fill]]',
            "periodic.axes must name axes of",
        ),
    ],
)
def test_a_mistake_in_a_file_is_named(tmp_path, old, new, message):
    (tmp_path / "bath.toml").write_text(BATH.replace(old, new))
    refuses(SceneError, rf"bath\.toml: {message}", sph.read_scene, tmp_path / "bath.toml")


@pytest.mark.parametrize("what", ["fill", "inflow"])
def test_a_file_that_asks_for_too_many_particles_is_refused(tmp_path, monkeypatch, what):
    few = BATH.replace("upper = [0.4, 0.3]", "upper = [0.1, 0.1]").replace("duration = 0.3", "duration = 1.2")
    (tmp_path / "bath.toml").write_text(BATH if what == "fill" else few)
    monkeypatch.setattr(toml_scenes, "_MOST", 10)
    with pytest.raises(SceneError, match=f"{what}: asks for 12 particles, expected up to 1e.01: take a larger spacing"):
        sph.read_scene(tmp_path / "bath.toml")


BLOCK = """
spacing = 0.1
duration = 0.01

[physics]
density = 1000.0
sound_speed = 10.0

[[fill]]
lower = [0.0, 0.0, 0.0]
upper = [0.4, 0.4, 0.3]
"""


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[fill]]\nfile = "open.stl"', "fill: open.stl must be a closed mesh"),
        ('[[fill]]\nfile = "cube.stl"\nunit = 0.001', "fill: in cube.stl there is no room for particles 0.1 m apart"),
        ('[solid]\nfile = "cube.stl"\nunit = 0.001', "solid .*cube.stl: is 0.0004 m long, .*; name the unit of the file"),
        ('[solid]\nfile = "cube.stl"\naxis = [0.0, 0.0, 1.0]', "solid: has a center or an axis, and no rate"),
        ('[solid]\nfile = "cube.stl"\nrate = 1.0', "solid.turning.axis must have a number for each of 3 axes, got NoneType None"),
    ],
)
def test_a_mistake_in_a_mesh_of_a_file_is_named(tmp_path, more, message):
    cube = trimesh.creation.box((0.4, 0.4, 0.4))
    cube.export(tmp_path / "cube.stl")
    trimesh.Trimesh(cube.vertices, cube.faces[1:]).export(tmp_path / "open.stl")
    (tmp_path / "block.toml").write_text(BLOCK + more)
    refuses(SceneError, rf"block\.toml: {message}", sph.read_scene, tmp_path / "block.toml")


def test_layers_that_enter_aslant_are_a_spacing_apart(tmp_path):
    """So that what enters has the density of the fluid, too."""
    (tmp_path / "bath.toml").write_text(BATH.replace("velocity = [0.0, -1.0]", "velocity = [1.0, -1.0]"))
    scene = sph.read_scene(tmp_path / "bath.toml")
    np.testing.assert_allclose(scene.enters[12:15], [0.0, 0.1, 0.2], atol=1e-12)  # of which each has gone on by 0.1 m along y
    np.testing.assert_allclose(scene.guided[12:15], 0.3)


def test_what_enters_holds_nothing_but_its_own_velocity(tmp_path):
    """Water that is there at first falls from the first step on, and each inflow is guided for as long as its own layers take."""
    slow = BATH.partition("[[inflow]]")[2].replace("0.1", "0.8").replace("[0.0, 0.5]", "[0.7, 0.5]").replace("-1.0", "-0.5")
    (tmp_path / "bath.toml").write_text(f"{BATH}[[inflow]]{slow}")
    scene = sph.read_scene(tmp_path / "bath.toml")
    np.testing.assert_allclose(scene.guided[:16], [0.0] * 12 + [0.3] * 3 + [0.6])
    model = sph.make_model(scene)
    end, *_ = sph.advance_until(model, sph.begin(model, sph.make_state(scene)), None, 0.01)
    assert np.abs(end.v[:12] - scene.velocities[:12]).max(axis=1).min() > 1e-3
    np.testing.assert_array_equal(end.v[12:16], scene.velocities[12:16])


def test_the_file_of_the_page_is_a_scene(tmp_path):
    text = (ROOT / "docs" / "own-scene.md").read_text(encoding="utf-8")
    (tmp_path / "page.toml").write_text(text.partition("```toml\n")[2].partition("```")[0])
    assert sph.read_scene(tmp_path / "page.toml").outflow == sph.Tank((-np.inf, -np.inf), (1.0, np.inf))
