"""How a kernel is declared, once: by the struct of its arguments in a native source, and one line of Python.

A kernel is a method of a struct that is made of its arguments, as in

    struct SortArguments { const real *positions; int* scratch; int n, m; };
    struct Sort : SortArguments { explicit Sort(const SortArguments& given); void build(); };

`declare` reads names and places of the arguments from that text, and adds a function by which the method is called. Who launches it
binds arrays and numbers to the arguments by their names. A program is one text, which is compiled as a whole.
"""

import functools
import re
import sys
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from jfrnn.kernels._text import resolve

_POINTER, _INTEGER = 8, 4  # bytes
_CONSTRUCTOR = r"explicit {struct}\(const (\w+)&"
_HELD = r"^struct {struct}\b[^{{;]*{{\n\s+const (\w+Arguments) given;"
_FIELDS = r"^struct {struct}(?: : ([\w, ]+))? {{(?:\n(.*?)^)?}};"
_NAME = re.compile(r"^\s*(\*?)\s*([A-Za-z_]\w*)\s*$")  # as in `int* a`, or `int *a, *b`
# Compilers warn when they are asked for places in a struct that is derived from others; those of arguments are simple enough.
_UNWARNED = {False: '#pragma clang diagnostic ignored "-Winvalid-offsetof"', True: "#pragma nv_diag_suppress 1427"}
_LINE = re.compile(r"^\s*(?:const )?(real|int|whole)\b(.*);$")


class Program(NamedTuple):
    """A text that is compiled as a whole, for the CPU or for CUDA.

    `fused`: products may be contracted with sums. `inlined`: large functions, too, become part of those that call them, as loops
    over many pairs want it (CPU). `linked`: it calls a function that the driver links (CUDA).
    """

    name: str
    text: str
    cuda: bool
    fused: bool = False
    inlined: bool = True
    linked: bool = False


class Field(NamedTuple):
    """An argument of a kernel: its name, where it stands among the bytes of all arguments, and whether it is an array."""

    name: str
    place: int
    is_array: bool


class Kernel(NamedTuple):
    """A function of a program: its name, its arguments, how many bytes these take, and (on CUDA) the threads of a block."""

    program: Program
    name: str
    fields: tuple[Field, ...]
    size: int
    block: int = 1

    def pack(self, given: Mapping[str, int]) -> bytearray:
        """Return the bytes of all arguments: integers, and addresses of arrays, 0 where none is given.

        Raises:
            ValueError: An integer is missing, or does not fit into 32 bits.
        """
        packed = bytearray(self.size)
        for field in self.fields:
            if not field.is_array and not -(1 << 31) <= given.get(field.name, 1 << 31) < 1 << 31:
                told = f"must be an integer of 32 bits, got {given[field.name]}" if field.name in given else "is missing"
                raise ValueError(f"the argument {field.name!r} of the kernel {self.name} {told}")
            value, size = given.get(field.name, 0), _POINTER if field.is_array else _INTEGER
            packed[field.place : field.place + size] = int(value).to_bytes(size, sys.byteorder, signed=not field.is_array)
        return packed


class Entry(NamedTuple):
    """A method that is launched, as in `"Sort.build"`; on CUDA, threads of a block, and blocks that share a multiprocessor.

    `called` is the name in profiles of one of two programs that launch the same method.
    """

    method: str
    block: int = 1
    blocks: int = 1
    called: str = ""

    @property
    def name(self) -> str:
        """The name of the function by which it is called."""
        return self.called or self.method.replace(".", "_")


def declare(
    name: str, text: str, *entries: Entry | str, cuda: bool = False, fused: bool = False, linked: bool = False
) -> list[Kernel]:
    """Return the kernels of a program.

    Args:
        name: What files of the compiled program are called.
        text: Native sources behind their constants (`jfrnn.kernels._native.program`).
        entries: The methods that are launched.
        cuda: Whether it is compiled for CUDA, or for the CPU.
        fused: Whether products may be contracted with sums.
        linked: Whether a function of the driver is called.
    """
    called = [Entry(entry) if isinstance(entry, str) else entry for entry in entries]
    given = [_find_arguments(text, entry.method.split(".")[0]) for entry in called]
    lines = [_write_entry(entry, arguments, cuda) for entry, arguments in zip(called, given, strict=True)]
    found = [read_fields(text, arguments) for arguments in given]
    checks = dict.fromkeys(_write_check(arguments, *read) for arguments, read in zip(given, found, strict=True))
    whole = "\n".join([resolve("c_library.h"), "namespace {", text, _UNWARNED[cuda], *checks, "}", *lines, ""])
    program = Program(name, whole, cuda, fused, linked=linked)
    return [Kernel(program, x.name, fields, size, x.block) for x, (fields, size) in zip(called, found, strict=True)]


@functools.lru_cache(1024)
def read_fields(text: str, struct: str) -> tuple[tuple[Field, ...], int]:
    """Return the arguments that a struct holds, behind those of the structs that it is derived from, and its size in bytes.

    Raises:
        ValueError: It is not in the text, or holds anything but arrays and integers of 32 bits.
    """
    body = re.search(_FIELDS.format(struct=struct), text, re.MULTILINE | re.DOTALL)
    if body is None:
        raise ValueError(f"no struct {struct} in the program")
    fields, place = [], 0
    for base in body[1].split(", ") if body[1] else ():
        inherited, size = read_fields(text, base)
        fields += [field._replace(place=place + field.place) for field in inherited]
        place += size
    for name, is_array in _read_names(struct, (body[2] or "").splitlines()):
        size = _POINTER if is_array else _INTEGER
        place = -(-place // size) * size
        fields.append(Field(name, place, is_array))
        place += size
    return tuple(fields), -(-place // _POINTER) * _POINTER


def _read_names(struct: str, lines: list[str]) -> Iterable[tuple[str, bool]]:
    for line in lines:
        code = line.partition("//")[0].rstrip()
        if "(" in code:  # functions stand behind all arguments
            return
        if not code:
            continue
        match = _LINE.match(code)
        names = [] if match is None else [_NAME.match(name) for name in match[2].split(",")]
        if match is None or not all(name and (name[1] or match[1] == "int") for name in names):
            raise ValueError(f"{struct} must hold arrays of real and int, and integers alone, got {code.strip()!r}")
        yield from ((name[2], name[1] == "*") for name in names if name)


def _find_arguments(text: str, struct: str) -> str:
    for pattern in (_CONSTRUCTOR, _HELD):
        found = re.search(pattern.format(struct=struct), text, re.MULTILINE)
        if found is not None:
            return found[1]
    base = re.search(rf"^struct {struct} : (\w+)", text, re.MULTILINE)
    if base is None:
        raise ValueError(f"no struct {struct} that is made of arguments in the program")
    return _find_arguments(text, base[1])


def _write_check(arguments: str, fields: Iterable[Field], size: int) -> str:
    """Let the compiler, which knows it, confirm what was read."""
    places = [f"__builtin_offsetof({arguments}, {field.name}) == {field.place}" for field in fields]
    sizes = [f"sizeof({arguments}::{field.name}) == {_POINTER if field.is_array else _INTEGER}" for field in fields]
    whole = f"(sizeof({arguments}) + {_POINTER - 1}) / {_POINTER} * {_POINTER} == {size}"
    return f'static_assert({" && ".join([whole, *places, *sizes])}, "arguments were read wrongly");'


def _write_entry(entry: Entry, arguments: str, cuda: bool) -> str:
    struct, method = entry.method.split(".")
    if not cuda:
        return f'extern "C" void {entry.name}(const {arguments}* given) {{ {struct}{{*given}}.{method}(); }}'
    bounds = f"__launch_bounds__({entry.block}, {entry.blocks})"
    return f'extern "C" __global__ void {bounds} {entry.name}(const {arguments} given) {{ {struct}{{given}}.{method}(); }}'
