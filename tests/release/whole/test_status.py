"""What each public call does for each status bit: all of them are run, and compared with the table of docs/guides/status.md."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses, slow
from places import ROOT

import jfrnn
import jfrnn.distributed
from jfrnn import Status, jax_md
from jfrnn.ase import primitive_neighbor_list

PAGE = ROOT / "docs" / "guides" / "status.md"
N, CUTOFF = 24, 0.4
LENGTHS = np.array([1.0, 1.2, 0.9], np.float32)
X = (np.random.default_rng(0).random((N, 3)) * LENGTHS).astype(np.float32)
BAD = 5  # the particle that is not finite, or too far away
BOX = jfrnn.Box(LENGTHS, images=0)
PLATE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32), np.array([[0, 1, 2], [1, 2, 3]], np.int32)


def damaged(value):
    x = X.copy()
    x[BAD] = value
    return x


# For each bit: positions, and the arguments that set it. `traced` ones are known to be wrong only inside jit.
SCENES = {
    Status.NONFINITE: (damaged(np.nan), {}, {}),
    Status.BOX_TOO_SMALL: (X, {"box": jfrnn.Box(0.5 * LENGTHS, images=0)}, {}),
    Status.OUT_OF_RANGE: (damaged(1e12), {"box": BOX}, {}),
    Status.INVALID_CUTOFF: (X, {"cutoff": np.where(np.arange(N) == BAD, -1, CUTOFF).astype(np.float32)}, {}),
    Status.SYSTEM_WITHOUT_BOX: (
        X,
        {"box": jfrnn.Box([LENGTHS, LENGTHS], per_system=True, images=0), "batch": np.where(np.arange(N) == BAD, 7, 0)},
        {},
    ),
    Status.EXCLUDED_OUT_OF_RANGE: (X, {}, {"exclude": np.array([[0, 99]])}),
}
ZERO = [0]  # a number that is traced inside jit, so that what it is added to is
LISTS = {}  # that calls of one program share
KINDS = {"not finite": [Status.NONFINITE], "invalid": [bit for bit in SCENES if bit != Status.NONFINITE]}


def options(bit, traced):
    """Return positions, cutoff and other arguments of a search that sets a bit; those that only jit takes are left out outside."""
    x, given, inside = SCENES.get(bit, (X, {"box": BOX}, {}))
    given = given | ({name: value + ZERO[0] for name, value in inside.items()} if traced else {})
    return x, given.get("cutoff", CUTOFF), {name: value for name, value in given.items() if name != "cutoff"}


def calls(makes, traced):
    """Run calls, each by itself outside of jit, or all in one program inside; say in the words of the table what came back."""
    said = {}

    def attempt(name, finish):
        try:
            found = makes[name]()
            said[name] = found if isinstance(found, str) else finish(found)
        except jfrnn.NeighborOverflowError:
            said[name] = "raises `NeighborOverflowError`"
        except (ValueError, RuntimeError) as error:
            said[name] = f"raises `{type(error).__name__}`"

    def program(zero):
        ZERO[:] = [zero]
        LISTS.clear()
        for name in makes:
            attempt(name, lambda found: found)
        return {name: said.pop(name) for name in makes if not isinstance(said[name], str)}

    if traced:
        said |= {name: tell(found) for name, found in jax.jit(program)(0).items()}
    else:
        ZERO[:] = [0]
        LISTS.clear()
        for name in makes:
            attempt(name, tell)
    LISTS.clear()
    return {name: said[name] for name in makes}


def tell(found):
    if hasattr(found, "status") and not isinstance(found, tuple):
        return "the bit" if Status(int(found.status)) else "nothing"
    words = {tell_array(x) for x in jax.tree.leaves(found)}
    assert len(words) == 1, words
    return words.pop()


def tell_array(x):
    x = np.asarray(x)
    floats = np.issubdtype(x.dtype, np.floating)
    unknown = np.isnan(x) if floats else x == np.iinfo(x.dtype).min
    rows = unknown.reshape(len(x), -1) if x.ndim else unknown.reshape(1, 1)
    name = "NaN" if floats else "the smallest integer"
    if rows.all():
        return name
    if len(rows) == N and rows[BAD].all() and not np.delete(rows, BAD, axis=0).any():
        return f"{name} in its row"
    assert not unknown.any()
    return "without it"


def one(r, i, j):
    return 1 + 0 * (r @ r)


def whole(r, i, j):
    return jnp.int32(1)


def shared(make):
    """Make a list once for all calls of a program."""

    def of(*key):
        if (make, key) not in LISTS:
            LISTS[make, key] = make(*key)
        return LISTS[make, key]

    return of


@shared
def made(bit, traced):
    x, cutoff, given = options(bit, traced)
    return x, jfrnn.search(x, cutoff, capacity=2 if bit == Status.ROW_OVERFLOW else 256, **given)


@shared
def edges_made(bit, traced):
    x, cutoff, given = options(bit, traced)
    return x, jfrnn.search_edges(x, cutoff, total=3 if bit == Status.ROW_OVERFLOW else 6000, **given)


def lists(name, method, make=made):
    """Return a row of the table: a method of a list that holds the bit."""
    return name, lambda bit, traced: method(*make(bit, traced))


def search_verb(verb):
    def run(bit, traced):
        x, cutoff, given = options(bit, traced)
        return verb(x, cutoff, **given)

    return run


def sum_over(fn, make=made):
    def run(bit, traced):
        x, nbrs = make(bit, traced)
        return jfrnn.pair_sum(fn, x, None, neighbors=nbrs)

    return run


def grown(nbrs, x):
    return "more room" if int(nbrs.grow(x).status) == 0 else "the bit"


def kept_pairs(nbrs, total):
    """Return that what is exported is what the list holds, whatever its status."""
    i, _ = nbrs.pairs(total)
    return "what is listed" if isinstance(i, jax.core.Tracer) else i


VERBS = dict(
    [
        lists("search", lambda x, nbrs: nbrs),
        lists("search_edges", lambda x, nbrs: nbrs, edges_made),
        ("count", search_verb(jfrnn.count)),
        ("pair_sum, of floats", search_verb(functools.partial(jfrnn.pair_sum, one))),
        ("pair_sum, of integers", search_verb(functools.partial(jfrnn.pair_sum, whole))),
        ("pair_sum(neighbors=), of floats", sum_over(one)),
        ("pair_sum(neighbors=), of integers", sum_over(whole)),
        ("pair_sum(neighbors=EdgeList)", sum_over(one, edges_made)),
        lists("NeighborList.vectors", lambda x, nbrs: nbrs.vectors(x)[0]),
        lists("NeighborList.distances", lambda x, nbrs: nbrs.distances(x)[0]),
        lists("NeighborList.shifts", lambda x, nbrs: nbrs.shifts(x)),
        lists("NeighborList.edges", lambda x, nbrs: [(e := nbrs.edges(x, 6000)).displacement, e.distance]),
        lists("NeighborList.to_jraph", lambda x, nbrs: [(e := nbrs.to_jraph(x, 6000).edges)["displacement"], e["distance"]]),
        lists("EdgeList.edges", lambda x, nbrs: [(e := nbrs.edges(x)).displacement, e.distance], edges_made),
        lists("EdgeList.to_jraph", lambda x, nbrs: [(e := nbrs.to_jraph(x).edges)["displacement"], e["distance"]], edges_made),
        lists("NeighborList.update", lambda x, nbrs: nbrs.update(x)),
        lists("EdgeList.update", lambda x, nbrs: nbrs.update(x), edges_made),
        lists("NeighborList.pairs(total), csr(total)", lambda x, nbrs: kept_pairs(nbrs, 6000)),
        lists("NeighborList.to_jax_md", lambda x, nbrs: "what is listed" if nbrs.to_jax_md().idx is nbrs.idx else "other"),
    ]
)
OF_NO_LIST = ("count", "pair_sum, of floats", "pair_sum, of integers")
OUTSIDE = dict(  # calls that are not for jit
    [
        lists("NeighborList.check, EdgeList.check", lambda x, nbrs: nbrs.check()),
        lists("NeighborList.pairs(), csr()", lambda x, nbrs: nbrs.pairs()[0]),
        lists("EdgeList.pairs()", lambda x, nbrs: nbrs.pairs()[0], edges_made),
        lists("NeighborList.grow, EdgeList.grow, run_chunk", lambda x, nbrs: grown(nbrs, x)),
    ]
)


def observed(every=False):
    """Run every call for every bit; return the table: the name of a call -> what it does in the four columns.

    If not `every` call is run for each bit, the bits that mean missing pairs take turns, call by call.
    """
    table = {name: [] for name in VERBS | OUTSIDE}
    for bits in KINDS.values():
        for traced in (False, True):
            words = {}
            asked = [bit for bit in bits if traced or bit != Status.EXCLUDED_OUT_OF_RANGE]  # outside jit, the search itself raises
            for turn, bit in enumerate(asked):
                verbs = list((VERBS if traced else VERBS | OUTSIDE).items())
                verbs = dict(verbs if every else verbs[turn :: len(asked)])
                words[bit] = calls({name: functools.partial(verb, bit, traced) for name, verb in verbs.items()}, traced)
            for name, cells in table.items():
                found = {bit: said[name] for bit, said in words.items() if name in said}
                if "grow" in name and Status.BOX_TOO_SMALL in found:
                    assert found.pop(Status.BOX_TOO_SMALL) == "more room"  # images
                assert len(set(found.values())) == (0 if traced and name in OUTSIDE else 1), (name, traced, found)
                cells.append(next(iter(found.values()), ""))
    return table


def full_lists(traced):
    """Return a row of the table for each call on lists, and sums over them, whose rows, or whose total, overflowed."""
    makes = {name: make for name, make in (VERBS if traced else VERBS | OUTSIDE).items() if name not in OF_NO_LIST}
    return calls({name: functools.partial(make, Status.ROW_OVERFLOW, traced) for name, make in makes.items()}, traced)


def others():
    """Run the calls that have bits, or errors, of their own: triangles, distributed particles and adapters."""
    corners, faces = PLATE
    lost, torn = corners.copy(), faces.copy()
    lost[3], torn[1] = np.nan, [0, 1, 9]
    x, table = np.abs(X) * np.float32(0.1), {}
    for vertices, named, capacity in ((corners, faces, 1), (lost, faces, 2), (corners, torn, 2)):  # the first has few slots
        for traced in (False, True):
            tri = shared(functools.partial(jfrnn.search_triangles, x, vertices, named, 1.0, capacity=capacity))
            made = {"search_triangles": tri, "signed_distance": lambda tri=tri: tri().signed_distance(x).distance}
            made |= {"closest": lambda tri=tri: tri().closest(x)[1], "contacts": lambda tri=tri: tri().contacts(x)[1]}
            for name, said in calls(made, traced).items():
                table.setdefault(name, []).append(said)
    return table


def rows_of_page(title):
    """Return the table below a heading of the page: the first column -> the others."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {title}\n", 1)[1].split("\n## ", 1)[0]
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return {row[0].replace("`", ""): row[1:] for row in rows[2:]}


def as_rows(table):
    return {name: [cell or "-" for cell in cells] for name, cells in table.items()}


@functools.cache
def everything(every):
    outside, inside = full_lists(False), full_lists(True)
    return {name: [*cells, outside.get(name, ""), inside.get(name, "")] for name, cells in observed(every).items()}


@pytest.mark.parametrize("every", [False, slow(True)], ids=["in_turns", "every"])
def test_the_page_says_what_every_call_does(every):
    assert rows_of_page("Searches, lists and sums") == as_rows(everything(every))


def test_the_page_says_what_calls_about_walls_do():
    assert rows_of_page("Walls of triangles") == as_rows(others())


def test_every_bit_has_a_row_and_a_message():
    told = rows_of_page("Bits")
    assert list(told) == [bit.name for bit in Status if bit]
    assert all(bit.message and "in this list" not in bit.message for bit in Status)
    assert Status.OK.message == "nothing to report."


def test_no_call_answers_with_a_number_where_it_may_be_wrong():
    """Not one cell of bits that mean missing pairs is a plain number."""
    for name, (_, _, *cells) in everything(False).items():
        assert all(cell != "without it" for cell in cells), name


def test_adapters_raise_or_have_a_code():
    def free(a, b, **_):
        return a - b

    def nearest(a, b, **_):
        away = a - b
        return away - 5 * jnp.round(away / 5)

    x = np.random.default_rng(1).random((40, 3)).astype(np.float32) * 5
    for displacement in (free, nearest):
        fns = jax_md.neighbor_list(displacement, 5.0, 1.0, 0.2)
        refuses(ValueError, r"not finite|non-finite", fns.allocate, jnp.asarray(x).at[3].set(jnp.nan))
        nbrs = fns.allocate(x)
        assert int(nbrs.update(jnp.asarray(x).at[3].set(jnp.nan)).did_buffer_overflow) != 0
    assert int(nbrs.update(jnp.asarray(x).at[3].set(1e12)).error.code) != 0
    fns = jax_md.neighbor_list_multi_image(None, 5.0 * np.eye(3), 1.0, 0.2, fractional_coordinates=False)
    refuses(ValueError, "non-finite", fns.allocate, jnp.asarray(x).at[3].set(jnp.nan))
    assert bool(fns.allocate(x).update(jnp.asarray(x).at[3].set(jnp.nan)).did_buffer_overflow)
    refuses(ValueError, "finite", primitive_neighbor_list, "ij", True, np.eye(3), np.full((2, 3), np.nan), 0.3)


def test_distributed_calls():
    mesh = jax.make_mesh((1,), ("x",))
    particles = jfrnn.distributed.scatter(damaged(np.nan), CUTOFF, mesh=mesh)
    nbrs = jfrnn.distributed.search(particles, CUTOFF)
    refuses(ValueError, "non-finite", nbrs.check)
    ids = np.asarray(particles.ids)
    counts, sums = jfrnn.distributed.count(particles, CUTOFF), jfrnn.distributed.pair_sum(one, particles, CUTOFF)
    there = ids >= 0
    np.testing.assert_array_equal(np.asarray(counts)[there] == np.iinfo(np.int32).min, ids[there] == BAD)
    np.testing.assert_array_equal(np.isnan(sums)[there], ids[there] == BAD)
    full = jfrnn.distributed.search(particles, CUTOFF, capacity=2)
    refuses(RuntimeError, "capacity", full.check)
    with pytest.raises(RuntimeError):
        jfrnn.distributed.pair_sum(one, particles, None, neighbors=full)


def test_errors_name_the_particle():
    refuses(ValueError, rf"positions\[{BAD}\] is \[nan, nan, nan\]", jfrnn.count, damaged(np.nan), CUTOFF)
    with pytest.raises(ValueError, match=rf"positions\[{BAD}\] lies 1\.1\d*e\+12 lattice vectors away along axis 2"):
        jfrnn.count(damaged(1e12), CUTOFF, box=BOX)
    refuses(ValueError, rf"queries\[{BAD}\] is \[nan", jfrnn.count, X, CUTOFF, queries=damaged(np.nan))
    x, radii, _ = options(Status.INVALID_CUTOFF, False)
    refuses(ValueError, rf"cutoff\[{BAD}\] is -1", jfrnn.pair_sum, one, x, radii)
    nbrs = jfrnn.search(X, CUTOFF, box=BOX, skin=0.02, capacity=40).update(damaged(1e12))
    refuses(ValueError, rf"positions\[{BAD}\] lies", nbrs.check)


def test_a_count_that_is_not_known_is_no_number():
    """Copper's primitive cell, 78 neighbors within 6: too few images, or a traced cell, and 24 of them are found."""
    cell, x = np.array([[0, 1.8, 1.8], [1.8, 0, 1.8], [1.8, 1.8, 0]], np.float32), np.zeros((1, 3), np.float32)
    assert jfrnn.count(x, 6.0, box=jfrnn.Box(cell)).tolist() == [78]
    unknown = np.iinfo(np.int32).min
    assert jax.jit(lambda cell: jfrnn.count(x, 6.0, box=jfrnn.Box(cell)))(cell).tolist() == [unknown]
    images = jfrnn.Box(cell).images_for(6.0)
    assert jax.jit(lambda cell: jfrnn.count(x, 6.0, box=jfrnn.Box(cell, images=images)))(cell).tolist() == [78]
    with pytest.raises(ValueError, match=r"needs images=\(3, 3, 3\) in this box as it is now, and here images=\(1, 1, 1\)"):
        jfrnn.count(x, 6.0, box=jfrnn.Box(cell, images=1))
    refuses(ValueError, r"needs images=\(3, 3, 3\)", jfrnn.pair_sum, one, x, 6.0, box=jfrnn.Box(cell, images=1))
    refuses(ValueError, r"needs images=\(3, 3, 3\)", jfrnn.search(x, 6.0, box=jfrnn.Box(cell, images=1), capacity=80).check)
    assert re.search("images_for", Status.BOX_TOO_SMALL.message)
