"""Many particles are sorted by several threads: rows are those of few particles, which one thread sorts, in the same order."""

import functools
import sys

import jax
import numpy as np
import pytest
from places import ROOT
from started import run_python

import jfrnn
from jfrnn.kernels import cells_cpu

N = 700
RNG = np.random.default_rng(0)
X = RNG.random((N, 3)).astype(np.float32)
SITES = RNG.permutation(np.stack(np.meshgrid(*[np.arange(9.0)] * 3), axis=-1).reshape(-1, 3))  # in float64
SOME = np.where(RNG.random((N, 1)) < 0.1, np.nan, X).astype(np.float32)
FAR = (X * 10.0 ** RNG.integers(0, 6, (N, 1))).astype(np.float32)
SYSTEMS = np.sort(RNG.integers(0, 5, N))
BOXES = jfrnn.Box(np.stack([np.diag([1.0, 1.0, 1.0]) + 0.1 * s * np.eye(3, k=1) for s in range(5)]).astype(np.float32))
RADII = RNG.uniform(0.1, 0.2, N).astype(np.float32)
SCENES = {
    "open": (X, 0.2, {}),
    "a lattice, in float64": (SITES, 2.0, {"closed": True}),
    "not finite, in a batch": (SOME, 0.25, {"batch": SYSTEMS}),
    "sparse": (FAR, 0.3, {}),
    "skewed box": (X, 0.2, {"box": jfrnn.Box(np.eye(3) + 0.3 * np.eye(3, k=1))}),
    "boxes of systems": (X, 0.3, {"box": BOXES, "batch": SYSTEMS}),
    "more queries than sources": (X[:50], 0.2, {"queries": SOME}),
    "no sources": (X[:0], 0.2, {"queries": X[:40]}),
    "cutoffs that are alike": (X, RADII, {}),
    "cutoffs over many scales": (FAR, (0.3 * np.linalg.norm(FAR, axis=1)).astype(np.float32), {}),
    "cutoffs of sources, for queries": (X, RADII, {"queries": SOME[:90], "radius_rule": "scatter"}),
}


def find_rows():
    """Return the rows of each scene, in their order, and its status."""
    rows = {}
    for name, (x, cutoff, options) in SCENES.items():
        given = {"positions": x, "queries": options.get("queries")}  # traced: then rows are told from what is not finite by status
        nbrs = jax.jit(lambda given: jfrnn.search(cutoff=cutoff, capacity=N, backend="warp", **options | given))(given)  # noqa: B023
        rows[name] = np.asarray(nbrs.idx)
        rows[f"{name}: status"] = np.asarray(nbrs.status)
    return rows


def write_rows(file):
    cells_cpu.MANY = cells_cpu.CHUNKS["MANY"] = 1
    cells_cpu.CHUNKS["SORT_CHUNK"] = cells_cpu.CHUNKS["CHUNK"] = cells_cpu.SORT_CHUNK = 16
    np.savez(file, **find_rows())


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of a GPU sort by themselves")
def test_many_are_sorted_as_few_are(tmp_path):
    file = tmp_path / "rows.npz"
    run_python("-c", f"import sys; sys.path[:0] = {sys.path!r}; import test_sort; test_sort.write_rows({str(file)!r})", cwd=ROOT)
    many, few = np.load(file), find_rows()
    assert all((rows[:, 0] < N).sum() > 10 for name, rows in few.items() if name in SCENES and name != "no sources")
    for name, rows in few.items():
        np.testing.assert_array_equal(many[name], rows, err_msg=name)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of a GPU sort by themselves")
@pytest.mark.parametrize("which", ["uniform", "in one cell"])
def test_many_particles_have_the_rows_of_the_array_engine(which):
    x = np.random.default_rng(1).random((cells_cpu.MANY + 1000, 3)).astype(np.float32)
    x[2::30] = x[2::30] if which == "uniform" else np.float32(0.5) + np.float32(1e-6) * x[2::30]
    x[7] = np.nan
    found, expected = (jax.jit(functools.partial(jfrnn.count, cutoff=0.02, backend=each))(x) for each in ("warp", "jax"))
    np.testing.assert_array_equal(found, expected)
    assert np.maximum(found, 0).sum() > 30_000  # that of a particle that is not finite is the least integer
