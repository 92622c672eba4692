"""Checks of arguments: each returns the value it was given, or says what is wrong with it."""

import math
from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np
from numpy.typing import DTypeLike

INDEX_LIMIT = 2**31 - 1  # points are counted by int32 indices


def real(name: str, value: object) -> float:
    """Return `value` as a float, or raise when it is not a finite number."""
    number = _real(name, value)
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {value!r}: pass a number.")
    return number


def positive(name: str, value: object) -> float:
    """Return `value` as a float, or raise when it is not a finite number above zero."""
    number = _real(name, value)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be finite and above 0, got {value!r}: pass a positive number.")
    return number


def fraction(name: str, value: object) -> float:
    """Return `value` as a float, or raise when it does not lie in (0, 1]."""
    number = _real(name, value)
    if not 0 < number <= 1:
        raise ValueError(f"{name} must lie in (0, 1], got {value!r}: pass a share such as 0.11, not a percentage.")
    return number


def whole(name: str, value: object, least: int, most: int = INDEX_LIMIT) -> int:
    """Return `value` as an int, or raise when it is no integer of [least, most]."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be an integer, got {value!r} of type {type(value).__name__}: pass a plain int.")
    number = int(value)
    if not least <= number <= most:
        raise ValueError(f"{name} must lie in [{least}, {most}], got {number}: choose a value of that range.")
    return number


def float_dtype(name: str, value: DTypeLike) -> np.dtype:
    """Return `value` as a NumPy dtype, or raise when it is neither float32 nor float64."""
    try:
        dtype = None if value is None else np.dtype(value)
    except TypeError:
        dtype = None
    if dtype is None or dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ValueError(f"{name} must be float32 or float64, got {value!r}: pass one of the two.")
    return dtype


def vector(name: str, value: float | Sequence[float] | np.ndarray, dim: int) -> np.ndarray:
    """Return `value` as float64 of shape [dim], one number standing for every axis, or raise."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (dim,)):
        raise ValueError(f"{name} must be one number or one per axis, shape [{dim}], got shape {list(array.shape)}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {value!r}: remove the NaN or the infinity.")
    return np.broadcast_to(array, (dim,))


def _real(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r} of type {type(value).__name__}: pass a float.")
    return float(value)
