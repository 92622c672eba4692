"""The choice of an engine while tracing: what "auto" means on a platform, and whether a named engine can run there."""

import functools
import warnings
from collections.abc import Mapping
from typing import TypeVar

import jax
from jax import Array
from jax.core import Tracer

from jfrnn._engine.arrays import ArrayEngine
from jfrnn._engine.hashgrid import HashGridEngine
from jfrnn._engine.problem import ANYTHING, Engine, Features
from jfrnn._engine.start import check_warp, level_of_caller
from jfrnn._engine.warp import WarpEngine

AnyEngine = TypeVar("AnyEngine")

WARP, ARRAYS = WarpEngine(), ArrayEngine("jax", by_cells=True)
ENGINES: dict[str, Engine] = {
    engine.name: engine for engine in (ARRAYS, WARP, HashGridEngine(), ArrayEngine("brute", by_cells=False))
}


# The number of sources from which on "auto" is Warp, by platform; for fewer, and on other platforms, it is "jax".
# Rows in experiments/results/crossovers (`bench crossover`, which version 8ac2398 was the last to have): compiled searches of 16
# to 100 000 random points in 3D with 30 and 108 neighbors. On the CPU no engine is faster than Warp at any size: brute force is
# level with it up to 32 points, 1.2x slower at 64; jax is 1.2x slower at 16, 3x at 256, 15x at 100 000. Warp compiles sooner too:
# in 0.05 s instead of 1 to 3 s. On an H200 (16, 32 and 64 points measured) jax takes 1.8 to 2.1 times as long as Warp, brute force
# 1.2 to 1.4 times; and Warp lists 250 000 points (experiments/results/h200) in less time than jax 64. On the CPU, Warp lists
# 3 to 9 times as many particles a second with a box or a batch, and 3 to 22 times with a cutoff per particle (196 times where ten
# are far away): experiments/results/options, cpu_warp.csv of 100 000 points, cpu_jax.csv of 20 000.
_WARP_FROM = {"cpu": 0, "gpu": 0}


def parse_backend(backend: object, engines: Mapping[str, AnyEngine], where: str = "") -> AnyEngine | None:
    """Return the engine of a table that a backend names, or None if it is "auto"; raise a ValueError if it is neither."""
    names = ("auto", *engines)
    if not isinstance(backend, str) or backend not in names:
        raise ValueError(f"backend must be one of {', '.join(map(repr, names))}{where}, got {backend!r}.")
    return engines.get(backend)


def choose_engine(named: Engine | None, sources: Array, queries: Array | None, kind: Features = ANYTHING) -> Engine:
    """Return this engine, or the fastest (None); raise if a named engine does not support the search or cannot run here.

    An ImportError or a RuntimeError says that it needs Warp, which is not installed or cannot run on the platform.
    """
    if named is None:
        return fastest_engine(platform_of(sources, sources if queries is None else queries), sources.shape[0])
    if reason := named.refuse(kind):
        raise ValueError(f"backend={named.name!r} {reason}")
    platform = platform_of(sources, sources if queries is None else queries)
    if reason := _what_is_missing(named, platform):
        check_warp()  # says what to install
        raise RuntimeError(f"backend={named.name!r} cannot run on the platform {platform!r}: {reason}. Pass backend='jax'.")
    return named


def fastest_engine(platform: str, sources: int) -> Engine:
    """Return the engine that "auto" means on a platform for this number of sources; warn once if Warp cannot run."""
    warp_from = _WARP_FROM.get(platform)
    return WARP if warp_from is not None and sources >= warp_from and _can_warp(platform) else ARRAYS


def default_platform() -> str:
    """Return the JAX platform on which arrays are placed and programs run by default."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


def platform_of(*arrays: Array) -> str:
    """Return the platform of concrete arrays, or the default one if any of them is traced."""
    if any(isinstance(x, Tracer) for x in arrays):
        return default_platform()
    return next(iter(arrays[0].devices())).platform


@functools.cache
def _what_is_missing(engine: Engine, platform: str) -> str | None:
    return engine.missing(platform)


@functools.cache
def _can_warp(platform: str) -> bool:
    reason = _what_is_missing(WARP, platform)
    if reason is None:
        return True
    warnings.warn(
        f"backend='auto' takes the slower engine 'jax' on the platform {platform!r}: {reason}. "
        "Pass backend='jax' to choose it without this warning.",
        RuntimeWarning,
        stacklevel=level_of_caller(),
    )
    return False
