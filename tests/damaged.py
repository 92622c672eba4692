"""Load programs from the cache, one of them for each way in which files are damaged; `test_start.py` runs it in fresh processes."""

import ctypes
import sys

from jfrnn._engine.start import load_warp, warn_of_folders
from jfrnn.kernels import Program, _compile

load_warp()
for name in sys.argv[1:]:
    text = f'extern "C" int add(int x) {{ return x + 1; }}  // {name}\n'
    library = _compile.load(Program(f"damaged_{name}", text, cuda=False))
    print(name, ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)(library.address_of("add"))(0))
warn_of_folders()
