"""Shared by all tests: both float widths are on, and arrays never mix dtypes in silence."""

import os
from itertools import count
from pathlib import Path

import jax
import numpy as np
import pytest
import soon
import warp
from jax._src import compiler

from jfrnn._engine import launch, tuning
from jfrnn._tracing import programs
from jfrnn.kernels import _clang

pytest_plugins = ["progress"]
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_traceback_in_locations_limit", 0)
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"  # programs tell no line of the sources they were traced from: it takes long
os.environ[soon.ASKED] = "1"  # in processes that tests start, as `_compiled_soon` in this one
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # to compile the sources of JAX takes each of them a second and a half
# What XLA compiled is kept for the next run, here and in processes that tests start: half of the time of the tests.
KEPT = {
    "jax_compilation_cache_dir": os.environ.get("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".cache" / "xla")),
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
for name, value in KEPT.items():
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)
soon.collect_seldom()
TESTS = count(1)
programs._MOST_BYTES = 1 << 40  # tests share programs that come once or twice each
tuning.CPU = tuning.CPU._replace(plain_pairs=tuning.CPU.few_pairs)  # "jax" sorts most scenes of tests; "brute" tests all pairs
XLA_FLAGS = os.environ.get("XLA_FLAGS", "")
UNFUSED = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
warp.config.log_level = warp.LOG_WARNING  # else it prints what it compiles, into doctests too
# Files, those first that take longest: what is left at the end is short, and no worker waits for another's long file.
LONGEST = (
    "types", "docs", "lowest", "status", "kept", "hard_cases", "box", "triangles", "pair_sum", "experiments_sweep",
    "triangles_closest", "cases_periodic", "boxes", "exact", "reverse", "radii", "search", "memory", "pair_sum_warp", "reference",
    "arrays", "triangles_cuda", "order", "experiments_peers", "experiments_gpu", "notebooks", "jax_md", "boxes_radii",
    "distributed", "verlet", "joint", "pair_sum_cuda", "sph_solids", "verlet_boxes", "edges", "fractional", "transforms", "batch",
    "modes", "spread", "translate", "cell_line", "start", "pair_sum_warp_spaces", "experiments_lists", "experiments_lj", "who",
    "neighbors", "native", "experiments_sums", "triangles_contacts", "cells", "sph_speed", "sph_parts", "search_edges",
    "experiments_methods", "sph_run", "triangles_moving", "ase", "exports", "travel", "buffers", "package",
    "experiments_distributed", "experiments_start", "experiments_report", "experiments_commands", "house", "interrupts",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Put the longest files first; their tests stay in order."""
    place = {f"test_{name}.py": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


@pytest.fixture(autouse=True)
def _release_programs():
    """Drop compiled programs before their memory maps reach the kernel's limit (65 530 per process on Linux)."""
    yield
    maps = Path("/proc/self/maps")
    if next(TESTS) % 16 == 0 and maps.exists() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def _both_widths():
    """Turn float64 on again: commands that a test calls in this process may have turned it off."""
    yield
    jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session", autouse=True)
def _quick_options():
    """Return a function that asks for a quick compilation, as JAX asks for any, and processes that tests start do so, too.

    None where this JAX knows of no such thing.
    """
    whole = getattr(compiler, "get_compile_options", None)
    try:
        jax.jit(lambda: 0, compiler_options=UNFUSED)()  # XLA_FLAGS are read here, and not again
    except jax.errors.JaxRuntimeError:
        return None
    flags = " ".join(f"--{name}={str(value).lower()}" for name, value in UNFUSED.items())
    os.environ["XLA_FLAGS"] = f"{XLA_FLAGS} {flags}"

    def quick(*args, env_options_overrides=None, **kwargs):
        return whole(*args, env_options_overrides=UNFUSED | (env_options_overrides or {}), **kwargs)

    return whole and quick


def _compile_kernels(options):
    """Compile kernels with these options (`soon.py`) from now on; those that were compiled with others are let go."""
    if options == _clang.OPTIONS:
        return
    _clang.OPTIONS = options
    for key in list(launch._plans):  # programs that call them ask for them again
        launch._open().drop(launch._plans.pop(key))


@pytest.fixture(autouse=True)
def _compiled_soon(request, monkeypatch, _quick_options):
    """Leave out what takes long to compile, but in slow tests, and where memory or the last digits of floats are tested."""
    asked = {mark.name for mark in request.node.iter_markers()}
    fully = not asked.isdisjoint(("slow", "fully_compiled"))
    _compile_kernels(soon.AS_USERS_DO if fully or "kernels" in asked else soon.SOON)
    if fully:
        monkeypatch.delenv(soon.ASKED)
        monkeypatch.setenv("XLA_FLAGS", XLA_FLAGS)
    elif _quick_options:
        monkeypatch.setattr(compiler, "get_compile_options", _quick_options)
    jax.config.update("jax_disable_most_optimizations", not fully)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(params=[np.float32, np.float64], ids=["f32", "f64"])
def dtype(request):
    return request.param


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param


@pytest.fixture
def foreign():
    """Let other libraries mix dtypes, as they do, and adapters set how wide floats are, for a test alone."""
    wide = jax.config.jax_enable_x64
    with jax.numpy_dtype_promotion("standard"):
        yield
    jax.config.update("jax_enable_x64", wide)
