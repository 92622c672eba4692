"""Walls of triangles: which are near which particle, and where they are nearest."""

from jfrnn._triangles.triangle_list import TriangleList, find_triangles
from jfrnn._triangles.verb import TRIANGLE_BACKENDS, fastest_of, search_triangles

__all__ = [
    "TRIANGLE_BACKENDS",
    "TriangleList",
    "fastest_of",
    "find_triangles",
    "search_triangles",
]
