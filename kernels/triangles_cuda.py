"""Triangles near each particle on CUDA: seven launches, no host synchronization, nothing allocated beside the scratch.

prepare  boxes of triangles into the order of entries, so that a candidate is one sector; clears what the others count in
place    every particle looks into its buckets: with no entry in any it is done, else it counts itself in that of its smallest cell
fill     unused slots into all rows, beside `place`
allocate counts to first places; in which order the buckets come is left to chance, and no result depends on it
scatter  particles with candidates, those of neighboring cells side by side: the threads of a warp then meet the same candidates
query    a thread per particle: boxes first; what they leave waits in shared memory, float bounds decide it, then float64
settle   rows in which float64 left a pair open, anew, with integers: few threads, whose numbers take scratch

In a tree of boxes (`jfrnn/_triangles_tree.py`) the same: what holds a particle is asked of boxes from the root on, and particles
are sorted by cells of a grid over the wall.

A thread writes its own row, in the order of the CPU kernel: rows are the same bits in every run, and those of the CPU for the same
cells or tree. No product is contracted with a sum, so that the same text on the CPU decides with the same floats.

The floor of 1 000 000 particles at random around a gear of 12 160 faces (`python -m experiments bench triangles`), float32, counted
on the CPU, for cutoffs of 0.1 | 0.3 | 0.8 modules: 4 | 3 | 2 sizes of cells; 0.68 | 0.66 | 0.78 million particles with candidates;
9.9 | 19 | 121 million candidates, of which 0.67 | 3.0 | 19 million boxes hold the particle; 0.15 | 1.2 | 9.9 million pairs.
Bytes: rows of 16 | 32 | 128 slots, 64 | 128 | 512 MB, 12 MB of positions, 4 MB of counts, 20 MB to sort by: 23 | 38 | 130 us at
4.3 TB/s; entries (4 MB) and tables stay in L2. Operations: 20 per candidate, 350 per box, in all 0.4 | 1.4 | 9.1 billion, which 30
per ns do in 15 | 48 | 300 us if no lane idles. Half of them will, and seven launches wait for each other.
Prediction for an H200: 0.15 | 0.25 | 0.85 ms. Measured, kernels alone: 0.33 | 0.47 | 2.0; in a tree 0.54 | 0.79 | 2.0, where a
thread asks 16 boxes one after the other for each node (experiments/results/triangles/h200.jsonl).
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._load import load_module
from jfrnn.kernels._native import bind, program
from jfrnn.kernels._triangles import constants, pending

BLOCK = 256
QUERY_BLOCK = 128
_SETTLE_BLOCK = 32
_RUN = 64  # buckets that a thread of `allocate` takes: the cells of a block
_SWEEP = 2048  # threads of `fill` per multiprocessor: all at work at once
# Threads of `settle`, by width. Their integers take 38 and 58 MB of a buffer that is laid out when a program is traced, maybe on
# another machine: as many on every device.
_WORKERS = {False: 8448, True: 2112}
_HEADER_WORDS = 16
_QUERY_BLOCKS = {False: 5, True: 3}  # per multiprocessor, which bounds the registers; by width


def workers_for(n: int, double: bool) -> int:
    """Return the number of threads of `settle`, each with memory for the integers of a pair."""
    return min(_WORKERS[double], (n + 31) // 32 * 32)


def scratch_words(n: int, buckets: int, entries: int, dim: int, double: bool) -> int:
    """Return the int32 words of scratch that the kernels need."""
    entry = (2 if double else 1) * 2 * (dim + 1)
    parts = [_HEADER_WORDS, buckets, n, n, n, entries * entry, workers_for(n, double) * constants(dim, double, 32)["ROOM"]]
    return sum((words + 15) // 16 * 16 for words in parts)


class Launch(NamedTuple):
    """A kernel, its threads in all and per block, and whether it may run beside the launch before it."""

    kernel: wp.Kernel
    threads: int
    block: int
    beside: bool = False


class Kernels(NamedTuple):
    """The kernels of a variant, all with the same arguments, of which the last is the number of threads."""

    prepare: wp.Kernel
    place: wp.Kernel
    fill: wp.Kernel | None
    allocate: wp.Kernel
    scatter: wp.Kernel
    query: wp.Kernel
    settle: wp.Kernel

    def launches(self, n: int, buckets: int, entries: int, capacity: int, double: bool, multiprocessors: int) -> list[Launch]:
        """Return what is launched, in order, for n particles, on a device of so many multiprocessors."""
        filling = min(max(n * capacity // 4, 3), _SWEEP * multiprocessors)
        return [
            _launch(self.prepare, max(buckets, entries), BLOCK),
            _launch(self.place, n, BLOCK),
            *([] if self.fill is None else [_launch(self.fill, filling, BLOCK, beside=True)]),
            _launch(self.allocate, -(-buckets // _RUN), BLOCK),
            _launch(self.scatter, n, BLOCK),
            _launch(self.query, n, QUERY_BLOCK),
            _launch(self.settle, workers_for(n, double), _SETTLE_BLOCK),
        ]

    def load(self, device: wp.DeviceLike) -> None:
        """Compile and load all: nothing is left to do while a CUDA graph is recorded."""
        for kernel, block in ((self.prepare, BLOCK), (self.query, QUERY_BLOCK), (self.settle, _SETTLE_BLOCK)):
            load_module(kernel.module, device, block)


def _launch(kernel: wp.Kernel, threads: int, block: int, beside: bool = False) -> Launch:
    return Launch(kernel, -(-threads // block) * block, block, beside)


@functools.cache
def triangle_kernels(dim: int, double: bool, lists: bool, tree: bool, node: int) -> Kernels:
    """Return the kernels for a dimension and dtype, for lists or counts alone, in cells or in a tree of `node` children each."""
    kind = f"{dim}d_{'f64' if double else 'f32'}{'_tree' * tree}"
    rows = f"{kind}{'_list' * lists}"
    where = {"TREE": tree, "NODE": node, "PENDING": pending(node)}

    def sorting(name: str) -> wp.Kernel:
        return _kernel(name, kind, f"sort_{kind}", dim, double, (BLOCK, 1), lists, where)

    def deciding(name: str, block: int, blocks: int) -> wp.Kernel:
        return _kernel(name, rows, f"{name}_{rows}", dim, double, (block, blocks), lists, where)

    return Kernels(
        sorting("prepare"),
        sorting("place"),
        sorting("fill") if lists else None,
        sorting("allocate"),
        sorting("scatter"),
        deciding("query", QUERY_BLOCK, _QUERY_BLOCKS[double]),
        deciding("settle", _SETTLE_BLOCK, 1),
    )


_made: dict[str, wp.Kernel] = {}
_WAITING = 16  # candidates of a thread whose boxes hold its particle, until they are decided


def _kernel(
    stage: str, variant: str, module_name: str, dim: int, double: bool, bounds: tuple[int, int], lists: bool, where: dict[str, int]
) -> wp.Kernel:
    name = f"{stage}_{variant}"
    if name in _made:
        return _made[name]
    scalar = wp.float64 if double else wp.float32
    reals, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    points, rows, shapes = wp.array2d(dtype=scalar), wp.array2d(dtype=wp.int32), wp.array3d(dtype=scalar)
    options = {"LIST": lists, "WAITING": _WAITING, "THREADS": bounds[0], "RUN": _RUN, "HEADER": _HEADER_WORDS}
    options |= where

    def native(
        positions: points, corners: shapes, boxes: points, cutoff: reals, start: ints, triangles: ints, levels: ints,
        level_count: ints, level_of: ints, idx: rows, count: ints, scratch: ints,
        n: int, f: int, buckets: int, entries: int, capacity: int, workers: int, threads: int, thread: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"triangles_{name}_native"
    module = wp.get_module(f"jfrnn.kernels.triangles_cuda.{module_name}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    text = program(double, dim, "triangles.cuh", **options, **constants(dim, double, stride=32))
    function = bind(native, module, f"Triangles.{stage}", text)

    def kernel(
        positions: points, corners: shapes, boxes: points, cutoff: reals, start: ints, triangles: ints, levels: ints,
        level_count: ints, level_of: ints, idx: rows, count: ints, scratch: ints,
        n: int, f: int, buckets: int, entries: int, capacity: int, workers: int, threads: int,
    ):  # fmt: skip
        thread = wp.tid()
        function(
            positions, corners, boxes, cutoff, start, triangles, levels, level_count, level_of, idx, count, scratch,
            n, f, buckets, entries, capacity, workers, threads, thread,
        )  # fmt: skip

    _made[name] = wp.kernel(kernel, name=name, module=module, grid_stride=False, launch_bounds=bounds)
    return _made[name]
