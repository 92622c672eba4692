"""Sums over pairs on CUDA, without a list: the term is evaluated where its pairs are found, by the lane of their query.

The stages of `jfrnn.kernels.cells_cuda` sort the sources by cell. `sort_values` puts what a term reads of them into the same
order, a row each. Then the walk of that module finds pairs as a search does, and holds their bits for 22 blocks of candidates. A
lane goes through the bits of its query and reads the row of each neighbor through the first-level cache, which the 31 other lanes
share: of a few pairs at a time, while it evaluates the term for those before. In a periodic box coordinates are those in its
cell, and the image of a neighbor is its lattice shift S; where particles lie further away than in the boxes beside, rows of
particles are read, too: their coordinates as they were given, and turns, which S takes account of. In place of sums it can find
the largest summands, and whose they are.

Where a million particles have 108 neighbors (float32), 32 queries meet 570 candidates near their box. Evaluating the term for all
of them would take 570 steps of the warp; for the pairs of one block of 32 at a time 345, as lanes wait for the one with most;
for those of 22 blocks 116. On an H200 a warp executes 9400 instructions for a density, 3600 of them for the pairs it found,
1900 in tensor cores and around them; schedulers issue in 64 % of their cycles; a fifth of the time warps wait for what they
load (ncu). 0.84 ms became 0.63 when rows were loaded ahead and numbers were multiplied by reciprocals, 0.60 when two sets of
rows took turns and candidates were kept by predicate. What bounds it is the first-level cache, busy in 89 % of the cycles: rows of
32 lanes stand in as many places, and to gather them takes it about 18. With rows held in shared memory, 15, but pairs of half as
many blocks then fit, and 12 % more instructions are executed: 0.59 to 0.65 ms, the gradient 1.51 to 1.67 instead of 1.43
(experiments/results/h200/density). Bytes of memory do not bound it: 40 per particle are 0.01 ms.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel
from jfrnn.kernels.cells_cuda import GRID, QUERY_BLOCK, Launch, query_blocks, walks
from jfrnn.kernels.pair_sum_cpu import LITTLE_WORK, TermText, constants_of, term_header, work


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return query_blocks(queries)


def sorted_numbers(term: TermText, sources: int, dim: int, double: bool) -> int:
    """Return how many numbers the sorted values of all sources take: rows of particles, if these are read, and rows of values."""
    return sources * (row_length(term, dim, double) + (4 if term.reads_rows else 0))


def row_length(term: TermText, dim: int, double: bool) -> int:
    """Return how many numbers of each source the sorted values have, a row: 16 bytes are loaded at once, if there are so many.

    Coordinates come first, where a term reads them and something else.
    """
    columns = len(term.other_columns) + _placed_columns(term, dim)
    at_once = 2 if double else 4
    return next((length for length in (0, 1, 2) if columns <= length <= at_once), -(-columns // at_once) * at_once)


class Kernels(NamedTuple):
    """The kernel that sorts values (None: there are none), and those that sum; `crossing` as in a search."""

    sort_values: Kernel | None
    query: Kernel
    crossing: Kernel | None

    def launches(self, n: int, m: int, own: bool, multiprocessors: int) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries, which are sorted already; as in a search."""
        threads = -(-n // QUERY_BLOCK) * QUERY_BLOCK
        sorting = [] if self.sort_values is None else [Launch(self.sort_values, threads, False)]
        return sorting + walks(self.query, self.crossing, m, own, multiprocessors)


def _reads_positions(term: TermText) -> bool:
    return any(value.axis is not None or value.column_axis is not None for value in term.others)


def _placed_columns(term: TermText, dim: int) -> int:
    """Return how many coordinates of j stand before its columns."""
    return dim if term.other_columns and _reads_positions(term) else 0


@functools.lru_cache(512)
def sum_kernels(kind: Kind, term: TermText, key: str, lanes: int = 1, parted: bool = False) -> Kernels:
    """Return the kernels that sum a term, as `cell_kernels` those that list; `key` tells it from others in names of programs.

    For extremes, `errors` [m, width, 2] gets the sources of the largest summands (n: there is none), and the codes of their images,
    as integers travel among floats.
    """
    # `taken` is how many pairs a lane adds before it looks for the next block; `blocks` per multiprocessor bound registers. Both
    # are what was fastest on an H200: rows of several loads wait in registers, and are 1.3 times slower if four are loaded ahead.
    length = row_length(term, kind.dim, kind.double)
    cheap = work(term.unshifted or term.text) <= LITTLE_WORK and length <= 4
    blocks = 16 if kind.double or not cheap else 20
    from_places = _reads_positions(term) and not term.other_columns
    constants = {
        **GRID,
        **constants_of(term, kind, by_rows=True),
        "LIST": 0,
        "TAKEN": 4 if cheap else 2,
        "FROM_PLACES": from_places,
    }
    constants |= {"ROW_LENGTH": max(length, 1), "PLACED": _placed_columns(term, kind.dim)}
    parted = parted and not kind.tree
    constants |= {"QUERY_LANES": lanes, "PARTED": parted, "COLUMNS": len(term.other_columns), "READS_ROWS": term.reads_rows}

    declare_one = functools.partial(declare_kind, kind.compiled(), cuda=True)

    def query_kernel(name: str, crossing: bool = False) -> Kernel:
        entry = Entry("Sums.run", QUERY_BLOCK, blocks, "Sums_cross" * crossing)
        given = term_header(term, kind.double, by_rows=True)
        return declare_one(
            f"{name}_{key}_{lanes}l{'_parted' * parted}",
            "pair_sum.cuh",
            entry,
            given=given,
            constants=constants | {"CROSSING": crossing},
        )[0]

    sorting = Entry("SortValues.run", QUERY_BLOCK, 32)
    return Kernels(
        declare_one(f"sort_values_{key}", "sort_values.cuh", sorting, constants=constants)[0]
        if term.other_columns or term.reads_rows
        else None,
        query_kernel("pair_sum", crossing=kind.tree and kind.periodic > 0),
        query_kernel("crossing_pair_sum", crossing=True) if kind.periodic and not kind.tree else None,
    )
