"""Several processes: how they find each other, and how soon they notice that one is gone."""

import math
import os
from typing import Any

import jax

_PATIENCE = 20.0


def connect(
    address: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    *,
    patience: float = _PATIENCE,
) -> None:
    """Join the processes of a run, before anything else asks JAX for a device; one process need not call it.

    `jax.distributed.initialize`, with collectives for CPUs (gloo) and with less patience: where a process dies, all others end with
    a message that says so, instead of waiting for it in a collective.

    Args:
        address: "host:port" of process 0; default, as of the next two: what the cluster's environment says (Slurm, Kubernetes ...).
        processes: How many.
        process: Number of this one.
        patience: After how many seconds without a sign of life a process counts as dead, at least 1. The others end within twice
            that time, on CPUs and where a connection breaks at once.

    Raises:
        ValueError: `patience` is no number of seconds.
        RuntimeError: JAX has been asked for devices already, or the processes do not find each other.

    Source: JAX's coordination service, https://docs.jax.dev/en/latest/multi_process.html.
    """
    if not (isinstance(patience, int | float) and math.isfinite(patience) and patience >= 1):
        raise ValueError(f"patience must be a number of seconds, at least 1, got {patience!r}.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    os.environ.setdefault("NCCL_NVLS_ENABLE", "0")  # NVLink multicast: no collective here gains by it
    given: dict[str, Any] = {"coordinator_address": address, "num_processes": processes, "process_id": process}
    jax.distributed.initialize(**given, heartbeat_timeout_seconds=math.ceil(patience))
