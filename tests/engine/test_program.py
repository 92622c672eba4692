"""Arguments of kernels are read from the text of their struct as a compiler reads them, or it is refused."""

import re

import pytest
from checked import refuses

from jfrnn.kernels import Field, _compile, declare
from jfrnn.kernels._program import read_fields

KERNEL = "struct Work {{\n    explicit Work(const WorkArguments& given) {{}}\n    void run() {{}}\n}};\n"


def struct(*lines):
    return "".join(["struct WorkArguments {\n", *(f"    {line}\n" for line in lines), "};\n"])


def test_arguments_are_those_that_a_compiler_finds():
    text = struct(
        "const real *a, *b;  // as in f(x)", "int n; // one", "int *c, d;", "", "real* e;", "const int* f, g;", "int h, *i;"
    )
    kinds = {"a": 1, "b": 1, "n": 0, "c": 1, "d": 0, "e": 1, "f": 1, "g": 0, "h": 0, "i": 1}
    fields, size = read_fields(text, "WorkArguments")
    assert {field.name: field.is_array for field in fields} == {name: bool(kind) for name, kind in kinds.items()}
    assert size == 72
    (kernel,) = declare("reading", "using real = double;\n" + text + KERNEL.format(), "Work.run")
    assert _compile.load(kernel.program).address_of("Work_run")  # the compiler has confirmed places and sizes


def test_arguments_that_are_derived_stand_behind_those_of_their_bases():
    text = struct("real* a;", "int n;") + struct("int *b, m;").replace("Work", "Other")
    text += "struct Both : WorkArguments, OtherArguments {};\nstruct More : WorkArguments {\n    int* c;\n};\n"
    assert [field[:2] for field in read_fields(text, "Both")[0]] == [("a", 0), ("n", 8), ("b", 16), ("m", 24)]
    for given in ("Both", "More"):
        kernel_text = KERNEL.format().replace("WorkArguments", given)
        (kernel,) = declare("derived", "using real = double;\n" + text + kernel_text, "Work.run")
        assert _compile.load(kernel.program).address_of("Work_run")  # the compiler has confirmed places and sizes


@pytest.mark.parametrize(
    "line",
    [
        *("int* const a;", "int a[3];", "int a = 1;", "int a; int b;", "int a, /* two */ b;", "int **a;", "int& a;", "int a : 3;"),
        *("unsigned int a;", "long long a;", "real a;", "const real *a, b;", "int a,", "#if DIM > 2", "struct { int a; };"),
    ],
)
def test_what_is_no_array_and_no_integer_is_refused(line):
    said = re.escape(f"WorkArguments must hold arrays of real and int, and integers alone, got '{line}'")
    refuses(ValueError, said, read_fields, struct("int n;", line, "int m;"), "WorkArguments")


def test_the_compiler_refuses_arguments_that_were_not_read():
    text = struct("int n;", "void run() {}", "int *hidden;")
    assert read_fields(text, "WorkArguments") == ((Field("n", 0, False),), 8)
    (kernel,) = declare("hidden", text + KERNEL.format(), "Work.run")
    refuses(RuntimeError, "does not compile", _compile.load, kernel.program)


def test_integers_that_are_missing_or_too_large_are_refused():
    (kernel,) = declare("numbers", struct("int *a;", "int n, m;") + KERNEL.format(), "Work.run")
    assert kernel.pack({"n": -1, "m": 2**31 - 1}) == bytes(8) + b"\xff" * 7 + b"\x7f"
    refuses(ValueError, "the argument 'm' of the kernel Work_run is missing", kernel.pack, {"n": 1})
    for wrong in (2**31, -(2**31) - 1):
        with pytest.raises(ValueError, match=f"the argument 'm' of the kernel Work_run must be an integer of 32 bits, got {wrong}"):
            kernel.pack({"n": 1, "m": wrong})
