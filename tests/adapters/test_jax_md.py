"""`jfrnn.jax_md`: jax-md's neighbor lists, against the oracle; jax-md's own functions where it is installed."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import as_set, refuses, slots_as_set, slow, sparing

from jfrnn import jax_md

CUTOFF, SKIN, N = 0.7, 0.1, 80
LENGTHS, MATRIX = np.array([3.0, 3.5, 3.25]), np.array([[3.0, 0.25, 0.5], [0.0, 3.5, 0.25], [0.0, 0.0, 3.25]])
FORMATS = [jax_md.Dense, jax_md.Sparse, jax_md.OrderedSparse]


@jax.jit  # displacements are asked at points one after another: as programs, each is compiled but once
def free(a, b, **_):
    return a - b


@jax.jit
def nearest(a, b, box=None, **_):
    away = a - b
    return away - box * jnp.round(away / box)


@jax.jit
def general(a, b, box, **_):
    away = a - b
    return jnp.sum(box * (away - jnp.round(away)), axis=1)


@jax.jit
def metric(a, b, **_):
    return jnp.abs(a - b).max()  # which is not Euclidean


SPACES = {  # None: decided exactly, as are the spaces of jax-md where that is installed
    "free": (free, LENGTHS, False),
    "periodic": (None, LENGTHS, False),
    "fractional": (None, MATRIX, True),
    "measured": (functools.partial(general, box=jnp.asarray(MATRIX)), MATRIX, True),
}


def points(fractional, n=N):
    x = np.random.default_rng(2).random((n, 3))
    return x if fractional else x * LENGTHS


def pairs_of(idx, n, form):
    if form.name == "Dense":
        return slots_as_set(idx, np.asarray(idx) < n)
    used = np.asarray(idx)[0] < n
    return as_set(*np.asarray(idx)[::-1, used])


def expected(x, space, form, skin=SKIN):
    real = np.asarray(x) @ MATRIX.T if SPACES[space][2] else np.asarray(x)
    rows = MATRIX.T if SPACES[space][2] else np.diag(LENGTHS)
    within = reference.reference_images(real, CUTOFF + skin, matrix=rows, periodic=(space != "free",) * 3)
    return {(i, j) for i, j, _ in within if form.name != "OrderedSparse" or j < i}


OFTEN = [("free", jax_md.Dense), ("periodic", jax_md.OrderedSparse)]  # fractions: where boxes change


@pytest.mark.parametrize(("space", "form"), sparing(itertools.product(SPACES, FORMATS), OFTEN))
def test_pairs_in_a_loop(space, form):
    displacement, box, fractional = SPACES[space]
    fns = jax_md.neighbor_list(displacement, box, CUTOFF, SKIN, fractional_coordinates=fractional, format=form)
    x = points(fractional)
    nbrs = fns.allocate(x)
    assert (nbrs.kept is not None, nbrs.exact) == (True, displacement is None)
    assert pairs_of(nbrs.idx, N, form) == expected(x, space, form)
    y = x.copy()
    y[3], y[5] = x[3] + 0.02, x[5] + 0.2

    @jax.jit
    def loop(x, nbrs):
        return jax.lax.fori_loop(0, 3, lambda k, nbrs: nbrs.update(x - 0.0001 * k), nbrs)

    moved = loop(y, nbrs)
    assert pairs_of(moved.idx, N, form) == expected(y, space, form)
    np.testing.assert_array_equal(moved.reference_position, y)
    assert (int(moved.error.code), moved.idx.shape) == (0, nbrs.idx.shape)
    still = loop(x + 0.001, nbrs)
    np.testing.assert_array_equal(still.idx, nbrs.idx)
    np.testing.assert_array_equal(still.reference_position, x)


MEASURED = [(jax_md.Dense, False), (jax_md.Sparse, True)]


@pytest.mark.parametrize(("form", "euclidean"), sparing(itertools.product(FORMATS, (True, False)), MEASURED))
def test_what_is_no_space_of_ours_is_measured(form, euclidean):
    """A distance that is not Euclidean, or a box that is too small for its nearest images."""
    displacement, box = (functools.partial(nearest, box=np.float64(1.0)), 1.0) if euclidean else (metric, 2.0)
    x = points(True)
    fns = jax_md.neighbor_list(displacement, box, CUTOFF, SKIN, format=form)
    nbrs = fns.allocate(x)
    assert nbrs.kept is None
    away = x[:, None] - x
    away = np.linalg.norm(away - np.round(away), axis=2) if euclidean else np.abs(away).max(2)
    near = {(i, j) for i, j in zip(*np.nonzero(away < CUTOFF + SKIN)) if i != j and (j < i or form.name != "OrderedSparse")}
    assert pairs_of(nbrs.idx, N, form) == near
    assert pairs_of(jax.jit(fns.update)(x + 0.3, nbrs).idx, N, form) == near


def test_room():
    displacement, box, _ = SPACES["periodic"]
    x = points(False)
    for form in (jax_md.Dense, jax_md.OrderedSparse):
        fns = jax_md.neighbor_list(displacement, box, CUTOFF, SKIN, format=form, capacity_multiplier=1.0)
        assert tuple(fns) == (fns.allocate, fns.update)
        nbrs = fns.allocate(x)
        update = jax.jit(fns.update)
        crowd = update(0.2 * x, nbrs)
        assert not nbrs.did_buffer_overflow
        assert crowd.did_buffer_overflow
        again = update(x, crowd)
        assert again.did_buffer_overflow  # it stays
        assert again.max_occupancy == nbrs.max_occupancy
        wider = fns.allocate(x, extra_capacity=3)
        assert wider.max_occupancy == nbrs.max_occupancy + (3 if form is jax_md.Dense else 3 * N)
        assert wider.idx.shape[-1] == wider.max_occupancy
        own = jax_md.neighbor_list(displacement, box, CUTOFF, SKIN, format=form, mask_self=False).allocate(x)
        assert ((0, 0) in pairs_of(own.idx, N, form)) == (form is not jax_md.OrderedSparse)


@pytest.mark.parametrize("form", [jax_md.Dense, jax_md.OrderedSparse, slow(jax_md.Sparse)])
def test_masks_come_before_room(form):
    displacement, box, _ = SPACES["periodic"]
    molecule = np.arange(N + 1) // 4

    @jax.jit
    def mask(idx):
        return jnp.where(jnp.asarray(molecule)[idx] == molecule[:N, None], N, idx)

    x = points(False)
    fns = jax_md.neighbor_list(displacement, box, CUTOFF, SKIN, 1.0, custom_mask_function=mask, format=form)
    others, pairs = fns.allocate(x), expected(x, "periodic", form)
    apart = {(i, j) for i, j in pairs if i // 4 != j // 4}
    assert len(apart) < len(pairs)
    assert pairs_of(jax.jit(fns.update)(x + 0.2, others).idx, N, form) == apart
    assert others.max_occupancy == len(apart) or form is jax_md.Dense


def test_boxes_that_change():
    """Among them a matrix, of a list that was made with a length; without `box=`, it is the box of the displacement."""
    x = points(True)
    fns = jax_md.neighbor_list(None, MATRIX, CUTOFF, fractional_coordinates=True, capacity_multiplier=9.0)
    update = jax.jit(lambda x, nbrs, box: nbrs.update(x, box=box))
    nbrs = fns.allocate(x, box=3.2, num_particles=N)
    assert nbrs.exact
    for box in (1.2 * MATRIX, MATRIX):
        real = np.sum(x[:, None, :] * box, axis=-1)
        near = reference.reference_images(real, CUTOFF, matrix=box.T, periodic=(True,) * 3)
        wide = update(x, nbrs, box)
        assert pairs_of(wide.idx, N, jax_md.Dense) == {(i, j) for i, j, _ in near}
        assert not wide.cell_size_too_small
    assert pairs_of(nbrs.update(x, t=1.0).idx, N, jax_md.Dense) == {(i, j) for i, j, _ in near}
    assert update(x, nbrs, 0.4 * MATRIX).cell_size_too_small
    with pytest.raises(ValueError, match="box= only with fractional_coordinates=True"):
        jax_md.neighbor_list(None, LENGTHS, CUTOFF).allocate(points(False)).update(points(False), box=LENGTHS)
    refuses(TypeError, r"update\(\) got perturbation", nbrs.update, x, perturbation=jnp.eye(3))
    refuses(ValueError, "displacement_or_metric given", jax_md.neighbor_list(None, 1.0, CUTOFF).allocate, x)
    refuses(ValueError, "format must be a member of NeighborListFormat", jax_md.neighbor_list, None, 1.0, CUTOFF, format="Dense")
    refuses(TypeError, r"cannot run inside jax.jit", jax.jit(lambda x: jax_md.neighbor_list(free, 1.0, CUTOFF).allocate(x).idx), x)
    for cutoff, skin in ((np.nan, 0.0), (-1.0, 0.0), (CUTOFF, -0.1), (CUTOFF, np.inf)):
        refuses(ValueError, "r_cutoff must be above 0, and dr_threshold finite", jax_md.neighbor_list, free, 3.0, cutoff, skin)
    refuses(
        TypeError, "position must hold floats, got bool", jax_md.neighbor_list(free, 3.0, CUTOFF).allocate, np.zeros((4, 3), bool)
    )


def test_whole_numbers_are_positions():
    x = np.random.default_rng(3).integers(0, 5, (20, 3))
    fns = jax_md.neighbor_list(free, 5.0, 1.5, SKIN, 4.0)
    images = jax_md.neighbor_list_multi_image(None, 5.0 * jnp.eye(3), 1.5, fractional_coordinates=False)
    for made in (fns.allocate(x), jax.jit(fns.update)(x, fns.allocate(x.astype(float)))):
        assert pairs_of(made.idx, 20, jax_md.Dense) == pairs_of(fns.allocate(x.astype(float)).idx, 20, jax_md.Dense) != set()
    np.testing.assert_array_equal(images.allocate(x).senders, images.allocate(x.astype(float)).senders)


def test_an_energy_is_differentiated_by_its_cutoff():
    """As jax-md's energies make functions of lists of what is differentiated, and do not call them."""
    x = points(False, 20)
    nbrs = jax_md.neighbor_list(None, LENGTHS, CUTOFF).allocate(x)

    def energy(scale):
        fns = jax_md.neighbor_list(None, LENGTHS, CUTOFF * scale)
        refuses(TypeError, "r_cutoff and dr_threshold must be known", fns.allocate, x)
        refuses(TypeError, "r_cutoff and dr_threshold must be known", fns.update, x, nbrs)
        return scale**2 * (nbrs.update(x).idx < 20).sum().astype(float)

    assert float(jax.grad(energy)(1.0)) == 2 * int((nbrs.idx < 20).sum())


@pytest.mark.parametrize("measured", [False, True])
def test_positions_that_are_not_finite_are_told(measured):
    """Where the function is asked about all pairs, too."""
    x = points(False, 20)
    lost = x.copy()
    lost[3] = np.nan
    fns = jax_md.neighbor_list(free, LENGTHS, CUTOFF, SKIN, disable_cell_list=measured)
    refuses(ValueError, "position holds non-finite coordinates, .* of particle 3", fns.allocate, lost)
    nbrs = fns.allocate(x)
    every = jax_md.neighbor_list(free, LENGTHS, np.inf, disable_cell_list=True).allocate(x)
    assert (every.idx < 20).sum() == 20 * 19
    assert not fns.update(x, nbrs).did_buffer_overflow
    assert fns.update(lost, nbrs).did_buffer_overflow


@pytest.mark.parametrize("form", [FORMATS[0], *map(slow, FORMATS[1:])])
def test_lists_of_other_functions(form):
    """A list that was made for another box, cutoff or displacement has the pairs of the functions that update it."""
    x = points(False)

    def made(move=None, lengths=LENGTHS, cutoff=CUTOFF, **options):
        return jax_md.neighbor_list(move, lengths, cutoff, SKIN, capacity_multiplier=4.0, format=form, **options)

    old = made().allocate(x)
    others = [
        made(),
        made(lengths=1.1 * LENGTHS),
        made(cutoff=0.5),
        made(cutoff=0.8),
        made(mask_self=False),
        made(free),
        made(free, disable_cell_list=True),
    ]
    for each in others:
        updated, own = jax.jit(each.update)(x, old), each.allocate(x)
        assert int(updated.error.code) == 0
        assert pairs_of(updated.idx, N, form) == pairs_of(own.idx, N, form)
        carried, _ = jax.lax.scan(lambda nbrs, _, each=each: (each.update(x, nbrs), None), old, None, length=2)
        assert pairs_of(carried.idx, N, form) == pairs_of(own.idx, N, form)
        assert pairs_of(carried.update(x).idx, N, form) == pairs_of(old.idx, N, form)
    for other in set(FORMATS) - {form}:
        refuses(ValueError, "allocate anew", jax_md.neighbor_list(None, LENGTHS, CUTOFF, SKIN, format=other).update, x, old)


def test_boxes_too_small_for_their_cutoff_are_measured():
    x = points(False, 20)
    for cutoff in (40.0, 4000.0, 1e30, np.inf):
        assert int((jax_md.neighbor_list(nearest, LENGTHS, cutoff).allocate(x, box=LENGTHS).idx < 20).sum()) == 20 * 19


def test_boxes_of_lists_that_are_measured():
    """With a threshold, too, a new box is seen though no fraction has moved; without fractions, as jax-md takes it."""
    x = points(True)
    fns = jax_md.neighbor_list(general, 1.0, CUTOFF, SKIN, 9.0, disable_cell_list=True)
    nbrs = fns.allocate(x, box=jnp.asarray(MATRIX))
    assert pairs_of(nbrs.idx, N, jax_md.Dense) == expected(x, "fractional", jax_md.Dense)
    box = 1.1 * MATRIX
    near = reference.reference_images(x @ box.T, CUTOFF + SKIN, matrix=box.T, periodic=(True,) * 3)
    update = jax.jit(lambda x, nbrs, box: nbrs.update(x, box=box, neighbor=nbrs))
    wide = update(x, nbrs, box)
    assert pairs_of(wide.idx, N, jax_md.Dense) == {(i, j) for i, j, _ in near}
    still = update(x + 0.001, wide, box)  # a box that is still the same is none to measure in again
    np.testing.assert_array_equal(still.reference_position, x)
    assert (np.asarray(update(x, still, 0.9 * box).idx) < N).sum() > len(near)


EDGE, SHEAR = 3.0, np.array([[1.0, 0.001, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def sheared(a, b, xp=jnp):
    away = (a - b) @ np.linalg.inv(EDGE * SHEAR).T
    return (away - xp.round(away)) @ (EDGE * SHEAR).T


def longer(a, b, xp=jnp):
    return a - b - (EDGE + 0.002) * xp.round((a - b) / (EDGE + 0.002))


def bumped(a, b, xp=jnp):
    near = xp.sum((a - 1.1) ** 2, axis=-1, keepdims=True) < 0.16
    return (a - b - EDGE * xp.round((a - b) / EDGE)) * xp.where(near, 0.9, 1.0)


def cubic(a, b, xp=jnp):  # no Euclidean distance: pairs are as far apart as the diagonal of a cube
    away = xp.abs(a - b).max(-1, keepdims=True)
    return xp.minimum(away, EDGE)


@pytest.mark.parametrize("displacement", [longer, cubic, slow(sheared), slow(bumped)])
def test_the_function_chooses(displacement):
    """Also where it is nearly, but not everywhere, the nearest image in `box`; and about particles with themselves."""
    x = np.random.default_rng(4).random((400, 3)) * EDGE
    away = np.linalg.norm(displacement(x[:, None], x, np), axis=2)
    apart = displacement is not cubic
    near = (away < CUTOFF) & (away.T < CUTOFF)  # as jax-md, which asks in both orders where it has cells
    near = {(i, j) for i, j in zip(*np.nonzero(near)) if i != j or not apart}
    nbrs = jax_md.neighbor_list(jax.jit(displacement), EDGE, CUTOFF, mask_self=apart).allocate(x)
    assert nbrs.kept is not None
    assert pairs_of(nbrs.idx, 400, jax_md.Dense) == near
    for form, order in ((jax_md.Dense, (0, 1)), (jax_md.Sparse, (1, 0))):  # without cells in one: of (j, i) in rows
        every = jax_md.neighbor_list(displacement, EDGE, CUTOFF, mask_self=False, disable_cell_list=True, format=form).allocate(x)
        of_pairs = np.argwhere(away.T < CUTOFF if order[0] == 0 else away < CUTOFF)
        assert pairs_of(every.idx, 400, form) == set(map(tuple, of_pairs.tolist()))


IMAGES_OFTEN = [(jax_md.Dense, True)]  # pairs one after another, and no fractions: of particles that nobody wrapped


@pytest.mark.parametrize(("form", "fractional"), sparing(itertools.product(FORMATS, (True, False)), IMAGES_OFTEN))
def test_several_images(form, fractional):
    matrix, x = MATRIX / 3, points(True, 6)
    given = x if fractional else x @ matrix.T
    lost = given.copy()
    lost[2, 0] = np.nan
    fns = jax_md.neighbor_list_multi_image(None, matrix, CUTOFF, SKIN, fractional_coordinates=fractional, format=form)
    nbrs = fns.allocate(given)
    update = jax.jit(lambda x, nbrs, box: fns.update(x, nbrs, box=box))
    for moved in (given, given + 0.3 + np.sin(given) * 0.2):
        nbrs = update(moved, nbrs, matrix)
        real = np.sum(moved[:, None, :] * matrix, axis=-1) if fractional else moved
        within = reference.reference_images(real, CUTOFF + SKIN, matrix=matrix.T, periodic=(True,) * 3)
        if form is jax_md.OrderedSparse:
            within = {(i, j, s) for i, j, s in within if s > (0, 0, 0) or (s == (0, 0, 0) and i < j)}
        if form is jax_md.Dense:
            i, k = np.nonzero(np.asarray(nbrs.idx) < 6)
            j, s = np.asarray(nbrs.idx)[i, k], np.asarray(nbrs.shifts)[i, k]
        else:
            used = np.asarray(nbrs.receivers) < 6
            i, j, s = (np.asarray(part)[used] for part in (nbrs.receivers, nbrs.senders, nbrs.shifts))
        assert as_set(i, j, s) == within
        assert len(within) == nbrs.n_edges
        assert (nbrs.shifts.dtype, bool(nbrs.did_buffer_overflow)) == (np.int32, False)
    assert update(given, nbrs, 0.2 * matrix).did_buffer_overflow
    assert update(lost, nbrs, matrix).did_buffer_overflow  # though there is room for all that are found


@pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types")  # in jax-md, of its int32 and int64
@pytest.mark.parametrize(("dim", "dtype"), [(1, np.float32), (3, np.float16), (3, jnp.bfloat16)])
def test_several_images_by_jax_md_itself(dim, dtype):
    """In 1D, and of positions of two bytes, where its arithmetic decides; without it, an error says so."""
    x, fns = jnp.asarray(points(True, 12)[:, :dim], dtype), jax_md.neighbor_list_multi_image(None, 1.7, 1.2, SKIN)
    with jax.numpy_dtype_promotion("standard"):
        own = getattr(jax_md, "estimate_max_neighbors", None) and pytest.importorskip("jax_md").custom_partition
        if own is None:
            refuses(TypeError, r"got \[12, \d\] and .*float\d\d: of others, install jax-md", fns.allocate, x)
            return
        made = own.neighbor_list_multi_image(None, 1.7 * jnp.eye(dim), 1.2, SKIN).allocate(x)
        for nbrs, other in ((fns.allocate(x), made), (fns.update(x + dtype(0.2), fns.allocate(x)), made.update(x + dtype(0.2)))):
            assert isinstance(nbrs, own.NeighborListMultiImage)
            jax.tree.map(np.testing.assert_array_equal, nbrs, other.set(update_fn=nbrs.update_fn))


@pytest.fixture(scope="module")
def theirs():
    """jax-md, which needs the promotion of dtypes that is JAX's own."""
    with jax.numpy_dtype_promotion("standard"):
        yield pytest.importorskip("jax_md")


def test_it_is_of_the_types_of_jax_md(theirs):
    """Formats, lists and errors are its own, and all its names are here."""
    partition, x = theirs.partition, jnp.asarray(points(False))
    assert all(hasattr(jax_md, name) for name in vars(partition) if not name.startswith("_"))
    fns = jax_md.neighbor_list(theirs.space.periodic(LENGTHS)[0], LENGTHS, CUTOFF, format=partition.Sparse)
    nbrs = fns.allocate(x, num_particles=N)
    assert isinstance(nbrs, partition.NeighborList)
    assert (nbrs.exact, nbrs.format is partition.Sparse, nbrs.set(idx=None).idx) == (True, True, None)
    graph, mask = partition.to_jraph(nbrs), partition.neighbor_list_mask(nbrs)
    assert int(graph.n_edge[0]) == int(mask.sum()) == len(pairs_of(nbrs.idx, N, partition.Sparse))
    rows = partition.to_dense(nbrs)
    assert pairs_of(rows, N, partition.Dense) == expected(x, "periodic", partition.Dense, 0)


@pytest.mark.parametrize("name", ["free", "periodic", "real", "fractions", "jitted", "wrapped", "elsewhere"])
def test_spaces_of_jax_md(theirs, name):
    """They are known by their code and decided exactly in their own box, whatever `box=` is; what wraps them is measured."""
    space, box = theirs.space, jnp.asarray(MATRIX)
    periodic = space.periodic(LENGTHS)[0]
    displacement, given, kind = {
        "free": (space.free()[0], LENGTHS, "free"),
        "periodic": (space.metric(periodic), 3.3, "periodic"),
        "real": (space.periodic_general(box, fractional_coordinates=False)[0], LENGTHS, "real"),
        "fractions": (space.periodic_general(box)[0], 3.3, "fractional"),
        "jitted": (jax.jit(periodic), LENGTHS, "periodic"),
        "wrapped": (jax.jit(functools.wraps(periodic)(lambda a, b, **_: 0.5 * periodic(a, b))), LENGTHS, None),
        "elsewhere": (space.periodic_general(box)[0], 1.0, None),
    }[name]
    fractional = kind == "fractional"
    x = points(True) @ MATRIX.T if kind == "real" else points(fractional)
    nbrs = jax_md.neighbor_list(displacement, given, CUTOFF, SKIN, fractional_coordinates=fractional).allocate(x)
    assert nbrs.exact == (kind is not None)
    if kind == "real":
        near = reference.reference_images(x, CUTOFF + SKIN, matrix=MATRIX.T, periodic=(True,) * 3)
        assert pairs_of(nbrs.idx, N, jax_md.Dense) == {(i, j) for i, j, _ in near}
    elif kind is not None:
        assert pairs_of(nbrs.idx, N, jax_md.Dense) == expected(x, kind, jax_md.Dense)


@pytest.mark.parametrize("form", ["Dense", "Sparse", "OrderedSparse"])
def test_an_energy_of_jax_md(theirs, form):
    """The same energy and forces, with the list of either."""
    displacement, _ = theirs.space.periodic(LENGTHS[0])
    x, energies = jnp.asarray(points(True) * LENGTHS[0]), []
    for module in (theirs.partition, jax_md):
        form_of = theirs.partition.NeighborListFormat[form]
        nbrs = module.neighbor_list(displacement, LENGTHS[0], CUTOFF, SKIN, format=form_of).allocate(x)
        shape = theirs.space.metric(displacement)
        energy = theirs.smap.pair_neighbor_list(lambda dr, **_: jnp.where(dr < CUTOFF, (CUTOFF - dr) ** 2, 0.0), shape)
        energies.append((energy(x, neighbor=nbrs), jax.grad(energy)(x, neighbor=nbrs)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12), *energies)


def test_particles_that_nobody_wrapped_are_found():
    """Up to 700 boxes away: by `allocate`, and by `update` of a list that was made at home; images have their shifts."""
    rng, edge = np.random.default_rng(0), 6.0
    x = (rng.random((60, 3)) * edge).astype(np.float32)
    far = (x + edge * rng.integers(-700, 701, x.shape)).astype(np.float32)

    @jax.jit
    def nearest(a, b, **_):
        away = a - b
        return away - edge * jnp.round(away / edge)

    expected = reference.reference_images(far, 1.0, matrix=edge * np.eye(3), periodic=(True,) * 3)
    fns = jax_md.neighbor_list(nearest, edge, 1.0, capacity_multiplier=2.0)
    for made in (fns.allocate(far), jax.jit(fns.update)(far, fns.allocate(x))):
        assert (np.count_nonzero(np.asarray(made.idx) < 60), int(made.error.code)) == (len(expected), 0)
    form = jax_md.OrderedSparse
    many = jax_md.neighbor_list_multi_image(None, edge * np.eye(3), 1.0, fractional_coordinates=False, format=form).allocate(far)
    used = np.asarray(many.senders) < 60
    found = as_set(*(np.asarray(part)[used] for part in (many.receivers, many.senders, many.shifts)))
    assert found == {(i, j, s) for i, j, s in expected if s > (0, 0, 0) or (s == (0, 0, 0) and i < j)}
