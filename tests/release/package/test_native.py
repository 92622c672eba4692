"""Headers of `kernels/native` compile by themselves, and structures that mirror XLA's C interface are those of its header."""

import re
import shutil
import subprocess
from pathlib import Path

import jax
import pytest
from places import ROOT

from jfrnn._engine import ffi
from jfrnn.kernels import Program, _compile
from jfrnn.kernels._compile import write_launcher
from jfrnn.kernels._text import resolve
from jfrnn.kernels.hashgrid import warp_header

NATIVE = ROOT / "kernels" / "native"
LAUNCHING = ("calls.h", "desk.h", "launch.h")  # which need XLA's header
WHOLE = sorted(path.name for path in NATIVE.rglob("*.*"))


FLOORS = [{"common"}, {"decide", "math", "launch", "reverse"}, {"cells", "tree", "walk"}, {"rows", "sums"}]  # and all others


def test_folders_include_from_below_and_stand_on_the_page():
    """Headers are found by name, so each name is there once; the table of the product names all of them, and no others."""
    folder_of = {path.name: path.parent.name for path in NATIVE.rglob("*.*")}
    assert len(folder_of) == len(WHOLE)
    height = {folder: k for k, floor in enumerate(FLOORS) for folder in floor}
    for path in NATIVE.rglob("*.*"):
        own = path.parent.name
        for header in re.findall(r'^#include "(.+)"', path.read_text(), re.MULTILINE):
            other = folder_of.get(header, own)
            assert other == own or height[other] < height.get(own, len(FLOORS)) or {own, other} <= FLOORS[2], (path, header)
    page = (ROOT / "docs/developers/product.md").read_text()
    assert set(re.findall(r"`(\w+\.(?:h|cuh))`", page)) == set(WHOLE)


def is_cpu_only(header):
    """Tell headers with Clang's vectors, or with calls of the CPU alone; windings have one text for both."""
    if header == "winding.h":
        return False
    text = resolve(header, given={"numbers.h": "", "xla_ffi.h": "", "warp_hashgrid.h": ""})
    if header in ("c_library.h", "hashgrid_build.h", *LAUNCHING):
        return True
    words = ("vector_size", "__builtin_prefetch", "__atomic_fetch_add", "_cpu.h", "__builtin_sqrt")
    return any(word in text or word in header for word in words) and not header.endswith(".cuh")


def headers(cuda):
    return [name for name in WHOLE if (name.endswith(".h") or cuda) and not (cuda and is_cpu_only(name))]


def text_of(header):
    return write_launcher(HEADER, header) if header in LAUNCHING else resolve(header, given={"warp_hashgrid.h": warp_header()})


@pytest.mark.parametrize("cuda", [False, True], ids=["cpu", "cuda"])
def test_headers_compile_by_themselves(cuda):
    assert len(headers(cuda)) >= 30
    for name in headers(cuda):
        assert _compile.find_binary(Program(f"header_{name}", text_of(name), cuda), arch=90).exists()


def test_nvcc_compiles_headers(tmp_path):
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("no nvcc")
    pieces = [f"namespace space_{k} {{\n{text_of(name)}\n}}\n" for k, name in enumerate(headers(cuda=True))]
    source = tmp_path / "headers.cu"
    source.write_text("#include <cuda_fp16.h>\n" + "".join(pieces))
    command = [nvcc, "-ptx", "-std=c++17", "-arch=sm_90", "-o", tmp_path / "x.ptx", source]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:2000]


HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()
EXTENSION = "XLA_FFI_InternalExtension" if "XLA_FFI_InternalExtension" in HEADER else "XLA_FFI_Extension_Base"  # by version
MIRRORED = {
    ffi.Version: ("XLA_FFI_Api_Version", {"major": "major_version", "minor": "minor_version", "extension": "extension_start"}),
    ffi.Extension: (EXTENSION, {"metadata": None}),
    ffi.CallFrame: ("XLA_FFI_CallFrame", {"extension": "extension_start"}),
    ffi.Arrays: ("XLA_FFI_Args", {"extension": "extension_start", "arrays": "args"}),
    ffi.Attributes: ("XLA_FFI_Attrs", {"extension": "extension_start"}),
    ffi.Text: ("XLA_FFI_ByteSpan", {}),
    ffi.Api: (
        "XLA_FFI_Api",
        {"extension": "extension_start", "version": "api_version", "internal": "internal_api", "fail": "XLA_FFI_Error_Create"},
    ),
}


def test_structures_are_those_of_xla(tmp_path):
    """Places and sizes of what is read, as a C compiler lays out the header that JAX ships."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        pytest.skip("no C compiler")
    lines, expected = [], []
    for structure, (name, renamed) in MIRRORED.items():
        for field, *_ in structure._fields_:
            there = renamed.get(field, field)
            if there is not None:
                lines.append(f'printf("%zu\\n", offsetof({name}, {there}));')
                expected.append((name, field, getattr(structure, field).offset))
    source = tmp_path / "offsets.c"
    body = "\n".join(lines)
    source.write_text(
        f'#include <stddef.h>\n#include <stdio.h>\n#include "xla/ffi/api/c_api.h"\nint main() {{\n{body}\nreturn 0;\n}}\n'
    )
    command = [compiler, f"-I{jax.ffi.include_dir()}", "-o", tmp_path / "offsets", source]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = subprocess.run([tmp_path / "offsets"], check=True, capture_output=True, text=True).stdout.split()
    assert [(name, field, int(at)) for (name, field, _), at in zip(expected, found)] == expected
