"""Space-filling curves: encode cells as keys along the Morton and Hilbert curves, and decode them.

Keys are computed in two uint32 words, whether or not JAX's 64-bit mode is on. Only `_pack` and `_unpack` depend on that mode.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._tracing import Given, as_array, at_once, compile_program, own_transfers

Words = tuple[Array, Array]  # high and low half of a key, uint32
_MOST_BITS = {2: 31, 3: 21}


def morton_encode(coords: Array, bits: int | None = None) -> Array:
    """Compute the Morton (Z-order) keys of cells: the bits of their coordinates interleaved, x lowest.

    The value does not depend on `bits`; the type does. It is determined by the dimension, `bits` and JAX's 64-bit mode:

    - d * bits <= 32 (2D: 16, 3D: 10 bits): one uint32 per cell, shape [...];
    - more bits, 64-bit mode on: one uint64 per cell, shape [...];
    - more bits, 64-bit mode off: two uint32 words per cell (high, low), shape [..., 2].

    Args:
        coords: Cell coordinates, integers of any width, shape [..., 2] or [..., 3], 0 <= c < 2^bits.
        bits: Bits per axis, a static int, at most 31 in 2D and 21 in 3D. Default: that many.

    Returns:
        The keys.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range. Coordinates out of range raise if they are
            concrete; of traced ones only the lowest `bits` bits are used.

    Differentiable: no (integers). Jit: yes, bits static. vmap: yes. Source: Morton (1966), A computer oriented geodetic data base.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.morton_encode(jnp.array([[0, 0], [1, 0], [0, 1], [1, 1]]), bits=1).tolist()
    [0, 1, 2, 3]
    """
    coords, bits = _check_coords(coords, bits, default=True)
    return _encode(coords, bits, morton_words)


def morton_decode(keys: Array, dim: int, bits: int | None = None) -> Array:
    """Invert `morton_encode`.

    Args:
        keys: What `morton_encode` returns for this dimension, these bits and this 64-bit mode.
        dim: 2 or 3.
        bits: Bits per axis, as in `morton_encode`.

    Returns:
        Cell coordinates, int32, shape [..., dim].

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, as in `morton_encode`.

    Differentiable: no (integers). Jit: yes, dim and bits static. vmap: yes. Source: as in `morton_encode`.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.morton_decode(jnp.array([0, 1, 2, 3], jnp.uint32), dim=2, bits=1).tolist()
    [[0, 0], [1, 0], [0, 1], [1, 1]]
    """
    keys, dim, bits = _check_keys(keys, dim, bits, default=True)
    return _decode(keys, dim, bits, lambda words, dim, _: _separate(words, dim))


def hilbert_encode(coords: Array, bits: int) -> Array:
    """Compute the positions of cells along the Hilbert curve through the cube of 2^bits cells per axis.

    Two cells that follow each other on the curve share a face. The convention is Skilling's: the curve starts at the origin and
    ends at the far end of x; of the first 2^d cells, the second is one step along the last axis. bits = 1 in 3D visits (x, y, z) =
    000 001 011 010 110 111 101 100. Keys do not change if `bits` grows by a multiple of d.

    Args:
        coords: Cell coordinates, integers of any width, shape [..., 2] or [..., 3], 0 <= c < 2^bits.
        bits: Bits per axis (the order of the curve), a static int, at most 31 in 2D and 21 in 3D.

    Returns:
        The keys, of the type that `morton_encode` gives: uint32 [...] where d * bits <= 32, else uint64 [...] with the 64-bit
        mode on, and uint32 words [..., 2] (high, low) with it off.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, as in `morton_encode`.

    Differentiable: no (integers). Jit: yes, bits static. vmap: yes. Source: Skilling (2004), Programming the Hilbert curve,
    doi:10.1063/1.1751381.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.hilbert_encode(jnp.array([[0, 0], [0, 1], [1, 1], [1, 0]]), bits=1).tolist()
    [0, 1, 2, 3]
    """
    coords, bits = _check_coords(coords, bits)
    return _encode(coords, bits, hilbert_words)


def hilbert_decode(keys: Array, dim: int, bits: int) -> Array:
    """Invert `hilbert_encode`.

    Args:
        keys: What `hilbert_encode` returns for this dimension, these bits and this 64-bit mode.
        dim: 2 or 3.
        bits: Bits per axis, as in `hilbert_encode`.

    Returns:
        Cell coordinates, int32, shape [..., dim].

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, as in `morton_encode`.

    Differentiable: no (integers). Jit: yes, dim and bits static. vmap: yes. Source: as in `hilbert_encode`.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.hilbert_decode(jnp.array([0, 1, 2, 3], jnp.uint32), dim=2, bits=1).tolist()
    [[0, 0], [0, 1], [1, 1], [1, 0]]
    """
    keys, dim, bits = _check_keys(keys, dim, bits)
    return _decode(keys, dim, bits, _hilbert_axes)


@functools.partial(compile_program, static_argnames=("bits", "curve"))
def _encode(coords: Array, bits: int, curve: Callable[[list[Array], int], Words]) -> Array:
    dim = coords.shape[-1]
    mask = np.uint32(2**bits - 1)
    return _pack(*curve([coords[..., axis].astype(jnp.uint32) & mask for axis in range(dim)], bits), dim * bits)


@functools.partial(compile_program, static_argnames=("dim", "bits", "curve"))
def _decode(keys: Array, dim: int, bits: int, curve: Callable[[Words, int, int], list[Array]]) -> Array:
    mask = np.uint32(2**bits - 1)
    return jnp.stack([(c & mask).astype(jnp.int32) for c in curve(_unpack(keys, dim * bits), dim, bits)], axis=-1)


def hilbert_words(axes: list[Array], bits: int) -> Words:
    """Return Hilbert keys; x contributes the highest of each group of d bits in the key."""
    return morton_words(hilbert_digits(axes, bits), bits)


def hilbert_digits(axes: list[Array], bits: int, unroll: int = 2) -> list[Array]:
    """Return the binary digits of Hilbert keys, one array per axis, the lowest of each group first: Skilling's AxestoTranspose."""
    axes = _turn_levels(axes, bits, unroll, upwards=False)
    for axis in range(1, len(axes)):
        axes[axis] = axes[axis] ^ axes[axis - 1]
    parity = axes[-1]  # becomes the parity of all bits above each bit
    for step in (1, 2, 4, 8, 16):
        parity = parity ^ parity >> step
    return [c ^ parity >> 1 for c in reversed(axes)]


def _hilbert_axes(words: Words, dim: int, bits: int) -> list[Array]:
    """Invert `hilbert_words`: Skilling's TransposetoAxes."""
    axes = _separate(words, dim)[::-1]
    parity = axes[-1] >> 1
    for axis in range(dim - 1, 0, -1):
        axes[axis] = axes[axis] ^ axes[axis - 1]
    axes[0] = axes[0] ^ parity
    return _turn_levels(axes, bits, upwards=True)


def _turn_levels(axes: list[Array], bits: int, unroll: int = 2, *, upwards: bool) -> list[Array]:
    """For each level and axis, invert the bits of x below the level if the axis has the level's bit, else swap them with x's.

    Each such step is its own inverse. The steps form a loop because XLA may take minutes to compile 60 of them unrolled.
    """

    def turn(step: Array, axes: list[Array]) -> list[Array]:
        level = jnp.asarray(step if upwards else bits - step).astype(jnp.uint32)  # without jit, `step` is a Python int
        below = (jnp.uint32(1) << level) - 1
        for axis in range(len(axes))[:: -1 if upwards else 1]:
            upper = (axes[axis] >> level & 1) == 1
            swapped = jnp.where(upper, 0, (axes[0] ^ axes[axis]) & below)
            axes[0] = axes[0] ^ jnp.where(upper, below, swapped)
            axes[axis] = axes[axis] ^ swapped
        return axes

    return lax.fori_loop(1, bits, turn, axes, unroll=unroll)


def morton_words(axes: list[Array], _: int) -> Words:
    """Return Morton keys: bit b of axis a is bit d * b + a of the key."""
    high = low = jnp.zeros_like(axes[0])
    for axis, c in enumerate(axes):
        first, shift = _high_part(axis, len(axes))
        low = low | spread(c, len(axes)) << axis
        high = high | spread(c >> first, len(axes)) << shift
    return high, low


def _separate(words: Words, dim: int) -> list[Array]:
    high, low = words
    parts = [_high_part(axis, dim) for axis in range(dim)]
    return [_gather(low >> axis, dim) | _gather(high >> shift, dim) << first for axis, (first, shift) in enumerate(parts)]


def _high_part(axis: int, dim: int) -> tuple[int, int]:
    """Return the lowest bit of an axis that goes to the high word, and its position there."""
    first = -(-(32 - axis) // dim)
    return first, dim * first + axis - 32


def spread(c: Array, dim: int) -> Array:
    """Move bit b to bit d * b, for as many bits as fit into one word (2D: 16, 3D: 11)."""
    c = c & np.uint32(2 ** -(-32 // dim) - 1)
    for group in (8, 4, 2, 1):
        c = (c | c << (dim - 1) * group) & _groups(group, dim)
    return c


def _gather(c: Array, dim: int) -> Array:
    """Move bit d * b to bit b: the inverse of `spread`."""
    c = c & _groups(1, dim)
    for group in (1, 2, 4, 8):
        c = (c | c >> (dim - 1) * group) & _groups(2 * group, dim)
    return c


def _groups(length: int, dim: int) -> np.uint32:
    """Return a mask in which `length` bits are set at every multiple of dim * length."""
    mask = sum((2**length - 1) << start for start in range(0, 32, dim * length))
    return np.uint32(mask & (2**32 - 1))


def _wide() -> bool:
    return bool(jax.config.read("jax_enable_x64"))


def _pack(high: Array, low: Array, key_bits: int) -> Array:
    if key_bits <= 32:
        return low
    return high.astype(jnp.uint64) << 32 | low.astype(jnp.uint64) if _wide() else jnp.stack([high, low], axis=-1)


def _unpack(keys: Array, key_bits: int) -> Words:
    if key_bits <= 32:
        return jnp.zeros_like(keys), keys
    return ((keys >> 32).astype(jnp.uint32), keys.astype(jnp.uint32)) if _wide() else (keys[..., 0], keys[..., 1])


def _check_coords(coords: Given, bits: object, default: bool = False) -> tuple[Array, int]:
    """Return checked coordinates, [..., 2] or [..., 3], and the number of bits."""
    coords = as_array("coords", coords)
    dtype = getattr(coords, "dtype", type(coords).__name__)
    if isinstance(dtype, str) or not jnp.issubdtype(dtype, jnp.integer):
        raise TypeError(
            f"coords must be a JAX or NumPy array of integers, got {dtype}: number the cells first, e.g. with "
            "jnp.floor(x / cell_size).astype(jnp.int32)."
        )
    shape = list(coords.shape)
    if not shape or shape[-1] not in (2, 3):
        raise ValueError(f"coords must have shape [..., 2] or [..., 3], one row per cell, got shape {shape}.")
    bits = _check_bits(bits, shape[-1], default)
    _check_range("coords", coords, 2**bits, "give more bits, or count the cells from the lowest one")
    return jnp.asarray(coords), bits


def _check_keys(keys: Given, dim: object, bits: object, default: bool = False) -> tuple[Array, int, int]:
    """Return checked keys of the dtype that encoding gives, the dimension and the number of bits."""
    if isinstance(dim, bool) or not isinstance(dim, int | np.integer) or dim not in (2, 3):
        raise ValueError(f"dim must be 2 or 3, a static int, got {dim!r}.")
    dim = int(dim)
    bits = _check_bits(bits, dim, default)
    words = dim * bits > 32 and not _wide()
    wanted = np.dtype(np.uint64 if dim * bits > 32 and not words else np.uint32)
    keys = as_array("keys", keys)
    dtype, shape = getattr(keys, "dtype", type(keys).__name__), list(np.shape(keys))
    if dtype != wanted or (words and shape[-1:] != [2]):
        raise TypeError(
            f"keys of dim={dim} and bits={bits} are {wanted} of shape {'[..., 2] (high, low)' if words else '[...]'} with JAX's "
            f"64-bit mode {'on' if _wide() else 'off'}, got {dtype} of shape {shape}: encode with the same bits and mode."
        )
    with own_transfers():
        highest, limit = (keys[..., 0], 2 ** (dim * bits - 32)) if words else (keys, 2 ** (dim * bits))
    _check_range("keys", highest, limit, "decode with the bits that the keys were made with")
    return jnp.asarray(keys), dim, bits


def _check_bits(bits: object, dim: int, default: bool) -> int:
    most = _MOST_BITS[dim]
    if bits is None and default:
        return most
    if isinstance(bits, bool) or not isinstance(bits, int | np.integer):
        raise TypeError(f"bits must be a static int (bits per axis), known while tracing, got {type(bits).__name__}.")
    if not 1 <= bits <= most:
        raise ValueError(f"bits must be 1 to {most} per axis in {dim}D, got {bits}.")
    return int(bits)


def _check_range(name: str, values: Given, limit: int, advice: str) -> None:
    """Raise for concrete integers outside [0, limit), before a conversion could drop their high bits."""
    if isinstance(values, Tracer) or not values.size:
        return
    if isinstance(values, np.ndarray):  # a program would have 32 bits of it
        low, high = int(values.min()), int(values.max())
    else:
        with at_once(), own_transfers():  # also evaluates concrete values inside jit
            low, high = (int(x) for x in _range(values))
    if not 0 <= low <= high < limit:
        raise ValueError(f"{name} must be in [0, {limit}), got values from {low} to {high}: {advice}.")


@compile_program
def _range(values: Array) -> tuple[Array, Array]:
    return jnp.min(values), jnp.max(values)
