"""Lists that are kept, on CUDA, as far as a machine without a GPU can tell: their kernels compile for one."""

import pytest
from checked import slow

from jfrnn.kernels import Kind, _compile, kept, reverse
from jfrnn.kernels.kept import ListKind
from jfrnn.kernels.pair_sum_cpu import Step, Sum, TermText, Value

TEXT = "const auto v0 = x * y;\nconst auto o = v0 + s;\n"
KINDS = [
    ListKind(Kind(3, False), aligned=True, lanes=1),
    ListKind(Kind(3, False, periodic=1), aligned=True, ordered=True, lanes=8),
    ListKind(Kind(2, False, scaled=True, periodic=1, rule="mean"), lanes=8),
    ListKind(Kind(3, False, periodic=2), code_bytes=1, reversed=True, aligned=True, ordered=True, lanes=8, boxes=True),
    ListKind(Kind(3, True, scaled=True, periodic=4, rule="either"), code_bytes=2, aligned=True, lanes=1),
    ListKind(Kind(2, True, periodic=3), aligned=True, lanes=8),
]


def compiles(kernel):
    return f".entry {kernel.name}(" in _compile.find_binary(kernel.program, "cpu", arch=90).read_text()


def term_of(kind):
    dtype = "float64" if kind.kind.double else "float32"
    steps = (Step("s", 0),) if kind.kind.periodic else ()
    text = TEXT if kind.kind.periodic else TEXT.replace("+ s", "+ c")
    others = (Value("x", dtype, 1), Value("c", dtype))
    return TermText(text, steps, (), (Value("y", dtype, 0),), others, (Sum("o", False, False), Sum("o", True, False)))


@pytest.mark.parametrize("other", [False, slow(True)])
@pytest.mark.parametrize("number", range(len(KINDS)), ids=[kind.name for kind in KINDS])
def test_masks_and_sums_compile(number, other):
    """Kinds in turn with and without distances, and compensated sums; `other`: the other way round."""
    kind, odd, periodic = KINDS[number], (number % 2 == 1) is not other, bool(KINDS[number].kind.periodic)
    sums = kind._replace(kind=kind.kind._replace(compensated=odd), apart=kind.reversed, mirrored=odd)
    # what a term reads of i stands beside the points, or does not
    assert compiles(kept.sum_kernel(sums, term_of(kind), f"test_{periodic}"))
    if not kind.reversed:
        assert compiles(kept.mask_kernel(kind._replace(measured=odd)))
    if odd:
        assert kind.reversed or all(map(compiles, kept.slope_kernels(kind)))
        largest = term_of(kind)._replace(sums=(Sum("o", False, False),))
        extremes = kind._replace(kind=kind.kind._replace(extremes=True))
        assert compiles(kept.sum_kernel(extremes, largest, f"largest_{periodic}"))


@pytest.mark.parametrize("code_bytes", [0, 1, 2, 4])
@pytest.mark.parametrize("ordered", [False, True])
def test_reverse_slots_compile(code_bytes, ordered):
    assert all(map(compiles, reverse.reverse_kernels(code_bytes, ordered, cuda=True)))


@pytest.mark.parametrize("by_source", [False, True])
def test_sums_by_source_compile(by_source):
    assert compiles(reverse.collect_kernel(3, by_source, by_source, True))


@pytest.mark.parametrize("kernel", [reverse.flatten_kernel, reverse.pack_kernel], ids=lambda make: make.__name__)
def test_slots_one_after_another_compile(kernel):
    assert compiles(kernel(cuda=True))
