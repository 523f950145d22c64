"""Geometry: rigid transforms, signed distance functions and lattices, in torch alone.

A signed distance function takes points of the object's own frame, of any batch shape, metres:

>>> import torch
>>> import sdf
>>> box = sdf.primitives.Box((0.03, 0.08, 0.105))
>>> box.distance(torch.tensor([[0.05, 0.0, 0.0], [0.0, 0.0, 0.0]]))
tensor([ 0.0200, -0.0300])
>>> table = sdf.GridSDF.from_sdf(box, spacing=0.005)
>>> query = table(torch.tensor([[0.06, 0.0, 0.0]]))
>>> query.distance
tensor([0.0300])
>>> query.gradient.round(decimals=3)
tensor([[1., 0., 0.]])

A mesh of triangles becomes such a table in one line, whatever is wrong with it (`sdf.mesh.build` says more):

    table = sdf.from_mesh("mug.obj", scale=0.001, cache_dir="cache")

Many poses of it against many points of the world are one call; `sdf.posed_query` gives gradients, too:

>>> world_T_object = sdf.se3.from_planar(torch.tensor([[0.4, 0.0, 0.0], [0.5, 0.0, 0.0]]), z=0.105)
>>> sdf.posed_distance(table, world_T_object, torch.tensor([[0.4, 0.0, 0.1]]))
tensor([[-0.0300],
        [ 0.0700]])

All other modules can be imported by name.
"""

from typing import TYPE_CHECKING

from sdf.public import lazily

if TYPE_CHECKING:
    from sdf import primitives, se3, so3
    from sdf.base import SDF, SDFQuery
    from sdf.grid_sdf import GridSDF
    from sdf.mesh.build import from_mesh
    from sdf.mesh.find_symmetry import find_symmetries
    from sdf.posed import posed_distance, posed_query

__all__ = [
    "SDF",
    "GridSDF",
    "SDFQuery",
    "find_symmetries",
    "from_mesh",
    "posed_distance",
    "posed_query",
    "primitives",
    "se3",
    "so3",
]

__getattr__ = lazily(
    "sdf",
    {
        "SDF": "sdf.base",
        "GridSDF": "sdf.grid_sdf",
        "SDFQuery": "sdf.base",
        "find_symmetries": "sdf.mesh.find_symmetry",
        "from_mesh": "sdf.mesh.build",
        "posed_distance": "sdf.posed",
        "posed_query": "sdf.posed",
        "primitives": "sdf.primitives",
        "se3": "sdf.se3",
        "so3": "sdf.so3",
    },
)
