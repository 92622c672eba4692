"""Names that `jax.extend.core` offers to libraries, taken from where JAX defines them.

Importing `jax.extend` imports all of it, Pallas included: 50 ms of the first sum of a process. Where JAX has moved a name, it is
imported from there.
"""

try:
    from jax._src.core import ClosedJaxpr, Jaxpr, Literal, Primitive, find_top_trace, jaxpr_as_fun, set_current_trace
except ImportError:
    from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, find_top_trace, jaxpr_as_fun, set_current_trace

__all__ = ["ClosedJaxpr", "Jaxpr", "Literal", "Primitive", "find_top_trace", "jaxpr_as_fun", "set_current_trace"]
