"""Processes that were forked after JAX had started: its threads stayed behind, and whatever waits for them waits forever."""

import contextlib
import os

_is_forked = False


def _look() -> None:
    """Note in a forked process whether JAX had started before."""
    global _is_forked
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import xla_bridge

        _is_forked = _is_forked or bool(xla_bridge._backends)


def refuse_forks() -> None:
    """Raise where JAX cannot run because this process was forked after it had started.

    Raises:
        RuntimeError: it was.
    """
    if _is_forked:
        raise RuntimeError(
            "this process was forked after JAX had started, whose threads do not run here, so that it would wait forever: start "
            "processes with multiprocessing.get_context('spawn'), or use JAX only after forking. jfrnn.ase needs no JAX, and runs."
        )


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look)
