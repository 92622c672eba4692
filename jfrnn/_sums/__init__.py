"""Sums over pairs, their derivatives, and the translation of the summand to native code."""

from jfrnn._sums.verb import pair_sum
