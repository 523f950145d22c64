"""Stable resting poses of an object on a level floor."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sdf import so3
from sdf.mesh.convex import hull
from sdf.mesh.mesh import TriangleMesh

OWN_UP_RAD = math.radians(5.0)
"""A mesh's own z counts as up if it stands within this of it."""


class RestingPose(NamedTuple):
    """One way of standing.

    Attributes:
        rest_R_mesh: (3, 3), turns the mesh so that it stands, z up; of all such turns the smallest.
        probability: of landing so, dropped from any orientation without bouncing.
    """

    rest_R_mesh: Float[Tensor, "3 3"]
    probability: float


def resting_poses(mesh: TriangleMesh, center: Float[Tensor, "3"]) -> list[RestingPose]:
    """All faces of the convex hull on which an object stands without tipping, the most probable first (trimesh's).

    Args:
        mesh: whose convex hull meets the floor.
        center: (3,), centre of mass, metres, mesh frame.

    Raises:
        ModuleNotFoundError: without trimesh, scipy or networkx.
        ValueError: the centre of mass is not within the hull.
    """
    import trimesh

    outer = hull(mesh)
    a, b, c = outer.corners.unbind(-2)
    if not bool((((center.double() - a) * torch.linalg.cross(b - a, c - a)).sum(-1) < 0).all()):
        # with it outside there is no end to the toppling
        raise ValueError(f"Expected a centre of mass within the hull, got {center.tolist()} m: is the mesh inside out?")
    body: Any = trimesh.Trimesh(outer.vertices.numpy(), outer.faces.numpy(), process=False)
    transforms, probabilities = body.compute_stable_poses(center_mass=center.double().numpy())
    ups = torch.from_numpy(np.asarray(transforms)[:, 2, :3].copy())
    order = np.argsort(-np.asarray(probabilities), kind="stable")
    return [RestingPose(turn_to_z(ups[i]), float(probabilities[i])) for i in order.tolist()]


def upright(poses: list[RestingPose]) -> RestingPose:
    """The most probable of the poses whose up is about the mesh's own z, else the most probable of all.

    Args:
        poses: of `resting_poses`.

    Raises:
        ValueError: there is no pose.
    """
    if not poses:
        raise ValueError("Expected the object to stand in some pose, found none: say how it stands")
    own = [pose for pose in poses if float(pose.rest_R_mesh[2, 2]) >= math.cos(OWN_UP_RAD)]
    return max(own or poses, key=lambda pose: pose.probability)


def turn_to_z(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that carries a unit vector to z; of half turns the one about x."""
    cross = torch.stack((up[1], -up[0], torch.zeros_like(up[0])))  # up x z
    sine = float(cross.norm())
    if sine < 1e-12:
        line = torch.tensor((math.pi, 0.0, 0.0), dtype=up.dtype)
        return so3.exp(line if float(up[2]) < 0 else torch.zeros_like(line))
    return so3.exp(cross * (math.atan2(sine, float(up[2])) / sine))


def center_of_mass(mesh: TriangleMesh) -> Float[Tensor, "3"]:
    """Centre of what a closed, outward oriented mesh encloses, evenly dense; overlaps count as often as they wind.

    Args:
        mesh: encloses a volume.
    """
    middle = mesh.corners.mean((0, 1))
    a, b, c = (mesh.corners - middle).unbind(-2)
    volumes = (a * torch.linalg.cross(b, c)).sum(-1)
    return middle + (volumes[:, None] * (a + b + c)).sum(0) / (4.0 * volumes.sum())
