"""What a scene does not have is no part of its program: operations and bytes of pairs of scenes that differ in one part."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from poured import changed, scene_of

from jfrnn.cases import fluids
from jfrnn.sph import solver
from jfrnn.sph.model import make_model, make_state

N = 64
SITES = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1).reshape(-1, 2) / 8
BARE = scene_of(SITES, 1 / 8, fluids.Physics(density=1.0, sound_speed=10.0, smoothing=1 / 8, state="linear"), step=1e-3)
PARTS = {
    "viscosity": {"viscosity": 0.1},
    "artificial viscosity": {"artificial": 0.1},
    "density diffusion": {"density_diffusion": 0.1},
    "cohesion": {"tension": 1.0},
    "surface tension": {"surface_tension": 1.0},
    "damping": {"damping": 1.0},
    "gravity": {"gravity": (0.0, -1.0)},
    "transport velocity": {"transport": 1.0},
    "shifting": {"shifting": 0.1},
    "correction": {"corrected": True},
    "Tait's equation": {"state": "tait"},
}
CORNERS = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
FRAME = fluids.Solid(CORNERS, np.array([[1, 0], [2, 1], [3, 2], [0, 3]], np.int32))
WHOLE = {
    "walls": replace(BARE, wall=np.arange(N) < 8),
    "tank": changed(replace(BARE, tank=fluids.Tank((0.0, 0.0), (1.0, 1.0))), restitution=0.5),
    "periodicity": replace(BARE, periodic=fluids.Periodic((0.0, 0.0), (1.0, 1.0), (True, True))),
    "inflow": replace(BARE, enters=np.linspace(0, 1, N)),
    "a Courant step": replace(BARE, step=None),
    "a solid": replace(BARE, solid=FRAME),
    "a solid that turns": replace(BARE, solid=replace(FRAME, turning=fluids.Turning((0.5, 0.5), None, 1.0))),
    **{name: changed(BARE, **change) for name, change in PARTS.items()},
}


def traced(scene, skin=None):
    model, s = make_model(scene, backend="brute"), make_state(scene)
    nbrs = None if skin is None else solver.list_neighbors(model, s, skin)
    return jax.jit(solver.step).trace(model, s, nbrs), (model, s, nbrs)


def operations(program):
    """Return how many operations are traced, those inside others and inside sums over pairs included."""
    return str(program.jaxpr).count(" = ")


@pytest.fixture(scope="module")
def bare():
    return traced(BARE)


@pytest.mark.parametrize("part", WHOLE)
def test_a_part_that_is_left_out_takes_no_operation(bare, part):
    program, given = traced(WHOLE[part])
    assert operations(program) > operations(bare[0])
    more = len(jax.tree.leaves(given)) - len(jax.tree.leaves(bare[1]))
    numbers = {"walls": 1, "tank": 3, "periodicity": 2, "inflow": 2, "a Courant step": -1, "correction": 0, "Tait's equation": 0}
    numbers |= {"a solid": 12, "a solid that turns": 12 + 1 + 2}  # the list of triangles, what is seen; the angle, center, rate
    carried = {"transport velocity": 1, "shifting": 1}
    assert more == numbers.get(part, 1 + carried.get(part, 0))  # no array that nobody reads


def test_the_bare_program_holds_no_trace_of_other_parts(bare):
    text = bare[0].lower().as_text()
    for operation in ("power", "select_and_", "floor", "round_nearest", "sort"):  # Tait; images; cells, lists
        assert f"stablehlo.{operation}" not in text, operation


@pytest.mark.slow
@pytest.mark.parametrize("part", ["walls", "viscosity", "correction"])
def test_compiled_programs_are_larger_with_a_part(bare, part):
    without, having = (program.lower().compile() for program in (bare[0], traced(WHOLE[part])[0]))
    assert having.cost_analysis()["flops"] > without.cost_analysis()["flops"]
    assert needed(having) >= needed(without)


def needed(compiled):
    """Return the bytes of arguments, results and scratch."""
    memory = compiled.memory_analysis()
    return memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes


def test_no_skin_keeps_no_reference_positions():
    (_, (_, _, none)), (_, (_, _, listed)) = traced(BARE), traced(BARE, skin=0.01)
    assert jax.tree.leaves(none) == []
    assert [leaf.shape for leaf in jax.tree.leaves(listed.verlet.positions)] == [(N, 2)]


def test_two_dimensions_compute_two_components(bare):
    assert "x3xf64" not in bare[0].lower().as_text()


def test_products_of_matrices_take_all_bits():
    """What a GPU makes of them by itself has 10 bits less."""
    scene = changed(WHOLE["walls"], gravity=(0.0, -1.0), viscosity=0.1, corrected=True)
    text = traced(scene)[0].lower().as_text()
    precisions = {line.split("precision = ")[1].split("]")[0] for line in text.splitlines() if "stablehlo.dot" in line}
    assert precisions == {"[HIGHEST, HIGHEST"}
