"""Load kernels from the cache, one of them for each way in which files are damaged; `test_start.py` runs it in fresh processes."""

import sys

import warp as wp
from jfrnn.kernels._load import load_module

wp.config.log_level = wp.LOG_WARNING
for name in sys.argv[1:]:

    @wp.kernel(module=wp.get_module(f"damaged.{name}"))
    def add(x: wp.array(dtype=int)):
        x[0] = x[0] + 1

    load_module(add.module, "cpu")
    number = wp.zeros(1, dtype=int, device="cpu")
    wp.launch(add, dim=1, inputs=[number], device="cpu")
    print(name, number.numpy()[0])
