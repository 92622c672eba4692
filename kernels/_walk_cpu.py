"""How all queries meet their candidates on the CPU, 8 or 16 at a time: the text that listing and summing share.

The threads hand themselves chunks of places from an atomic counter. The sources around a cell are copied once into the first-level
cache, as a structure of arrays, and serve all queries of that cell. What becomes of the pairs is said by the texts that `walk` is
given.
"""

from string import Template

from jfrnn.kernels._native import FLUSH, KEEP
from jfrnn.kernels._text import read_part

CHUNK = 2048  # places that a thread takes at a time

_TYPES = read_part("walk_cpu.h", "types")

_SCAN = read_part("walk_cpu.h", "scan")

_WALK = Template(read_part("walk_cpu.h", "walk"))


def walk(
    *, begin: str, meet: str, met: str, none: str, copied: str = "", chunk_done: str = "", end: str = "", flushed: bool = False
) -> str:
    """Return the text of a kernel that walks over all queries; around it stand the pieces CELLS, the layout and EXACT.

    Constants it needs: CANDIDATES, how many are held at a time; LIST, whether `scan` leaves ids of pairs in `row`; SUMS,
    whether squares of distances are computed as a term does it; with 2 `candidate_ids` are known in open space, too.

    Args:
        begin: Comes first, after the types and `scan`.
        meet: A query, of which `id`, `place`, coordinates `q` are known, meets its candidates, `filled` in number.
        met: What is done then, when the query itself is a candidate again; `fresh` and `finished` say whether these candidates were
            the first and the last ones.
        none: What is done with a query, `id`, that has no candidates.
        copied: Packs more of those of a vector of sources from the place `from` on that are `near`, of the image `shift`, to the
            candidates from `filled` on.
        chunk_done: After the last query of the chunk `chunk`.
        end: After the last chunk of this thread.
        flushed: Denormals are flushed to zero, as XLA does, while queries meet candidates.
    """
    modes = {"flush": FLUSH, "keep": KEEP} if flushed else {"flush": "", "keep": ""}
    text = _WALK.substitute(modes, meet=meet, met=met, none=none, copied=copied, chunk_done=chunk_done)
    return "".join([_TYPES, _SCAN, begin, text, end])
