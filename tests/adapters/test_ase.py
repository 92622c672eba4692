"""`jfrnn.ase`: one structure after another on the host, against the oracle, and against its peers where they are installed."""

import collections
import importlib
import itertools
import tomllib
from types import SimpleNamespace

import checked
import numpy as np
import pytest
import reference
from checked import refuses, slow
from places import ROOT
from started import run_python

import jfrnn.ase
import jfrnn.matscipy
import jfrnn.vesin
from jfrnn.ase import neighbor_list, primitive_neighbor_list
from jfrnn.cases.periodic import PERIODIC_CASES

pytestmark = pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning:ase")  # in ASE 3.29 itself


def as_set(i, j, s):
    assert (np.diff(i) >= 0).all()
    return checked.as_set(i, j, s)


def in_3d(points, matrix, periodic):
    more = 3 - points.shape[1]
    rows = matrix if matrix.ndim == 2 else np.diag(matrix)
    return np.pad(points, ((0, 0), (0, more))), np.pad(rows, ((0, more), (0, more))), (*periodic, *[False] * more)


ODD, EVEN = (list(PERIODIC_CASES)[k::2] for k in (1, 0))


@pytest.mark.parametrize(
    ("dtype", "dim", "names"),
    [
        pytest.param(np.float32, 2, ODD, id="f32-2d-odd"),
        pytest.param(np.float64, 3, EVEN, id="f64-3d-even"),
        slow(np.float32, 2, EVEN, id="f32-2d-even"),
        slow(np.float64, 3, ODD, id="f64-3d-odd"),
    ],
)
def test_hard_cases(dtype, dim, names):
    """In float64, whatever the dtype of what is given."""
    for name in names:
        case = PERIODIC_CASES[name]
        given = case.build(dtype, dim)
        points, rows, periodic = in_3d(given.positions.astype(np.float64), given.matrix.astype(np.float64), given.periodic)
        cutoff = float(dtype(given.cutoff))
        if not np.isfinite(points).all():
            refuses(ValueError, "positions must be finite", primitive_neighbor_list, "i", periodic, rows, points, cutoff)
            points = points[np.isfinite(points).all(axis=1)]
        i, j, s, vectors, d = primitive_neighbor_list("ijSDd", periodic, rows, points, cutoff)
        assert as_set(i, j, s) == reference.reference_images(points, cutoff, matrix=rows, periodic=periodic), name
        size = np.abs(points).max(initial=0) + np.abs(s).max(initial=0) * np.abs(rows).max()
        np.testing.assert_allclose(vectors, points[j] - points[i] + s @ rows, atol=1e-14 * size)
        np.testing.assert_allclose(d, np.linalg.norm(vectors, axis=1), rtol=1e-14)


CELLS = {
    "tiny": (np.eye(3) * 0.7, (True, True, True)),
    "left-handed": (np.array([[0, 2.0, 0], [1.5, 0, 0], [0.25, 0.5, 1.25]]), (True, True, True)),
    "unreduced": (np.array([[1.0, 0, 0], [17.0, 1.0, 0], [-23.0, 41.0, 1.5]]), (True, True, True)),
    "very skewed": (np.array([[1.0, 0, 0], [1e3, 1.0, 0], [3.0, -2e4, 2.0]]), (True, True, True)),
    "slab": (np.array([[1.25, 0.25, 0], [0.5, 1.0, 0], [0, 0, 0]]), (True, True, False)),
    "wire": (np.array([[0, 0, 0], [0.75, 0.5, 1.0], [0, 0, np.nan]]), (False, True, False)),
    "skewed slab": (np.array([[1.0, 0.5, 0.25], [0, 0, 0], [900.5, 451.0, 227.5]]), (True, False, True)),
    "open": (np.zeros((3, 3)), (False, False, False)),
}


@pytest.mark.parametrize("name", CELLS)
def test_cells(name):
    """On a lattice of quarters, so that distances at the cutoff are many, and far from the cell."""
    cell, pbc = CELLS[name]
    rng = np.random.default_rng(5)
    x = np.round(4 * rng.uniform(-1, 1, (8, 3)) * np.array([1, 3, 2])) / 4
    x = x + np.where(rng.random((8, 1)) < 0.3, np.where(np.array(pbc), rng.integers(-9, 9, (8, 3)), 0) @ np.nan_to_num(cell), 0)
    for cutoff in (0.25, 1.0, 1.75):
        expected = reference.reference_images(x, cutoff, matrix=np.nan_to_num(cell), periodic=pbc)
        assert as_set(*primitive_neighbor_list("ijS", pbc, cell, x, cutoff)) == expected
        own = as_set(*primitive_neighbor_list("ijS", pbc, cell, x, cutoff, self_interaction=True))
        assert own == expected | {(i, i, (0, 0, 0)) for i in range(8)}


def pairs_within(x, cell, pbc, cutoff_of):
    """Return the pairs closer than a cutoff of each, [n, n]."""
    found = set()
    for cutoff in np.unique(cutoff_of[cutoff_of > 0]):
        near = reference.reference_images(x, float(cutoff), matrix=cell, periodic=pbc)
        found |= {(i, j, s) for i, j, s in near if cutoff_of[i, j] == cutoff}
    return found


@pytest.mark.parametrize("name", ["left-handed", "slab", "open"])
def test_radii_and_tables(name):
    cell, pbc = CELLS[name]
    rng = np.random.default_rng(6)
    x, numbers = np.round(8 * rng.random((24, 3))) / 4, rng.choice([1, 6, 8], 24)
    radii = rng.choice([0.0, 0.25, 0.5, 0.75], 24)
    found = as_set(*primitive_neighbor_list("ijS", pbc, cell, x, radii))
    assert found == pairs_within(x, cell, pbc, radii[:, None] + radii)
    table = {("H", "C"): 1.75, (8, 8): 1.5, (6, 1): 1.0, ("O", "H"): 0.0, ("Fe", "Fe"): 3.0}
    cutoff_of = np.zeros((9, 9))
    cutoff_of[1, 6] = cutoff_of[6, 1] = 1.0
    cutoff_of[8, 8] = 1.5
    expected = pairs_within(x, cell, pbc, cutoff_of[numbers][:, numbers])
    assert as_set(*primitive_neighbor_list("ijS", pbc, cell, x, table, numbers)) == expected
    atoms = SimpleNamespace(positions=x, cell=cell, pbc=np.array(pbc), numbers=numbers)
    assert as_set(*neighbor_list("ijS", atoms, table)) == expected
    assert len(expected) > 10
    every = collections.defaultdict(lambda: 1.0)  # as matscipy takes it: of no other values
    one = as_set(*neighbor_list("ijS", atoms, 1.0))
    assert every[1, 1] == 1.0
    assert as_set(*neighbor_list("ijS", atoms, every)) == one != set()


def test_fifty_angstrom_in_a_cell_of_two_atoms():
    x, cell = np.array([[0.0, 0, 0], [1.1, 0.9, 1.3]]), np.array([[0, 1.7, 1.7], [1.7, 0, 1.7], [1.7, 1.7, 0]]) * 1.04
    i, j, s, d = primitive_neighbor_list("ijSd", True, cell, x, 50.0)
    vectors = x[j] - x[i] + s @ cell
    np.testing.assert_allclose(d, np.linalg.norm(vectors, axis=1), rtol=1e-12)
    assert (d < 50).all()
    assert len(as_set(i, j, s)) == len(i)
    grid = np.array(list(itertools.product(range(-35, 36), repeat=3)))
    lengths = np.linalg.norm(grid @ cell + (x[1] - x[0]), axis=1)
    assert (i == 0)[j == 1].sum() == (lengths < 50).sum()
    assert np.bincount(i).min() > 80_000


def test_two_of_one_name_and_what_is_empty():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    assert primitive_neighbor_list("i", False, np.zeros(3), x, 2.0).tolist() == [0, 1]
    i, again = primitive_neighbor_list("ii", False, np.zeros(3), x, 2.0)
    assert i.tolist() == again.tolist() == [0, 1]
    for points in (np.zeros((0, 3)), x * 10):
        found = primitive_neighbor_list("ijSDd", False, np.zeros((3, 3)), points, 2.0)
        assert [part.shape for part in found] == [(0,), (0,), (0, 3), (0, 3), (0,)]
        assert [part.dtype for part in found] == [int, int, int, float, float]
    scaled = primitive_neighbor_list("d", True, np.eye(3) * 4, x / 4, 1.5, use_scaled_positions=True)
    assert scaled.tolist() == [1.0, 1.0]
    cell, u = CELLS["left-handed"][0], np.random.default_rng(7).integers(0, 8, (12, 3)) / 8  # so that products are exact
    lengths, fractions = as_set(*primitive_neighbor_list("ijS", True, cell, u @ cell, 1.0)), {"use_scaled_positions": True}
    assert as_set(*primitive_neighbor_list("ijS", True, cell, u, 1.0, **fractions)) == lengths != set()


BAD = {
    "quantities must be letters of 'ijdDS'": {"quantities": "ijx"},
    "positions must be real numbers": {"positions": [["a", "b", "c"]]},
    r"positions must have shape \[n, 3\] and cell": {"positions": np.zeros((4, 2))},
    "cell must be real numbers": {"cell": "cubic"},
    "pbc must be one bool or three": {"pbc": (True, False)},
    r"cutoff must be a number, a dictionary, or radii of shape \[2\]": {"cutoff": np.ones(3)},
    r"cutoff must be a number \[length\], got nan": {"cutoff": np.nan},
    "cutoff must hold numbers, got nan for atom 1": {"cutoff": [1.0, np.nan]},
    "or take a smaller cutoff": {"cutoff": {(1, 1): np.inf}, "numbers": [1, 1]},
    "positions must be finite": {"positions": np.array([[0, 0, 0], [0, 0, np.nan]])},
    r"cutoff must be a number \[length\], a dictionary of numbers, or radii of all atoms, got str": {"cutoff": "3"},
    r"cutoff must be a number \[length\] for \(1, 1\), got str": {"cutoff": {(1, 1): "2"}, "numbers": [1, 1]},
    r"cutoff must be a number \[length\] for \('H', 6\), got shape \[1\]": {"cutoff": {("H", 6): [2.0]}, "numbers": [1, 1]},
    "keys of cutoff must be pairs of symbols or numbers": {"cutoff": {("H", "Q"): 1.0}, "numbers": [1, 1]},
    "keys of cutoff must be pairs .* got 6": {"cutoff": {6: 1.0}, "numbers": [1, 1]},
    "cutoff must not be a defaultdict of 2.0 with other values": {"cutoff": collections.defaultdict(lambda: 2.0, {(1, 1): 1.0})},
    "a dictionary of cutoffs needs numbers": {"cutoff": {(1, 1): 1.0}},
    "linearly independent": {"cell": np.array([[1.0, 0, 0], [2.0, 0, 0], [0, 0, 1.0]])},
    "at most 1 048 576 cells": {"positions": np.array([[0, 0, 0], [1e9, 0, 0]])},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_says_what_is_wrong(message):
    given = {"quantities": "ij", "pbc": True, "cell": np.eye(3), "positions": np.zeros((2, 3)), "cutoff": 0.5} | BAD[message]
    refuses((ValueError, TypeError), message, primitive_neighbor_list, **given)


def test_cutoffs_below_zero_and_without_end():
    """Nothing is closer than a negative cutoff; radii may be negative where their sums are not; in open space all may be pairs."""
    cell, pbc = CELLS["left-handed"]
    rng = np.random.default_rng(9)
    x, numbers = np.round(8 * rng.random((24, 3))) / 4, np.repeat([1, 6], 12)
    for cutoff in (-1.0, -np.inf, np.full(24, -0.25), {(1, 6): -1.0, (1, 1): -np.inf}):
        assert len(primitive_neighbor_list("i", pbc, cell, x, cutoff, numbers, self_interaction=True)) == 0
    radii = rng.choice([-0.3, -0.25, 0.1, 0.5, 0.9, 1.0], 24)
    expected = pairs_within(x, cell, pbc, radii[:, None] + radii)
    assert as_set(*primitive_neighbor_list("ijS", pbc, cell, x, radii)) == expected != set()
    one, *others = np.inf, *np.zeros(23)
    for cutoff, size in ((one, 24 * 23), ({(1, 1): one}, 12 * 11), ([one, *others], 2 * 23), ([one, -one, *others[1:]], 2 * 22)):
        assert len(primitive_neighbor_list("i", False, cell, x, cutoff, numbers)) == size


def test_what_else_ase_takes():
    """Letters one by one or none, any cell around no atoms, numbers for truth values, and pairs of species in other containers."""
    x, cell, numbers = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.eye(3) * 3, np.array([1.0, 6.0])
    given = True, cell, x, 1.5
    assert primitive_neighbor_list("", *given) == primitive_neighbor_list((), *given) == ()
    i, j = primitive_neighbor_list(["i", "j"], *given)
    assert (i.tolist(), primitive_neighbor_list(("j",), *given).tolist()) == ([0, 1], j.tolist())
    assert [part.shape for part in primitive_neighbor_list("iS", True, np.zeros((3, 3)), [], 2.0)] == [(0,), (0, 3)]
    i, shifts = primitive_neighbor_list("iS", [1.0, 0.0, 0.0], cell, x, 3.5)
    assert set(shifts[:, 0].tolist()) == {-1, 0, 1}
    assert not shifts[:, 1:].any()
    for pair in (("H", 6), "HC", frozenset("HC"), [1.0, "C"], np.array([6, 1])):
        assert primitive_neighbor_list("i", True, cell, x, Pairs(pair), numbers).tolist() == [0, 1]


class Pairs(dict):
    """One pair with a cutoff of 1.5, whether it can be a key of a dictionary or not."""

    def __init__(self, pair):
        super().__init__()
        self.pair = pair

    def items(self):
        return [(self.pair, 1.5)]


def test_what_is_no_structure_is_refused():
    with pytest.raises(TypeError, match=r"a must be ase.Atoms.*ndarray lacks positions, cell, pbc, numbers"):
        neighbor_list("ij", np.zeros((2, 3)), 1.0)


PLUGIN = """
import sys, types
from importlib.metadata import EntryPoint

class Plugin:
    def __init__(self, name, **given):
        vars(self).update(name=name, module=None, **given)

ase4 = types.SimpleNamespace(NeighborListPlugin=Plugin)
names = ["ase", "ase._4", "ase._4.plugins", "ase._4.plugins.neighborlist"]
sys.modules |= dict.fromkeys(names, ase4)
[plugin] = EntryPoint("jfrnn", %r, "ase.plugins").load().__ase_plugins__
assert not {"jax", "jfrnn", "numpy"} & sys.modules.keys()
for name in names:
    del sys.modules[name]
import jfrnn.ase
path, _, function = plugin.implementation.rpartition(".")
assert getattr(sys.modules[path], function) is jfrnn.ase.neighbor_list
assert (plugin.name, plugin.module.__name__) == ("jfrnn", "jfrnn")

import jax, numpy as np
jfrnn.ase.primitive_neighbor_list("i", True, np.eye(3), np.zeros((1, 3)), 2.0)
assert not jax._src.xla_bridge.backends_are_initialized()
"""


def test_it_takes_no_device_of_jax_and_its_plugin_no_module():
    """ASE imports the plugin whenever it collects plugins; of its released versions, 3.29 has no `NeighborListPlugin` yet."""
    entries = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["ase.plugins"]
    run_python("-c", PLUGIN % entries["jfrnn"])


@pytest.mark.parametrize("bothways", [True, False])
def test_classes_of_ase(bothways):
    """They take ASE's arguments and list its pairs, once or both ways; the skin is ASE's."""
    theirs, build = pytest.importorskip("ase.neighborlist"), pytest.importorskip("ase.build")
    atoms = build.bulk("NaCl", "rocksalt", a=5.6) * (2, 1, 1)
    atoms.rattle(0.05, seed=1)
    radii = np.array([1.3, 1.9, 1.3, 1.9])
    for sort, own in itertools.product((True, False), (True, False)):
        options = {"skin": 0.2, "bothways": bothways, "sorted": sort, "self_interaction": own}
        lists = [module.NeighborList(radii, primitive=module.NewPrimitiveNeighborList, **options) for module in (jfrnn.ase, theirs)]
        assert all(made.update(atoms) for made in lists)
        for a in range(4):
            ours, others = (made.get_neighbors(a) for made in lists)
            order, other = (np.lexsort((*found[1].T, found[0])) for found in (ours, others))
            np.testing.assert_array_equal(ours[0] if sort else ours[0][order], others[0][other])
            np.testing.assert_array_equal(ours[1][order], others[1][other])
    ours, others = lists
    assert isinstance(ours, theirs.NeighborList)
    np.testing.assert_array_equal(*(made.get_connectivity_matrix(sparse=False) for made in lists))
    assert [len(x) for x in ours.nl.neighbors] == [len(ours.get_neighbors(a)[0]) for a in range(4)]
    assert [x.shape[1] for x in ours.nl.displacements] == [3] * 4
    atoms.positions[1] += 0.1
    assert (ours.update(atoms), others.update(atoms), ours.nupdates) == (False, False, 1)
    atoms.positions[1] += 0.2
    assert ours.update(atoms)


def test_primitive_lists_of_ase():
    """Either class has the arguments and attributes of its own; atoms are counted from the end, too."""
    theirs, build = pytest.importorskip("ase.neighborlist"), pytest.importorskip("ase.build")
    atoms = build.bulk("Cu", cubic=True)
    old, other = (module.PrimitiveNeighborList([1.4] * 4, bothways=True) for module in (jfrnn.ase, theirs))
    new = jfrnn.ase.NewPrimitiveNeighborList([1.4] * 4, bothways=True)
    assert isinstance(old, theirs.PrimitiveNeighborList)
    assert not isinstance(new, theirs.PrimitiveNeighborList)
    for made in (old, other):
        assert made.update(pbc=atoms.pbc, cell=atoms.cell, coordinates=atoms.positions)
        assert not made.update(atoms.pbc, atoms.cell, atoms.positions + 0.01)
        np.testing.assert_array_equal(made.coordinates, atoms.positions)
        assert made.cell.volume == atoms.cell.volume
    assert new.update(pbc=atoms.pbc, cell=atoms.cell, positions=atoms.positions, numbers=atoms.numbers)
    for made in (old, new):
        for a in (-1, np.int64(-4), 2):
            assert len(made.get_neighbors(a)[0]) == len(other.get_neighbors(a)[0]) == 13
        refuses(IndexError, "out of range", made.get_neighbors, 4)


def test_other_names_of_ase():
    theirs, build = pytest.importorskip("ase.neighborlist"), pytest.importorskip("ase.build")
    water = build.molecule("H2O")
    assert jfrnn.ase.natural_cutoffs is theirs.natural_cutoffs
    made = jfrnn.ase.build_neighbor_list(water, bothways=True, self_interaction=False)
    assert isinstance(made.nl, jfrnn.ase.PrimitiveNeighborList)
    assert jfrnn.ase.get_distance_matrix(made.get_connectivity_matrix()).todense().max() == 2
    with pytest.raises(AttributeError, match="neither"):
        jfrnn.ase.neighbour_lists  # noqa: B018


CALCULATORS = {
    "emt": lambda build: (build.bulk("Cu", cubic=True) * (2, 1, 1), importlib.import_module("ase.calculators.emt").EMT()),
    "lj": lambda build: (
        build.bulk("Ar", "fcc", a=5.2) * (2, 2, 1),
        importlib.import_module("ase.calculators.lj").LennardJones(sigma=3.4, epsilon=0.01, rc=8.0, smooth=True),
    ),
    "morse": lambda build: (build.bulk("Cu"), importlib.import_module("ase.calculators.morse").MorsePotential(r0=2.5, rho0=3.0)),
    "tersoff": lambda build: (build.bulk("Si", cubic=True), importlib.import_module("ase.calculators.tersoff")),
}


@pytest.mark.parametrize("name", CALCULATORS)
def test_calculators_of_ase(name):
    """With `use`, they have energies, forces and stresses of before, to rounding, and our lists; afterwards, ASE's again."""
    theirs, build = pytest.importorskip("ase.neighborlist"), pytest.importorskip("ase.build")
    atoms, make = CALCULATORS[name](build)
    if name == "tersoff":
        parameters = make.TersoffParameters(
            3.0, 1.0, 1.3258, 4.8381, 2.0417, 0.0, 22.956, 0.33675, 1.3258, 95.373, 3.0, 0.2, 3.2394, 3264.7
        )
        make = make.Tersoff({("Si", "Si", "Si"): parameters})
    atoms.rattle(0.05, seed=2)

    def run():
        atoms.calc = make
        make.reset()
        if hasattr(make, "nl"):
            make.nl = None
        return atoms.get_potential_energy(), atoms.get_forces(), atoms.get_stress()

    before, function = run(), theirs.neighbor_list
    with jfrnn.ase.use():
        assert theirs.neighbor_list is jfrnn.ase.neighbor_list
        if name == "morse":  # which takes the function as it is made
            make = type(make)(**make.parameters)
        found = run()
        ours = make.neighbor_list is neighbor_list if name == "morse" else type(make.nl.nl) is jfrnn.ase.PrimitiveNeighborList
        assert ours
    assert theirs.neighbor_list is function
    if name == "morse":
        assert type(make)().neighbor_list is function
    assert theirs.NeighborList([1.0]).nl.__class__ is theirs.PrimitiveNeighborList
    for ours, others in zip(found, before):
        np.testing.assert_allclose(ours, others, rtol=1e-12, atol=1e-12)


def test_forms_of_matscipy_and_vesin():
    x, cell = np.array([[0.0, 0, 0], [1.0, 0.5, 0], [2.5, 0, 0.25]]), np.diag([3.0, 3.5, 4.0])
    i, j, s = primitive_neighbor_list("ijS", True, cell, x, 2.0)
    found = jfrnn.matscipy.neighbour_list("ijSd", positions=x, cell=cell, pbc=[True] * 3, cutoff=2.0, cell_origin=[1.0, 0, 0])
    assert [part.dtype.name for part in found] == ["int32", "int32", "int32", "float64"]
    for ours, expected in zip(found, (i, j, s)):
        np.testing.assert_array_equal(ours, expected)
    atoms = SimpleNamespace(positions=x, cell=cell, pbc=np.ones(3, bool), numbers=np.ones(3, int))
    np.testing.assert_array_equal(jfrnn.matscipy.coordination(atoms, 2.0), np.bincount(i))
    full, half = (jfrnn.vesin.NeighborList(cutoff=2.0, full_list=full).compute(x, cell, True, "PSdi") for full in (True, False))
    assert [part.dtype.name for part in full] == ["uint64", "int32", "float64", "uint64"]
    np.testing.assert_array_equal(full[0], np.stack([i, j], axis=1))
    both = {(*pair, *shift) for pair, shift in zip(half[0].tolist(), half[1].tolist())}
    assert len(both) * 2 == len(i)
    whole = {(*pair, *shift) for pair, shift in zip(full[0].tolist(), s.tolist())}
    assert both | {(b, a, -x, -y, -z) for a, b, x, y, z in both} == whole
    single = jfrnn.vesin.NeighborList(cutoff=2.0, full_list=True).compute(x.astype(np.float32), cell, True, "D")
    assert [part.dtype.name for part in single] == ["float32"]
    for dtype, name in ((np.float16, "float16"), (np.longdouble, np.dtype(np.longdouble).name), (np.int32, "float64")):
        made = jfrnn.vesin.NeighborList(cutoff=2.0, full_list=True).compute(x.astype(dtype), cell, [1.0, 1.0, 1.0], "Dd")
        assert [part.dtype.name for part in made] == [name, name]
    (alone,) = jfrnn.vesin.ase_neighbor_list("i", atoms, 2.0)
    np.testing.assert_array_equal(alone, i)
    together, moved = jfrnn.vesin.ase_neighbor_list("PS", atoms, 2.0)
    np.testing.assert_array_equal(together, np.stack([i, j], axis=1))
    assert (alone.dtype, together.dtype, moved.dtype) == (np.uint64, np.uint64, np.int32)
    made = jfrnn.vesin.NeighborList(cutoff=2, full_list=1, algorithm="Cell_List", skin=1)
    assert vars(made) | {"cutoff": 2.0, "full_list": True, "sorted": False, "algorithm": "cell_list", "skin": 1.0} == vars(made)
    assert made.n_threads == 0
    assert made.compute(x, cell, True, "") == jfrnn.vesin.ase_neighbor_list("", atoms, 2.0) == ()
    assert jfrnn.matscipy.neighbour_list("", atoms, 2.0) == ()
    for bad in ({"cutoff": -1.0}, {"cutoff": np.inf}, {"cutoff": 2.0, "n_threads": -1}):
        refuses(ValueError, "at least 0", jfrnn.vesin.NeighborList, full_list=True, **bad)
    with pytest.raises(ValueError, match="quantities must be letters of 'ijPSDd'"):
        jfrnn.vesin.NeighborList(cutoff=2.0, full_list=True).compute(x, cell, True, "x")
    for message, *given in (  # by the names that vesin has
        ("box must be real numbers", x, None, False),
        ("points must have shape .* and box", x[:, :2], cell, True),
        ("periodic must be one bool or three", x, cell, [True, False]),
        ("pass others, or periodic=False", x, np.zeros((3, 3)), True),
        ("points must be finite", x * np.nan, cell, True),
    ):
        refuses((TypeError, ValueError), message, jfrnn.vesin.NeighborList(cutoff=2.0, full_list=True).compute, *given)
    refuses(TypeError, r"cutoff must be a number \[length\], got list", jfrnn.vesin.NeighborList, cutoff=["a"], full_list=True)
    refuses(ValueError, "algorithm must be", jfrnn.vesin.NeighborList, cutoff=2.0, full_list=True, algorithm="tree")


@pytest.mark.parametrize("peer", ["ase", "matscipy", "vesin"])
def test_peers(peer):
    """Where no distance lies at a cutoff, all libraries tell the same."""
    ase = pytest.importorskip("ase")
    build = pytest.importorskip("ase.build")
    find = neighbor_list
    if peer == "ase":
        theirs = pytest.importorskip("ase.neighborlist").neighbor_list
    elif peer == "matscipy":
        theirs, find = pytest.importorskip("matscipy.neighbours").neighbour_list, jfrnn.matscipy.neighbour_list
    else:
        theirs = pytest.importorskip("vesin").ase_neighbor_list
    structures = [
        build.bulk("NaCl", "rocksalt", a=5.6),
        build.bulk("Ti"),
        build.bulk("Si", cubic=True) * (2, 1, 3),
        build.molecule("C6H6"),
    ]
    structures += [build.fcc111("Pt", (2, 2, 3), vacuum=8.0), ase.Atoms("H2", [[0, 0, 0], [30.0, 2, 1]], cell=[3, 4, 5], pbc=True)]
    rng = np.random.default_rng(0)
    for atoms in structures:
        atoms.positions += rng.normal(scale=0.05, size=atoms.positions.shape)
        cutoffs = [3.1, 6.7]
        if peer != "vesin":
            cutoffs += [{(s, t): 1.5 + 0.5 * len(s + t) for s in set(atoms.symbols) for t in set(atoms.symbols)}]
            cutoffs += [rng.uniform(0.5, 2.0, len(atoms))]
        if peer == "matscipy" and not atoms.cell.volume:
            continue  # it takes no vectors of 0
        for cutoff in cutoffs:
            ours, others = (f("ijSDd", atoms, cutoff) for f in (find, theirs))
            order, other_order = (np.lexsort((*x[2].T, x[1], x[0])) for x in (ours, others))
            for a, b in zip(ours, others):
                np.testing.assert_allclose(a[order], b[other_order], atol=1e-12)
                assert a.dtype == b.dtype or peer == "vesin"
        if peer == "matscipy":
            first = jfrnn.matscipy.first_neighbours(len(atoms), ours[0])
            triplets = jfrnn.matscipy.triplet_list(first)
            assert len(triplets[0]) == (np.bincount(ours[0]) * (np.bincount(ours[0]) - 1)).sum()
        if peer == "vesin":
            for full in (True, False):
                made = [module.NeighborList(cutoff=3.1, full_list=full) for module in (jfrnn.vesin, pytest.importorskip("vesin"))]
                ours, others = (f.compute(atoms.positions, atoms.cell[:], bool(atoms.pbc.all()), "ijPSDd") for f in made)
                assert [(x.dtype, x.shape) for x in ours] == [(x.dtype, x.shape) for x in others]


def test_names_of_ase_and_matscipy():
    """`atoms=`, and arrays by name instead of atoms; what is missing or doubled is refused."""
    build = pytest.importorskip("ase.build")
    atoms = build.bulk("Cu", cubic=True)
    expected = neighbor_list("ijS", atoms, 4.0)
    arrays = {"positions": atoms.positions, "cell": atoms.cell[:], "pbc": True}
    for found in (neighbor_list("ijS", atoms=atoms, cutoff=4.0), neighbor_list("ijS", cutoff=4.0, **arrays)):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)
    alone = neighbor_list("i", positions=atoms.positions, cutoff=3.0)
    assert len(alone) == 12  # of the four atoms of the cell, without images
    kinds = neighbor_list("i", cutoff={("Cu", "Cu"): 4.0}, numbers=atoms.numbers, **arrays)
    assert len(kinds) == len(expected[0])
    for error, match, given in (
        (TypeError, "cutoff must be given", {"atoms": atoms}),
        (TypeError, "got nothing", {"cutoff": 3.0}),
        (TypeError, "got a, atoms", {"a": atoms, "atoms": atoms, "cutoff": 3.0}),
        (TypeError, "got a, positions", {"a": atoms, "positions": atoms.positions, "cutoff": 3.0}),
        (ValueError, "needs cell", {"positions": atoms.positions, "pbc": True, "cutoff": 3.0}),
    ):
        refuses(error, match, neighbor_list, "i", **given)
