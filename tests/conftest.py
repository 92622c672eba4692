"""Shared by all tests: both float widths are on, and arrays never mix dtypes in silence."""

import gc
import os
from itertools import count
from pathlib import Path

import jax
import numpy as np
import pytest
import warp

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # in processes that tests start, as `_compiled_soon` in this one
gc.freeze()  # imported modules are no garbage; tracing makes many objects that stay: to look through them takes a tenth of the time
gc.set_threshold(50_000, 20, 20)
TESTS = count(1)
warp.config.log_level = warp.LOG_WARNING  # else it prints what it compiles, into doctests too


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


@pytest.fixture(autouse=True)
def _compiled_soon(request, monkeypatch):
    """Leave out what LLVM takes long for, but in slow tests, those of memory, and where the last digits of floats are tested."""
    marked = any(request.node.get_closest_marker(name) for name in ("slow", "fully_compiled"))
    fully = marked or "memory" in request.node.nodeid
    if fully:
        monkeypatch.delenv("JAX_DISABLE_MOST_OPTIMIZATIONS")
    jax.config.update("jax_disable_most_optimizations", not fully)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(params=[np.float32, np.float64], ids=["f32", "f64"])
def dtype(request):
    return request.param


@pytest.fixture(params=[2, 3], ids=["2d", "3d"])
def dim(request):
    return request.param
