"""Which engine answers: what "auto" stands for on a platform, and whether a named engine can run there. Decided while tracing."""

import functools
import warnings

import jax
from jax import Array
from jax.core import Tracer

from jfrnn._engine.start import level_of_caller
from jfrnn._engine.warp import load_warp, missing

WARP_ENGINES = ("warp", "hashgrid")


# From how many sources on Warp is the engine to take, by platform; below, and where nothing was measured, it is "jax".
# `python -m experiments crossover`, rows in experiments/results/crossovers: compiled searches of 16 to 100 000 random points in
# 3D with 30 and 108 neighbors. On the CPU no engine is faster than Warp at any size: brute force is level with it up to 32
# points, 1.2x slower at 64; jax is 1.2x slower at 16, 3x at 256, 15x at 100 000. Warp compiles sooner too: in 0.05 s instead of
# 1 to 3 s. On an H200 (16, 32 and 64 points measured) jax takes 1.8 to 2.1 times as long as Warp, brute force 1.2 to 1.4 times;
# and Warp lists 250 000 points (experiments/results/h200) in less time than jax 64. On the CPU, Warp is per particle 14 to 20 times
# as fast with a box or a batch, 4 to 26 times with a cutoff per particle (experiments/results/options: cpu_warp.csv, cpu_jax.csv).
_WARP_FROM = {"cpu": 0, "gpu": 0}


def choose_engine(
    backend: str, sources: Array, queries: Array | None, *, periodic: bool = False, radii: bool = False, batch: bool = False
) -> str:
    """Return the engine that a backend stands for; raise where one that was named cannot run on the platform.

    Raises:
        ImportError: "warp" or "hashgrid", and Warp is not installed.
        RuntimeError: "warp" or "hashgrid", and Warp cannot run on the platform.
        ValueError: "hashgrid", and space is periodic, there is a batch, or cutoffs differ from particle to particle.
    """
    if backend == "hashgrid" and radii:
        raise ValueError("backend='hashgrid' takes one cutoff for all particles: pass backend='warp', 'jax' or 'brute'.")
    if backend == "hashgrid" and batch:
        raise ValueError("backend='hashgrid' knows one system at a time: pass backend='warp', 'jax' or 'brute'.")
    if backend == "hashgrid" and periodic:
        raise ValueError("backend='hashgrid' knows no periodic box: pass backend='warp', 'jax' or 'brute'.")
    if backend not in ("auto", *WARP_ENGINES):
        return backend
    platform = platform_of(sources, sources if queries is None else queries)
    if backend == "auto":
        return fastest_engine(platform, sources.shape[0])
    load_warp()
    if reason := _what_is_missing(platform):
        raise RuntimeError(f"backend={backend!r} cannot run on the platform {platform!r}: {reason}. Pass backend='jax'.")
    return backend


def fastest_engine(platform: str, sources: int) -> str:
    """Return the engine that "auto" takes on a platform for a number of sources; warn once where Warp cannot run."""
    warp_from = _WARP_FROM.get(platform)
    return "warp" if warp_from is not None and sources >= warp_from and _can_warp(platform) else "jax"


def default_platform() -> str:
    """Return the JAX platform on which arrays are made and programs run where nothing else is said."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def platform_of(*arrays: Array) -> str:
    """Return the platform of concrete arrays; traced ones do not know where they will be."""
    if any(isinstance(x, Tracer) for x in arrays):
        return default_platform()
    return next(iter(arrays[0].devices())).platform


@functools.cache
def _what_is_missing(platform: str) -> str | None:
    return missing(platform)


@functools.cache
def _can_warp(platform: str) -> bool:
    reason = _what_is_missing(platform)
    if reason is None:
        return True
    warnings.warn(
        f"backend='auto' takes the slower engine 'jax' on the platform {platform!r}: {reason}. "
        "Pass backend='jax' to choose it without this warning.",
        RuntimeWarning,
        stacklevel=level_of_caller(),
    )
    return False
