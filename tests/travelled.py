"""Run programs in a process that has traced none of them; `test_travel.py` makes them, and starts it."""

import dataclasses
import gc
import pickle
import re
import signal
import sys
from pathlib import Path

import jax
import numpy as np
from jax.experimental import serialize_executable

import jfrnn


def points():
    return np.random.default_rng(0).random((40, 2)).astype(np.float32)


def everything(x):
    """Search in every way that has kernels of its own on the platform."""
    radii, mass = 0.1 + 0.1 * x[:, 0], x[:, 1]
    corners, faces = np.float32([[0, 0], [1, 0], [1, 1]]), np.int32([[0, 1], [1, 2]])
    sums = [jfrnn.pair_sum(lambda r, i, j: j["m"] * (r @ r), x, 0.2, {"m": mass}, backend="warp")]
    if jax.default_backend() == "cpu":
        sums.append(jfrnn.pair_sum(lambda r, i, j: r @ r, x, radii, backend="warp"))
    return (
        jfrnn.search(x, 0.2, capacity=40, backend="warp").idx,
        jfrnn.count(x, 0.25, backend="hashgrid"),
        jfrnn.count(x, radii, backend="warp"),
        *sums,
        jfrnn.search_triangles(x, corners, faces, 0.1, capacity=4, backend="warp").idx,
    )


def counted(x):
    return (jfrnn.count(x, 0.25, backend="warp"),)


def stop(*_):
    raise TimeoutError


def interrupted(given):
    """Return what a compiled program gives that was interrupted when it was loaded, while native code was compiled or loaded."""
    jax.devices()  # JAX makes its client once: where a signal interrupts that, it says that there is none
    gc.disable()  # Python drops what is raised while it collects garbage
    signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        serialize_executable.deserialize_and_load(*given)
    except TimeoutError:
        return serialize_executable.deserialize_and_load(*given)(points())
    raise AssertionError("the exception is lost")


def compiled(given, folder):
    """Run a compiled program; then say what this process would compile."""
    answers = serialize_executable.deserialize_and_load(*given)(points())
    (folder / "text").write_text(jax.jit(everything).lower(points()).as_text())
    return answers


def exported(given):
    """Run an exported program, and before one that looks like another version's."""
    module = re.sub(rb"@[0-9a-f]{12}", b"@0123456789ab", given.mlir_module_serialized)
    try:
        dataclasses.replace(given, mlir_module_serialized=module).call(points())
    except jax.errors.JaxRuntimeError as error:
        print(error)
    return given.call(points())


def step(x, nbrs):
    """Renew a list, and sum over it."""
    nbrs = nbrs.update(x)
    return nbrs, jfrnn.pair_sum(lambda r, i, j: r @ r, x, None, neighbors=nbrs)


def written(folder):
    """Run a program that takes and returns a list, after bytes of it that look like another version's."""
    program, nbrs = (folder / "bytes").read_bytes(), pickle.loads((folder / "program").read_bytes())
    try:
        jax.export.deserialize(re.sub(rb'\["[0-9a-f]{12}"', b'["0123456789ab"', program))
    except RuntimeError as error:
        print(error)
    nbrs, sums = jax.export.deserialize(program).call(points(), nbrs)
    return (*jax.tree.leaves(nbrs), sums)


def main(way, folder):
    if way == "written":
        return written(folder)
    given = pickle.loads((folder / "program").read_bytes())
    if way == "compiled":
        return compiled(given, folder)
    return interrupted(given) if way == "interrupted" else exported(given)


if __name__ == "__main__":
    np.savez(Path(sys.argv[2]) / "answers.npz", *main(sys.argv[1], Path(sys.argv[2])))
