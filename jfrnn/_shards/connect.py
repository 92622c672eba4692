"""Runs of several processes: how they connect, and how soon they notice that one has died."""

import math
import os
from typing import Any

import jax

_PATIENCE = 20.0


def connect(
    address: str | None = None, processes: int | None = None, process: int | None = None, *, patience: float = _PATIENCE
) -> None:
    """Connect the processes of a run, before anything else asks JAX for a device; a single process need not call this.

    This calls `jax.distributed.initialize` with collectives for CPUs (gloo) and a shorter timeout: if a process dies, all others
    end with an error that says so, instead of waiting for it in a collective.

    Args:
        address: "host:port" of process 0. Default of this and the next two: from the cluster's environment (Slurm, Kubernetes ...).
        processes: Number of processes.
        process: Number of this process.
        patience: Seconds without a heartbeat after which a process counts as dead, at least 1. The others end within twice that
            time, on CPUs and if a connection breaks at once.

    Raises:
        ValueError: `patience` is not a number of seconds.
        RuntimeError: JAX has been asked for devices already, or the processes cannot connect.

    Source: JAX's coordination service, https://docs.jax.dev/en/latest/multi_process.html.
    """
    if not (isinstance(patience, int | float) and math.isfinite(patience) and patience >= 1):
        raise ValueError(f"patience must be a number of seconds, at least 1, got {patience!r}.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    os.environ.setdefault("NCCL_NVLS_ENABLE", "0")  # NVLink multicast, from which no collective here gains
    given: dict[str, Any] = {"coordinator_address": address, "num_processes": processes, "process_id": process}
    jax.distributed.initialize(**given, heartbeat_timeout_seconds=math.ceil(patience))
