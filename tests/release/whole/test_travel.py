"""Programs that travel: exported or compiled here, they run in a process that has imported the library and traced nothing."""

import dataclasses
import pickle
import re

import jax
import numpy as np
import pytest
import travelled
from checked import refuses
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from places import TESTS
from started import run_python

import jfrnn

SAFE = [jax.export.DisabledSafetyCheck.custom_call("jfrnn")]


def run_elsewhere(way, folder, right):
    """Run the program of a folder in a fresh process, and compare what it gives; return what it writes."""
    done = run_python(TESTS / "travelled.py", way, folder, JAX_ENABLE_X64="1", JAX_NUMPY_DTYPE_PROMOTION="strict")
    with np.load(folder / "answers.npz") as found:
        for x, name in zip(right, found, strict=True):
            np.testing.assert_array_equal(found[name], x)
    return done.stdout


def calls(text):
    """Return the lines of a program that call the library."""
    return re.findall(r"custom_call @jfrnn\(.*", text)


@pytest.fixture
def compiled_here():
    """Leave the programs of earlier runs alone: XLA writes one that it read from a file without some of its functions."""
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    yield
    jax.config.update("jax_enable_compilation_cache", before)
    compilation_cache.reset_cache()


@pytest.mark.usefixtures("compiled_here")
def test_everything_that_was_compiled_runs_elsewhere(tmp_path):
    x = travelled.points()
    program = jax.jit(travelled.everything).lower(x).compile()
    (tmp_path / "program").write_bytes(pickle.dumps(serialize_executable.serialize(program)))
    run_elsewhere("interrupted", tmp_path, program(x))
    run_elsewhere("compiled", tmp_path, program(x))
    here, there = (calls(text) for text in (jax.jit(travelled.everything).lower(x).as_text(), (tmp_path / "text").read_text()))
    assert len(here) >= 6
    assert here == there  # names hold no addresses, and no numbers of what was traced before


def test_what_was_exported_runs_elsewhere_with_the_same_version(tmp_path):
    program = jax.export.export(jax.jit(travelled.counted), disabled_checks=SAFE)(travelled.points())
    whole = dataclasses.replace(program, _get_vjp=None)  # can be pickled; `serialize` needs another package
    (tmp_path / "program").write_bytes(pickle.dumps(whole))
    told = run_elsewhere("exported", tmp_path, travelled.counted(travelled.points()))
    assert "made with another version of jfrnn. Export or compile it again with this one." in told


def test_programs_with_lists_are_written_to_bytes_and_run_elsewhere_with_the_same_version(tmp_path):
    x, box = travelled.points(), jfrnn.Box([[1.0, 0.0], [0.3, 1.0]])
    nbrs = jfrnn.search(x, 0.2, skin=0.02, box=box, batch=np.arange(40) % 2, reverse=True, exclude=[[0, 1]])
    program = jax.export.export(jax.jit(travelled.step), disabled_checks=SAFE)(x, nbrs)
    (tmp_path / "bytes").write_bytes(program.serialize())
    (tmp_path / "program").write_bytes(pickle.dumps(nbrs))
    renewed, sums = travelled.step(x, nbrs)
    told = run_elsewhere("written", tmp_path, (*jax.tree.leaves(renewed), sums))
    assert "made with another version of jfrnn. Export or compile it again with this one." in told


@pytest.mark.parametrize("lower", ["cpu", "cuda"])
def test_programs_are_exported_for_any_platform(lower):
    both = jax.jit(lambda x: (*travelled.counted(x), jfrnn.count(x, 0.25, backend="hashgrid")))
    text = jax.export.export(both, platforms=[lower], disabled_checks=SAFE)(travelled.points()).mlir_module()
    names = re.findall(r'kernel = "(\w+)', text)
    cells = "cells_cpu" if lower == "cpu" else "few_cuda"
    assert names == [f"jfrnn_{cells}_2d_f32_own_dropself", f"jfrnn_hashgrid_{lower}_2d_f32_own_dropself_0x1"]


@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_symbols_in_shapes_are_refused(backend):
    """A symbol is no number of particles: one error says what to do."""
    many = jax.ShapeDtypeStruct(jax.export.symbolic_shape("n, 3"), np.float32)
    faces = jax.ShapeDtypeStruct(jax.export.symbolic_shape("f, 3"), np.int32)
    wall = np.zeros((4, 3), np.float32)

    def refused(function, x, name, symbol):
        said = rf"^{name} must have a shape of numbers, got \({symbol}, 3\): .*Export one program for each"
        refuses(ValueError, said, jax.export.export(jax.jit(function), disabled_checks=SAFE), x)

    refused(lambda x: jfrnn.search(x, 0.1, capacity=8, backend=backend), many, "positions", "n")
    refused(lambda x: jfrnn.count(wall, 0.1, queries=x, backend=backend), many, "queries", "n")
    refused(lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.1, backend=backend), many, "positions", "n")
    refused(lambda x: jfrnn.search_triangles(x, wall, [[0, 1, 2]], 0.1, capacity=3, backend=backend), many, "positions", "n")
    refused(lambda x: jfrnn.search_triangles(wall, wall, x, 0.1, capacity=3, backend=backend), faces, "faces", "f")
