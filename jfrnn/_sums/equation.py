"""What rules know that translate equations of JAX (see `jfrnn._sums.primitives`); their inputs are numbers of scalars."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jfrnn._sums.scalars import TYPES, Number, Scalars

Values = np.ndarray  # scalar numbers in the shape of the array that the scalars form


class Spec(NamedTuple):
    """The shape and dtype of an array."""

    shape: tuple[int, ...]
    dtype: str


class Equation(NamedTuple):
    """What a rule knows besides its inputs; `run` translates a nested jaxpr from the equation's parameters."""

    scalars: Scalars
    primitive: Any
    params: dict[str, Any]
    outputs: Sequence[Spec]
    run: Callable[[Any, Sequence[Values]], list[Values]]

    def each(self, operation: str, *arrays: Values, dtype: str | None = None) -> Values:
        """Apply an operation to every element, broadcasting scalars."""
        arrays = np.broadcast_arrays(*arrays)
        rows = zip(*(a.reshape(-1).tolist() for a in arrays), strict=True)
        dtype = dtype or self.outputs[0].dtype
        return np.array([self.scalars.apply(operation, row, dtype) for row in rows], int).reshape(arrays[0].shape)

    def full(self, value: Number, shape: tuple[int, ...] = (), dtype: str | None = None) -> Values:
        """Return an array filled with one constant."""
        return np.full(shape, self.scalars.constant(value, dtype or self.outputs[0].dtype))

    def cast(self, x: Values, dtype: str) -> Values:
        """Convert values to another dtype."""
        return self.each(f"to_{TYPES[dtype]}", x, dtype=dtype)


Rule = Callable[[Equation, list[Values]], list[Values]]
