import math

import pytest
import torch

from sdf.mesh.surface_nets import mesh_of
from sdf.primitives import Box, Sphere

SHAPES = [(Sphere(0.05), 4 / 3 * math.pi * 0.05**3), (Box((0.02, 0.03, 0.04)), 8 * 0.02 * 0.03 * 0.04)]


@pytest.mark.parametrize(("shape", "volume"), SHAPES)
def test_it_is_closed_faces_outward_and_lies_on_the_surface(shape, volume):
    mesh = mesh_of(shape, spacing=0.004)
    a, b, c = mesh.corners.unbind(1)
    assert float((a * torch.linalg.cross(b, c)).sum()) / 6 == pytest.approx(volume, rel=0.03)
    assert float(shape.distance(mesh.vertices).abs().max()) < 1e-6
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    once = {tuple(edge) for edge in edges.tolist()}
    assert len(once) == len(edges), "each edge is gone along once in each direction"
    assert all((end, begin) in once for begin, end in once)


def test_a_spacing_below_zero_is_refused():
    with pytest.raises(ValueError, match="spacing above 0"):
        mesh_of(Sphere(0.05), spacing=-1.0)
