"""One process of a run, for test_distributed.py: `distributed_process.py ADDRESS PROCESSES PROCESS lives|dies0|dies1`."""

import os
import sys
import time

import jax
import numpy as np

import jfrnn
from jfrnn import distributed


def main(address, processes, process, dies):
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    distributed.connect(address, processes, process, patience=5)
    x = np.random.default_rng(0).uniform(0, 8, (160, 2))
    box = jfrnn.Box([8.0, 8.0])
    mesh = jax.make_mesh((jax.device_count(),), ("x",))
    particles = distributed.scatter(x, 0.5, {"flag": x[:, 0] > 4}, mesh=mesh, box=box)
    if dies:
        run_until_one_dies(particles, process, int(dies))
    nbrs = distributed.search(particles, 0.5, capacity=24, backend="warp")
    ours = nbrs.pairs()
    i, j = jfrnn.search(x, 0.5, box=box, backend="warp").pairs()
    order = np.lexsort((j, i))
    np.testing.assert_array_equal(ours, (i[order], j[order]))
    moved = distributed.migrate(particles.replace(positions=8 - particles.positions))
    now, values = distributed.collect(moved)
    np.testing.assert_array_equal(now, 8 - x)
    np.testing.assert_array_equal(values["flag"], x[:, 0] > 4)
    print(f"{jax.device_count()} devices, {len(ours[0])} pairs", flush=True)


def run_until_one_dies(particles, process, dies):
    for step in range(10_000):
        particles = distributed.migrate(particles.replace(positions=particles.positions))
        jax.block_until_ready(particles.positions)
        print(f"step {step}", flush=True)
        if process == dies and step == 3:
            os._exit(1)
        time.sleep(0.05)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4].removeprefix("dies") if sys.argv[4] != "lives" else "")
