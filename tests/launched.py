"""Kernels of the CPU, called one by one."""

import ctypes

import numpy as np

from jfrnn.kernels import _compile


def on_cpu(kernel, **given):
    """Call a kernel of the CPU once: arrays of NumPy and integers are its arguments, by name."""
    assert {field.name for field in kernel.fields} == set(given)
    packed = kernel.pack({name: value.ctypes.data if isinstance(value, np.ndarray) else value for name, value in given.items()})
    library = _compile.load(kernel.program)
    arguments = (ctypes.c_ubyte * kernel.size).from_buffer(packed)
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(library.address_of(kernel.name))(ctypes.addressof(arguments))
