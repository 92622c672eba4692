"""Names for types that Python cannot express; each says what an `Any` stands for."""

from typing import Any

Tree = Any  # a pytree of arrays, of any structure
Given = Any  # an argument as the user passed it, before it is checked
Aval = Any  # the type of an array in JAX's tracing: shape, dtype and the mesh axes over which it varies
Internal = Any  # an internal object of JAX, such as a primitive, a jaxpr or a lowering context
