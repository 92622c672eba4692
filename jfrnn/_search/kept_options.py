"""The options of a search that a neighbor list keeps, as users read them."""

import numpy as np

from jfrnn._geometry import Images
from jfrnn._search.problem import Problem


class KeptOptions:
    """The options of a search, read from the problem that a list holds. They do not change."""

    problem: Problem

    @property
    def cutoff(self) -> float | None:
        """Interaction radius [length], rounded to the dtype of the positions; None with cutoffs per particle."""
        return self.problem.cutoff

    @property
    def skin(self) -> float:
        """Verlet skin [length]."""
        return self.problem.skin

    @property
    def half(self) -> bool:
        """Whether each unordered pair is listed once, in the row of its smaller index."""
        return self.problem.options.filter.later_only

    @property
    def include_self(self) -> bool:
        """Whether each particle is its own neighbor."""
        return self.problem.include_self

    @property
    def closed(self) -> bool:
        """Whether pairs at exactly the cutoff count."""
        return self.problem.options.closed

    @property
    def own_queries(self) -> bool:
        """Whether rows belong to separate `queries` instead of the positions."""
        return self.problem.own_queries

    @property
    def masked(self) -> bool:
        """Whether particles may be inactive."""
        return self.problem.masked

    @property
    def box_kind(self) -> Images | None:
        """The periodic axes and the images that the search considers; None in open space."""
        return self.problem.options.images

    @property
    def source_count(self) -> int:
        """n, the fill value of unused slots."""
        return self.problem.source_count

    @property
    def dim(self) -> int:
        """Dimension of the positions, 2 or 3."""
        return self.problem.dim

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the positions."""
        return self.problem.dtype

    @property
    def backend(self) -> str:
        """Name of the engine that made the list."""
        return self.problem.options.engine.name
