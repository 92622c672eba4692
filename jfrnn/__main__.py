"""`python -m jfrnn`: which engines run on this machine, why others do not, and whether their pairs are right."""

import importlib.metadata
import platform
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from jfrnn._engine import ENGINES, Engine, compiler, default_platform, fastest_engine

_N, _UNITS, _CUTOFF = 400, 40, 8  # particles, edge of their box and cutoff, in eighths: all squares are exact


def main() -> int:
    """Print what runs here, and return 1 if any engine finds a wrong pair, else 0."""
    where = default_platform()
    print(f"jfrnn {jfrnn.__version__}: {', '.join(_versions())}")
    print(f"device: {jax.devices()[0].device_kind} (JAX platform {where!r}, {jax.device_count()} in all)")
    missing = {name: engine.missing(where) for name, engine in ENGINES.items()}
    if missing["warp"] is None:
        print(f"compiled kernels are kept in {compiler().kernel_folder()}")
        fastest = fastest_engine(where, _N).name
        print(f"backend='auto' is {fastest!r}")
    else:
        print(f"backend='auto' is 'jax', since 'warp' does not run: {missing['warp']}")
    print(f"\nThe pairs of {_N} particles, many at exactly the cutoff, compared with brute force:")
    answers = [_check(engine, missing[name]) for name, engine in ENGINES.items()]
    return int(False in answers)


def _versions() -> list[str]:
    versions = [f"Python {platform.python_version()}"]
    for name in ("jax", "jaxlib", "numpy", "warp-lang"):
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"no {name}")
    return versions


def _check(engine: Engine, missing: str | None) -> bool | None:
    """Print a line for an engine; return whether it is right, None if it does not run."""
    if missing is not None:
        print(f"  {engine.name:9} does not run: {missing}")
        return None
    start = time.perf_counter()
    right = _is_right(engine.name)
    print(f"  {engine.name:9} {'right' if right else 'WRONG'}, {time.perf_counter() - start:.1f} s with compilation", flush=True)
    return right


def _is_right(backend: str) -> bool:
    """Compare the pairs of an engine, and of one that translates also a sum, with whole numbers."""
    cells = np.random.default_rng(0).integers(0, _UNITS, (_N, 3))
    apart = cells[None] - cells[:, None]
    pairs = ((apart**2).sum(-1) < _CUTOFF**2) & ~np.eye(_N, dtype=bool)
    x, cutoff = jnp.asarray(cells / 8, jnp.float32), _CUTOFF / 8
    found = np.zeros_like(pairs)
    nbrs = jfrnn.search(x, cutoff, capacity=int(pairs.sum(axis=1).max()), backend=backend)
    i, j = nbrs.pairs()
    found[i, j] = True
    right = np.array_equal(found, pairs) and np.array_equal(nbrs.count, pairs.sum(axis=1))
    if not ENGINES[backend].translates:
        return right
    sums = jfrnn.pair_sum(lambda r, i, j: 8 * r, x, cutoff, backend=backend)
    return right and np.array_equal(sums, (apart * pairs[..., None]).sum(axis=1))


if __name__ == "__main__":
    sys.exit(main())
