"""Names for what has no type that Python can write down: they say what stands in the place of an `Any`."""

from typing import Any

Tree = Any  # a pytree of arrays, of whatever structure
Given = Any  # an argument as the user passed it, before it is checked
Aval = Any  # the type of an array as JAX's tracing knows it: its shape, its dtype and over which axes it varies
Internal = Any  # an object of JAX's own machinery, such as a primitive, a jaxpr or the context of a lowering
