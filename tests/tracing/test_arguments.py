"""What users may give for arrays: those of JAX and NumPy, and lists of numbers; arrays of other libraries with a hint."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses

import jfrnn
from jfrnn._tracing import as_array

POINTS = [[0.0, 0.0], [0.5, 0.0], [2, 0]]


class Foreign:
    """An array of another library, as JAX can take it."""

    dtype, shape, ndim = "foreign", (3, 2), 2

    def __dlpack__(self):
        raise AssertionError


@pytest.mark.parametrize(
    ("cutoff", "options", "wanted"),
    [
        (1.0, {}, [1, 1, 0]),
        ([1.0, 0.4, 3], {}, [1, 0, 2]),
        ([[0.0, 1.0], [1.0, 9.0]], {"species": [0, 1, 1]}, [1, 2, 1]),
        (1.0, {"queries": [[0, 0], [2, 0.5]]}, [2, 1]),
        (9.0, {"batch": [0, 0, 1]}, [1, 1, 0]),
        (9.0, {"active": [True, False, True]}, [1, 0, 1]),
    ],
)
def test_lists_of_numbers_are_arrays(cutoff, options, wanted):
    assert np.asarray(jfrnn.count(POINTS, cutoff, **options)).tolist() == wanted


def test_lists_are_arrays_elsewhere_too():
    nbrs = jfrnn.search(POINTS, 1.0, exclude=[[0, 1]], capacity=2)
    assert np.asarray(nbrs.idx).tolist() == [[3, 3]] * 3
    assert np.asarray(jfrnn.sort_order([[1, 0], [0, 0]], 1.0)).tolist() == [1, 0]
    assert np.asarray(jfrnn.hilbert_encode([[0, 0], [1, 0]], bits=1)).tolist() == [0, 3]
    corners, _ = jfrnn.merge_vertices([[0, 0], [1, 0], [0, 0]], [[0, 1], [1, 2]])
    assert np.asarray(corners).tolist() == [[0, 0], [1, 0]]


def test_lists_may_be_empty():
    none = np.zeros((0, 2))
    for options in ({"batch": []}, {"active": []}, {"batch": ([0] * 3, []), "queries": none}):
        assert jfrnn.count(none if "queries" not in options else POINTS, 1.0, **options).shape == (0,)
    assert jfrnn.count(none, [[1.0]], species=[]).shape == (0,)
    refuses(ValueError, r"batch must have shape \[3\], .*got shape \[0\]", jfrnn.count, POINTS, 1.0, batch=[])


@pytest.mark.parametrize("name", ["positions", "cutoff", "queries", "active", "batch", "species", "exclude", "box", "values"])
def test_arrays_of_others_come_by_dlpack(name):
    given = {"positions": POINTS, "cutoff": [[1.0]] if name == "species" else 1.0} | {name: Foreign()}
    said = {"box": "lengths_or_matrix", "values": r"values\['m'\]"}.get(name, name)
    with pytest.raises(
        TypeError, match=rf"{said} must be an array of JAX or NumPy, got test_arguments.Foreign: pass jnp.from_dlpack\({said}\)"
    ):
        if name == "box":
            jfrnn.Box(given[name])
        elif name == "values":
            jfrnn.pair_sum(lambda r, i, j: j["m"], POINTS, 1.0, {"m": given[name]})
        else:
            jfrnn.count(given.pop("positions"), given.pop("cutoff"), **given)


def test_exclusions_that_name_nobody_are_named():
    said = r"exclude must hold numbers of particles below 3, or -1 in padding, got \[0, 99\] in row 0"
    refuses(ValueError, said, jfrnn.count, POINTS, 1.0, exclude=[[0, 99]])


def test_lists_that_are_no_arrays():
    with pytest.raises(TypeError, match=r"x must be an array, got a list of which NumPy makes none: .*inhomogeneous"):
        as_array("x", [[0.0], [0.0, 1.0]])
    refuses(TypeError, "x must be an array of numbers, got a list of which NumPy makes <U1", as_array, "x", ["a"])
    with pytest.raises(TypeError, match=r"x must be an array, got a tuple of traced values: pass jnp.stack\(x\)"):
        jax.eval_shape(lambda x: as_array("x", (x, x)), jnp.zeros(2))
    assert as_array("x", [1, 2], np.dtype(np.float32)).dtype == np.float32
