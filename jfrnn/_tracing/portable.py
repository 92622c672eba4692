"""What programs carry to other processes: static values as JSON, the version that made them, and how types of the library go along.

`jax.export` writes a program to bytes with the types of its arguments and results, of which it has to be told how.
"""

import dataclasses
import functools
import hashlib
import importlib
import json
import os
from collections.abc import Sequence
from importlib.resources import files
from typing import Any, TypeVar

import jax
import jax.export
import numpy as np
from jax.sharding import AxisType, Mesh

Static = Any  # NamedTuples and dataclasses of the library, tuples, dtypes, meshes, texts, numbers
Kind = TypeVar("Kind", bound=type)
_DTYPE, _MESH = "dtype", "mesh"


def portable(kind: Kind) -> Kind:
    """Let a pytree of the library be an argument or a result of programs that `jax.export` writes to bytes."""
    name = f"jfrnn.{kind.__name__}"
    if hasattr(kind, "_fields"):
        return jax.export.register_namedtuple_serialization(kind, serialized_name=name)
    how = {"serialize_auxdata": _write, "deserialize_auxdata": _read}
    return jax.export.register_pytree_node_serialization(kind, serialized_name=name, **how)


def _write(static: Static) -> bytes:
    return json.dumps([name_of_version(), encode(static)]).encode()


def _read(written: bytes) -> Static:
    version, static = json.loads(written)
    check_version(version)
    return decode(static)


def encode(value: Static) -> Static:
    """Return what JSON can write of a static value."""
    if isinstance(value, np.dtype):
        return {_DTYPE: value.name}
    if isinstance(value, Mesh):
        return {_MESH: parts_of_mesh(value)}
    name = f"{type(value).__module__}.{type(value).__name__}"
    if dataclasses.is_dataclass(value):
        return {name: [encode(getattr(value, field.name)) for field in dataclasses.fields(value)]}
    if not isinstance(value, tuple):
        return value
    parts = [encode(part) for part in value]
    return {name: parts} if hasattr(value, "_fields") else parts


def decode(value: Static) -> Static:
    """Return the static value of which `encode` made this."""
    if isinstance(value, list):
        return tuple(decode(part) for part in value)
    if not isinstance(value, dict):
        return value
    ((name, parts),) = value.items()
    if name == _DTYPE:
        return np.dtype(parts)
    if name == _MESH:
        return mesh_of_parts(*parts)
    module, _, kind = name.rpartition(".")
    if not module.startswith("jfrnn."):
        raise ValueError(f"no type of the library: {name}")
    return getattr(importlib.import_module(module), kind)(*map(decode, parts))


def parts_of_mesh(mesh: Mesh) -> tuple[list[int], tuple[int, ...], tuple[str, ...], tuple[str, ...]]:
    """Return what tells a mesh in another process: the numbers of its devices, its shape, and the names and types of its axes."""
    return [d.id for d in mesh.devices.flat], mesh.devices.shape, mesh.axis_names, tuple(kind.name for kind in mesh.axis_types)


def mesh_of_parts(ids: list[int], shape: Sequence[int], names: Sequence[str], kinds: Sequence[str]) -> Mesh:
    """Return the mesh of devices of the same numbers in this process.

    Raises:
        RuntimeError: this process has no such devices.
    """
    devices = {device.id: device for device in jax.devices()}
    if missing := [k for k in ids if k not in devices]:
        raise RuntimeError(
            f"particles were spread over devices {ids}, of which this process lacks {missing}: collect() them before they travel, "
            "and scatter() them anew."
        )
    placed = np.array([devices[k] for k in ids]).reshape(shape)
    return Mesh(placed, tuple(names), axis_types=tuple(AxisType[kind] for kind in kinds))


@functools.cache
def name_of_version() -> str:
    """Return a name of the sources that decide what a program is given, so that it is never given what was made for another."""
    found = hashlib.blake2b(digest_size=6)
    for package, others in (("jfrnn", ("cases", "kernels", "sph")), ("jfrnn.kernels", ())):
        root = str(files(package))
        for folder, inner, names in os.walk(root):
            inner[:] = sorted(name for name in inner if folder != root or name not in others)
            for name in sorted(names):
                if name.endswith((".py", ".h", ".cuh")):
                    with open(f"{folder}/{name}", "rb", buffering=0) as source:  # noqa: PTH123  # a Path takes half of the time
                        found.update(source.read())
    return found.hexdigest()


def check_version(name: str) -> None:
    """Raise if another version of the library made what carries this name.

    Raises:
        RuntimeError: it did.
    """
    if name != name_of_version():
        raise RuntimeError("this program was made with another version of jfrnn. Export or compile it again with this one.")
