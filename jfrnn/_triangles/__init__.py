"""Walls of triangles: which triangles are near each particle, and their nearest points."""

from jfrnn._triangles.engines import TRIANGLE_ENGINES, TriangleEngine, fastest_of, find_triangles
from jfrnn._triangles.triangle_list import TriangleList
from jfrnn._triangles.verb import search_triangles
