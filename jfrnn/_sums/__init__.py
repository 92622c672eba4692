"""Sums over pairs: what they are, their derivatives, and their translation to native text."""

from jfrnn._sums.verb import pair_sum

__all__ = [
    "pair_sum",
]
