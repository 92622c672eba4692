// Constants of a kernel, as an example: `jfrnn.kernels._native.program` puts those of each variant in place of this file.
#pragma once

using real = float;  // of positions
using whole = int;   // as wide as `real`
constexpr bool DOUBLE = false;
constexpr int DIM = 3;
constexpr int PERIODIC = 0;            // 1: a pair has one image at most, 2: images are told apart
constexpr bool SKEWED = false;         // vectors of the lattice do not lie along the axes
constexpr int SHIFTED = 0;             // PERIODIC where images of points are decided, 0 where all points are decided as they are
constexpr bool BATCHED = false;        // rows of positions end with the number of a system
constexpr bool SUM = false;            // cutoffs of pairs are sums of two numbers
constexpr bool SCALED = false;         // the cutoff is so small or so large that squares need a unit
constexpr int REACH = 1, REACH_X = 2;  // cells per cutoff along y and z, and along x
constexpr int CHUNK = 2048;            // places that a thread takes at a time, where it puts them in order
constexpr int QUERY_CHUNK = 256;       // and where it serves queries
constexpr int TOGETHER = 12;           // queries that cells of a row are served for at once
constexpr int FEW = 384;               // sources up to which all are candidates of all queries
constexpr int MANY = 1 << 15;          // sources or queries from which several threads sort them
constexpr int SORT_CHUNK = 4096;       // of them, that a thread takes at a time
constexpr int CANDIDATES = 1024;       // that are held at a time, a multiple of 64
constexpr bool LIST = true;            // ids of neighbors are written, they are not only counted
constexpr bool FLAT = false;           // rows of a list are as long as they need to be (row_places.h)
constexpr int SUMS = 0;                // 1: summands are added up, 2: the largest ones are found
constexpr int EXCLUDING = 0;           // 1: queries exclude sources, 2: images of sources
// The term that is summed has columns of numbers of j and of lattice steps, numbers of i, sums over all pairs and of each i.
constexpr int OTHERS = 1, STEPS = 0, OWN = 0, TOTALS = 1, ROW_SUMS = 1;
constexpr int COLUMNS = 1, READS_ROWS = 0;  // columns of numbers of j; how far particles must be turned for rows to be read
constexpr int FIRST_SUMS = 1;               // of those of each i, that stand in an array of their own
constexpr bool COMPENSATED = true;          // sums are carried in twice the precision
constexpr bool PACKED = false;   // what is near comes together first, so that the term is evaluated for hardly more than the pairs
constexpr bool SKIPPED = false;  // the term is not evaluated for vectors without a pair
// CUDA: what a search allocates, and how it is launched (see jfrnn/kernels/cells_cuda.py).
constexpr int PARTS = 256, PART = 9, LEFT_OUT = 16, TILE = 2048, BLOCK = 256, WARPS = 4096;
constexpr bool LATER = false;     // only those neighbors that come after the query
constexpr bool CROSSING = false;  // queries whose reach leaves a periodic box
constexpr int TAKEN = 4;          // pairs that a lane evaluates at once
constexpr bool PARTED = true;     // blocks that are scattered may be served in parts
constexpr int QUERY_LANES = 1;    // of a warp that a query has once its pairs are known
constexpr int PLACED = 3;         // coordinates of j before its numbers, in a row of ROW_LENGTH
constexpr int ROW_LENGTH = 4;
constexpr bool FROM_PLACES = false;  // the term reads coordinates of j, and no numbers
constexpr int MOST_KINDS = 4;        // species whose cutoffs tensor cores know
constexpr int MOST_LONG = 16;        // queries with longer cutoffs than cells are made for
// Few particles on CUDA (see jfrnn/kernels/few_cuda.py).
constexpr int FEW_MOST = 4096, FEW_WARPS = 32;
// Searches with a cutoff per particle (see jfrnn/kernels/tree_cpu.py).
constexpr int LEAF = 16, FANOUT = 16, CLASS_BITS = 1, LEAST_TOGETHER = 6, MOST_TOGETHER = 32, MOST_DOUBLED = 6, MOST_HALVED = 9;
constexpr int RULE = 0;
// Lists that are kept (see jfrnn/kernels/reverse.py and kept.py).
constexpr int CODE_BYTES = 1;     // of the code of an image, 0: pairs have one image
constexpr bool ITSELF = false;    // a particle is its own neighbor, whatever its cutoff
constexpr int WIDTH = 3;          // numbers of each slot
constexpr int LENGTH = 4;         // numbers of each source
constexpr bool REVERSED = false;  // rows are those of the sources of a list
constexpr bool ALIGNED = true;    // rows of ids begin at multiples of 16 bytes
constexpr bool ORDERED = true;    // an order of rows is given
constexpr bool APART = true;      // particles are no neighbors of their own
constexpr int LANES_PER_ROW = 8;  // of CUDA
constexpr bool DECIDED = true;    // which of its slots hold a pair
constexpr bool MIRRORED = false;  // a term reads of i what it reads of j
constexpr bool OWN_ROWS = true;   // rows are the sources
constexpr bool MEASURED = false;  // distances are written, too
constexpr int ROW_BLOCKS = 8;     // of rows whose derivatives are summed by themselves, on the CPU
constexpr bool BOXES = false;     // each system has a lattice of its own
// Lists that renew themselves (see jfrnn/kernels/renew.py): bits of a status, which points are far and what is met of turns, and
// where the order of sources stands in a scratch.
constexpr int BIT_NOT_FINITE = 2, BIT_OUT_OF_RANGE = 8, BIT_BOX_TOO_SMALL = 4;
constexpr int FAR = 192, FAR_STEP = 256, FAR_MOST = 1 << 11, LARGEST_TURN = 511, MET_NOT_FINITE = 1 << 10, MET_TOO_FAR = 2 << 10;
constexpr bool CONDITIONAL = false;  // a kernel sets the condition of a graph
constexpr int FIRST_PLACE = 2368, PLACE_WORDS = 4, PLACE_WORD = 3;
// Triangles (see jfrnn/kernels/triangles.py and triangles_cuda.py).
constexpr int LIMBS = 14, ROOM = 1202, STRIDE = 1;
constexpr int MOST_CELLS = 8, MOST_ALONG = 64, MOST_ALONG_LOG2 = 6;
constexpr int NODE = 16, PENDING = 106, WAITING = 16, THREADS = 128, RUN = 64, HEADER = 16;
constexpr bool TREE = false;  // boxes stand in a tree, not in cells
constexpr bool LONG = true;   // some queries may have longer cutoffs than cells are made for (cells/long.cuh)
