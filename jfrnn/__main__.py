"""`python -m jfrnn`: which engines run on this machine, why others do not, and whether their pairs and sums are right."""

import argparse
import importlib.metadata
import os
import platform
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from jfrnn._engine import ENGINES, Engine, Features, compiler, default_platform, fastest_engine
from jfrnn._tracing import Given

_N, _UNITS, _CUTOFF = 400, 40, 8  # particles, edge of their box and cutoff, in eighths: all squares are exact
_ENDS = """Each engine lists the pairs of 400 particles, and, where it can, sums over them and differentiates the sum. Ends with 0
if all that run are right, with 1 if one is wrong or fails, or if JAX finds no device, and with 2 if a word is unknown."""


def main(arguments: list[str] | None = None) -> int:
    """Print what runs here, and return 1 if any engine is wrong or fails, else 0; end with 2 if an argument is unknown."""
    parser = argparse.ArgumentParser(prog="python -m jfrnn", description=__doc__, epilog=_ENDS)
    parser.add_argument("--version", action="version", version=f"jfrnn {jfrnn.__version__}")
    parser.parse_args(arguments)
    print(f"jfrnn {jfrnn.__version__}: {', '.join(_versions())}")
    try:
        where = default_platform()
        print(f"device: {jax.devices()[0].device_kind} (JAX platform {where!r}, {jax.device_count()} in all)")
    except Exception as error:
        asked = os.environ.get("JAX_PLATFORMS")
        print(f"JAX finds no device{f' of JAX_PLATFORMS={asked}' if asked else ''}: {_tell(error)}")
        return 1
    missing = {name: engine.missing(where) for name, engine in ENGINES.items()}
    if missing["warp"] is None:
        print(f"compiled kernels are kept in {compiler().kernel_folder()}")
        fastest = fastest_engine(where, _N).name
        print(f"backend='auto' is {fastest!r}")
    else:
        print(f"backend='auto' is 'jax', since 'warp' does not run: {missing['warp']}")
    print(f"\nThe pairs of {_N} particles, many at exactly the cutoff, their sum and its gradient, compared with whole numbers:")
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


def _tell(error: Exception) -> str:
    """Return the kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _check(engine: Engine, missing: str | None) -> bool | None:
    """Print a line for an engine; return whether it is right, None if it does not run."""
    if missing is not None:
        print(f"  {engine.name:9} does not run: {missing}")
        return None
    start, sums = time.perf_counter(), engine.refuse(Features(summed=True)) is None
    try:
        right = _is_right(engine.name, sums)
    except Exception as error:  # whatever breaks on this machine, the other engines are tried as well
        print(f"  {engine.name:9} FAILS, {_tell(error)}", flush=True)
        return False
    what = "pairs, sum and gradient" if sums else "pairs"
    took = time.perf_counter() - start
    print(f"  {engine.name:9} {'right' if right else 'WRONG'}: {what}, {took:.1f} s with compilation", flush=True)
    return right


def _is_right(backend: Given, sums: bool) -> bool:
    """Compare the pairs of an engine, and of one that sums also a sum and its gradient, with whole numbers."""
    cells = np.random.default_rng(0).integers(0, _UNITS, (_N, 3))
    apart = cells[None] - cells[:, None]
    pairs = ((apart**2).sum(-1) < _CUTOFF**2) & ~np.eye(_N, dtype=bool)
    x, cutoff = jnp.asarray(cells / 8, jnp.float32), _CUTOFF / 8
    found = np.zeros_like(pairs)
    nbrs = jfrnn.search(x, cutoff, capacity=int(pairs.sum(axis=1).max()), backend=backend)
    i, j = nbrs.pairs()
    found[i, j] = True
    right = np.array_equal(found, pairs) and np.array_equal(nbrs.count, pairs.sum(axis=1))
    if not sums:
        return right
    squares = jax.value_and_grad(lambda x: jfrnn.pair_sum(lambda r, i, j: 64 * (r @ r), x, cutoff, backend=backend).sum())
    total, slope = jax.jit(squares)(x)
    apart = apart * pairs[..., None]  # each pair counts from both of its ends, and each moves with both
    return right and int(total) == (apart**2).sum() and np.array_equal(slope, -32 * apart.sum(axis=1))


def _run() -> int:
    """Run the command; where nobody reads what it says, or a disk is full, end without a traceback."""
    try:
        code = main()
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            print(_tell(error), file=sys.stderr)
        return 1
    return code


if __name__ == "__main__":
    sys.exit(_run())
