"""Triangles near each particle on CUDA: seven launches, no host synchronization, nothing allocated beside the scratch.

prepare  boxes of triangles into the order of entries, so that a candidate is one sector; clears what the others count in
place    every particle looks into its buckets: with no entry in any it is done, else it counts itself in that of its smallest cell
fill     unused slots into all rows, beside `place`
allocate counts to first places; in which order the buckets come is left to chance, and no result depends on it
scatter  particles with candidates, those of neighboring cells side by side: the threads of a warp then meet the same candidates
query    a thread per particle: boxes first; what they leave waits in shared memory, float bounds decide it, then float64
settle   rows in which float64 left a pair open, anew, with integers: few threads, whose numbers take scratch

In a tree of boxes (`jfrnn/_triangles/tree.py`) the same: what holds a particle is asked of boxes from the root on, and particles
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

from jfrnn.kernels._native import Kind, place_parts, program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.triangles import constants, pending

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
    return place_parts(parts)


class Kernels(NamedTuple):
    """The kernels of a variant, all with the same arguments; `threads` is that of the launch."""

    prepare: Kernel
    place: Kernel
    fill: Kernel
    allocate: Kernel
    scatter: Kernel
    query: Kernel
    settle: Kernel

    def threads(
        self, n: int, buckets: int, entries: int, capacity: int, double: bool, multiprocessors: int
    ) -> list[tuple[Kernel, int]]:
        """Return what is launched, in order, for n particles, and how many threads do work; without rows `fill` is left out."""
        fill = [(self.fill, min(max(n * capacity // 4, 3), _SWEEP * multiprocessors))] if capacity else []
        found = [(self.prepare, max(buckets, entries)), (self.place, n), *fill, (self.allocate, -(-buckets // _RUN))]
        found += [(self.scatter, n), (self.query, n), (self.settle, workers_for(n, double))]
        return [(kernel, -(-threads // kernel.block) * kernel.block) for kernel, threads in found]


_WAITING = 16  # candidates of a thread whose boxes hold its particle, until they are decided


@functools.lru_cache(512)
def triangle_kernels(dim: int, double: bool, lists: bool, tree: bool, node: int) -> Kernels:
    """Return the kernels for a dimension and dtype, for lists or counts alone, in cells or in a tree of `node` children each."""
    kind = f"{dim}d_{'f64' if double else 'f32'}{'_tree' * tree}"
    options = {"LIST": lists, "WAITING": _WAITING, "RUN": _RUN, "HEADER": _HEADER_WORDS, "TREE": tree, "NODE": node}
    options |= {"PENDING": pending(node), **constants(dim, double, stride=32)}

    def stages(name: str, *methods: str, block: int, blocks: int = 1) -> list[Kernel]:
        text = program(Kind(dim, double), "triangles.cuh", constants={"THREADS": block, **options})
        entries = [Entry(f"Triangles.{method}", block, blocks) for method in methods]
        return declare(f"triangles_cuda_{name}_{kind}{'_list' * lists}", text, *entries, cuda=True)

    sorting = stages("sort", "prepare", "place", "fill", "allocate", "scatter", block=BLOCK)
    query = stages("query", "query", block=QUERY_BLOCK, blocks=_QUERY_BLOCKS[double])
    return Kernels(*sorting, *query, *stages("settle", "settle", block=_SETTLE_BLOCK))
