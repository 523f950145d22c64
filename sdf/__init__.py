"""Geometry: rigid transforms, signed distance functions and lattices, in torch alone.

A signed distance function is a module that takes points of the object's own frame, of any batch shape:

>>> import torch
>>> from sdf.grid_sdf import GridSDF
>>> from sdf.primitives import Box
>>> box = Box((0.03, 0.08, 0.105))
>>> box.distance(torch.tensor([[0.05, 0.0, 0.0], [0.0, 0.0, 0.0]]))
tensor([ 0.0200, -0.0300])
>>> table = GridSDF.from_sdf(box, spacing=0.005)
>>> query = table(torch.tensor([[0.06, 0.0, 0.0]]))
>>> query.distance
tensor([0.0300])
>>> query.gradient.round(decimals=3)
tensor([[1., 0., 0.]])

A mesh of triangles becomes such a table in one line, whatever is wrong with it (`sdf.mesh.build` says more):

    table = sdf.from_mesh("mug.obj", scale=0.001, cache_dir="cache")

Many poses of it against many points of the world are one call:

>>> from sdf import se3
>>> from sdf.posed import posed_distance
>>> world_T_object = se3.from_planar(torch.tensor([[0.4, 0.0, 0.0], [0.5, 0.0, 0.0]]), z=0.105)
>>> posed_distance(table, world_T_object, torch.tensor([[0.4, 0.0, 0.1]]))
tensor([[-0.0300],
        [ 0.0700]])
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sdf.mesh.build import from_mesh

__all__ = ["from_mesh"]


def __getattr__(name: str) -> Any:  # noqa: ANN401  (whatever is asked for)
    """Load what meshes need only when it is asked for."""
    if name == "from_mesh":
        from sdf.mesh.build import from_mesh

        return from_mesh
    raise AttributeError(f"module 'sdf' has no attribute {name!r}")
