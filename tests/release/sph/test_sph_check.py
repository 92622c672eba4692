"""A scene that was made in Python is refused by the same sentences as one of the command line, wherever it enters."""

from dataclasses import replace

import numpy as np
import pytest
from checked import refuses
from poured import scene_of
from test_sph_run import write_cube

from jfrnn.cases import fluids
from jfrnn.sph import check_scene, make_model, make_scene, make_state, with_solid
from jfrnn.sph.errors import SceneError

PHYSICS = fluids.Physics(density=1000.0, sound_speed=10.0, smoothing=0.15, gravity=(0.0, -9.81))
POSITIONS = np.random.default_rng(0).random((5, 2))
SCENE = scene_of(POSITIONS, 0.1, PHYSICS)
BOX = fluids.Tank((0.0, 0.0), (1.0, 1.0))
CORNERS, SIDES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1], [1, 2], [2, 0]])


def turning(center=(0.0, 0.0), rate=1.0):
    return fluids.Solid(CORNERS, SIDES, fluids.Turning(center, None, rate))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": POSITIONS.tolist()}, r"positions must be an array of shape \[n, d\], got list .*: take numpy.asarray"),
        ({"positions": POSITIONS[:, :1]}, r"positions must be an array of shape \[n, 2\] or \[n, 3\], got an array of shape"),
        ({"positions": POSITIONS * np.nan}, "positions are not finite: particle 0 is not"),
        ({"velocities": np.zeros((4, 2))}, r"velocities must be an array of shape \[5, 2\], as positions say.* got an array"),
        ({"masses": 1.0}, r"masses must be an array of shape \[5\], as positions say, got float 1.0"),
        ({"masses": np.arange(5.0)}, "masses must be above 0: particle 0 has 0.0"),
        ({"wall": np.zeros(5)}, r"wall must be an array of shape \[5\], bool, or None, got an array of shape \[5\], float64"),
        ({"wall": np.ones(5, bool)}, "wall: there is no particle of fluid"),
        ({"enters": np.zeros(4)}, r"enters must be an array of shape \[5\]"),
        ({"duration": 0.0}, "duration must be a finite number above 0, got 0.0"),
        ({"duration": "1"}, "duration must be a number, got str '1'"),
        ({"spacing": np.inf}, "spacing must be a finite number above 0, got inf"),
        ({"step": -1.0}, "step must be a finite number above 0, got -1.0"),
        ({"step": 1e-12}, "step: takes steps of 1e-12 s for 1 s, expected up to"),
        (
            {"duration": 1e20},
            r"step: takes steps of 0\.00375 s for 1e\+20 s, expected up to 1e\+09 steps, as smoothing, sound_speed",
        ),
        ({"physics": replace(PHYSICS, viscosity=1e20)}, "step: takes steps of 2.81e-23 s for 1 s, expected up to 1e.09 steps, as"),
        ({"physics": replace(PHYSICS, exponent=1e-20)}, r"physics.exponent: got 1e-20; .*\(from 1 to 1 000\)"),
        ({"tank": fluids.Tank((0.0,) * 3, (1.0,) * 3)}, r"tank.lower must have a number for each of 2 axes, got tuple \(0"),
        ({"tank": fluids.Tank((0.0, 0.0), (0.6, 1.0))}, r"tank must hold all particles, but particle 0 is at \[0.636\d*, 0.269"),
        ({"outflow": ((0.0, 0.0), (1.0, 1.0))}, r"outflow must be a Tank or None, got tuple \(\(0.0, 0.0\), \(1.0, 1.0\)\)"),
        ({"bounds": fluids.Tank(None, None)}, "bounds.lower must have a number for each of 2 axes, got NoneType None"),
        ({"physics": {"density": 1000.0}}, "physics must be a Physics, got dict"),
        ({"name": "a/b"}, "name must be a text without '/', which files are called by, got str 'a/b'"),
        ({"name": ".."}, "name must be a text without '/', which files are called by, got str '..'"),
        (
            {"tank": BOX, "periodic": fluids.Periodic((0.0, 0.0), (1.0, 1.0), (False, True))},
            r"tank must be infinite along axes that are periodic, \(False, True\), got Tank",
        ),
        ({"guided": -1.0}, "guided must be a finite number above 0, got -1.0"),
        ({"guided": np.array([1.0, -1.0, 0.0, 0.0, 0.0])}, "guided must be finite numbers from 0, got from -1.0 to 1.0"),
        ({"guided": np.zeros(3)}, r"guided must be an array of shape \[\] or \[5\], as positions say, real numbers, got an array"),
        ({"sealed": fluids.Tank((1.0, 0.0), (0.0, 1.0))}, "sealed must reach from a lower to an upper corner"),
        ({"periodic": fluids.Periodic((0.0, 0.0), (1.0, 1.0), (True,))}, "periodic.axes must say of each of 2 axes"),
        ({"periodic": fluids.Periodic((0.0, 0.0), (1.0, 1.0, 1.0), (True, True))}, "periodic.lengths must have a number for each"),
        ({"periodic": fluids.Periodic(0.0, (1.0, 1.0), (True, True))}, "periodic.lower must have a number for each"),
        ({"periodic": fluids.Periodic((0.0, 0.0), (1.0, 0.0), (True, True))}, "periodic must have .* finite lengths above 0"),
        ({"periodic": fluids.Periodic((0.0, 0.0), (1.0, 1.0), True)}, "periodic.axes must say of each of 2 axes"),
        ({"bounds": fluids.Tank((-np.inf, 0.0), (1.0, 1.0))}, "bounds must be finite, for they are what pictures show"),
        ({"solid": fluids.Solid(np.zeros((3, 2)), np.array([[0, 1], [1, 3]]))}, "solid.faces must be whole numbers from 0 to 2"),
        ({"solid": fluids.Solid(CORNERS, SIDES[:0])}, "solid.faces has no face"),
        ({"solid": fluids.Solid(CORNERS, SIDES, (0.0, 1.0))}, r"solid.turning must be a Turning or None, got tuple \(0.0, 1.0\)"),
        ({"solid": turning(rate=np.nan)}, "solid.turning.rate must be a finite number, got nan"),
        ({"solid": turning(rate="fast")}, "solid.turning.rate must be a number, got str 'fast'"),
        ({"solid": turning(center=1.0)}, "solid.turning.center must have a number for each of 2 axes, got float 1.0"),
        ({"solid": turning(center=(0.0, np.inf))}, r"solid.turning.center must be finite, got \(0.0, inf\)"),
        ({"physics": replace(PHYSICS, gravity=(0.0, 0.0, -9.81))}, "gravity has 3 components, expected 2 in 2D"),
        ({"physics": replace(PHYSICS, kernel="gauss")}, r"physics.kernel: got 'gauss'; input should be 'cubic', "),
        ({"physics": replace(PHYSICS, density=-1.0)}, r"physics.density: got -1.0; input should be greater than 0 \(above 0\)"),
        ({"physics": replace(PHYSICS, viscosity=np.float64(np.nan))}, "physics.viscosity: got nan; input should be a finite"),
        ({"physics": replace(PHYSICS, smoothing=0.15e-3)}, "smoothing is 0.00015 m, expected 0.1 to 50 particle spacings of 0.1 m"),
        (
            {
                "physics": replace(PHYSICS, kernel="quintic"),
                "positions": np.array([[0.5, 0.05], [0.5, -0.05], [0.5, -0.15], [0.5, -0.25], [0.6, 0.05]]),
                "wall": np.array([False, True, True, True, False]),
                "sealed": BOX,
            },
            "physics.kernel 'quintic' reaches 3 smoothing lengths, 0.45 m, but a wall of dummies is 0.3 m thick: take a",
        ),
    ],
)
def test_a_mistake_in_a_scene_is_named(change, message):
    check_scene(SCENE)
    for act in (check_scene, make_model, make_state):
        refuses(SceneError, message, act, replace(SCENE, **change))


def test_thermal_energies_are_not_below_0():
    about = {name: getattr(SCENE, name) for name in ("name", "positions", "velocities", "masses", "spacing", "duration", "step")}
    gas = fluids.GasScene(**about, energies=np.arange(5.0), physics=fluids.Gas(1.4, 1.3))
    check_scene(gas)
    refuses(SceneError, r"energies must not be below 0: particle 0 has -1\.0", check_scene, replace(gas, energies=gas.energies - 1))


def test_what_is_no_scene_is_refused():
    refuses(SceneError, "scene must be a FluidScene or a GasScene, got an array", make_model, POSITIONS)


def test_transport_and_shifting_are_refused_together():
    scene = replace(SCENE, physics=replace(PHYSICS, transport=9.0, shifting=0.1))
    refuses(SceneError, "transport and shifting both move particles .*, got 9.0 and 0.1: take one of them", make_model, scene)


def test_a_solid_that_lies_beside_the_first_particles_is_taken(tmp_path):
    """A block that falls on a cube 3 cm under it."""
    positions = fluids.lattice((0.0,) * 3, (4, 4, 4), 0.01)
    block = replace(SCENE, positions=positions, velocities=0 * positions, masses=np.ones(64), spacing=0.01)
    block = replace(block, physics=replace(PHYSICS, smoothing=0.015, gravity=(0.0, 0.0, -9.81)))
    under = write_cube(tmp_path / "cube.stl", (0.02, 0.02, -0.05), 0.04)
    assert with_solid(block, under).solid.vertices.max(axis=0)[2] == pytest.approx(-0.03)
    refuses(SceneError, r"reaches from .*; move it there, or name the unit of the file", with_solid, block, under, 20.0)


def test_particles_that_float32_has_left_on_a_wall_are_taken():
    """Whoever begins with the end of another run has them."""
    block = make_scene("block", {})
    x = block.positions.copy()
    x[0, 1] = np.float32(block.tank.lower[1])
    assert x[0, 1] < block.tank.lower[1]
    check_scene(replace(block, positions=x))


@pytest.mark.parametrize(("length", "mass"), [(1e-9, 1e-15), (1e10, 1e15), (1e-6, 1e-30), (1e6, 1e30)])
def test_numbers_beyond_a_dtype_are_refused(length, mass):
    """In float32 kernels of such lengths lose digits or are 0, and with them forces, without a word."""
    scene = scene_of(
        length * POSITIONS, 0.1 * length, replace(PHYSICS, smoothing=0.15 * length), masses=np.full(5, mass), duration=length
    )
    assert make_model(scene, np.float64).m[0] == mass
    message = "spacing .* m and masses from .* kg are beyond float32 in sums over pairs: take float64, or units"
    refuses(SceneError, message, make_model, scene, np.float32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": POSITIONS + 1e5}, r"positions reach 100001 m, where float32 knows them to 0\.00781 m, expected to"),
        ({"duration": 1e6}, r"duration is 1e\+06 s, whose end float32 knows to 0\.0625 s, while no step is longer than 0\.00375"),
        ({"duration": 1e-50}, "duration is 1e-50 s, whose end float32 knows to"),
    ],
)
def test_what_float32_cannot_tell_from_what_is_next_to_it_is_refused(change, message):
    """Particles would fall onto each other, and a run would never come to its end."""
    scene = replace(SCENE, **change)
    assert make_model(scene, np.float64).m[0] == scene.masses[0]
    refuses(SceneError, message + ".*, or take float64", make_model, scene, np.float32)
