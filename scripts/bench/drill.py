"""The registration problem of chsel's own test: points about one part of a power drill, in three classes."""

import importlib.util
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sdf import se3, so3
from sdf.base import SDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh import load_mesh
from sdf.object_model import ObjectModel
from sdf.posed import posed_distance
from sdf.symmetry import Symmetries
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

MESH = Path("ycb_power_drill") / "power_drill.obj"
# metres, object frame: where points are taken from in chsel's test, and how far from each other
REGION = ((0.01, 0.15), (0.01, 0.15), (0.05, 0.2))
SPACING_M = 0.005
KNOWN_M = 0.005
FOUND_M = 0.005


class Problem(NamedTuple):
    """Points to register.

    Attributes:
        truth: (4, 4), world_T_object.
        observation: points of the world, whose middle is its origin.
    """

    truth: Float[Tensor, "4 4"]
    observation: Observation

    @property
    def observation_parts(self) -> tuple[Tensor, Tensor]:
        """Points and semantics."""
        return self.observation.points, self.observation.semantics


def missing() -> str:
    """Why there is no drill; empty where there is one."""
    folder = os.environ.get("RUMI_DATA")
    if not folder or not (Path(folder) / MESH).is_file():
        return f"the environment variable RUMI_DATA names no folder with {MESH}"
    lacking = [name for name in ("trimesh", "scipy") if importlib.util.find_spec(name) is None]
    return f"{' and '.join(lacking)} not installed (the extra mesh)" if lacking else ""


@cache
def drill(spacing: float = 0.0025) -> ObjectModel:
    """The drill, tabulated every `spacing` metres, with 500 points of its surface."""
    mesh = load_mesh(Path(os.environ["RUMI_DATA"]) / MESH)
    table = from_mesh(mesh, spacing=spacing, padding=0.01, outer=0.06)
    corners = mesh.corners
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    random = torch.Generator().manual_seed(0)
    chosen = torch.multinomial(normals.norm(dim=-1), 500, replacement=True, generator=random)
    share = torch.rand(500, 3, generator=random, dtype=torch.float64).log()
    share = (share / share.sum(-1, keepdim=True))[..., None]
    points = (share * corners[chosen]).sum(1).float()
    unit = torch.nn.functional.normalize(normals[chosen], dim=-1).float()
    return ObjectModel("power drill", table, table, points, unit, Symmetries.none())


def problem(sdf: SDF, seed: int, *, each: int = 200) -> Problem:
    """Points of chsel's test: `each` free, occupied and known ones, in the world and centred there.

    Free and occupied ones are further than 5 mm from the surface. The others, known to be nearer, count as surface: so
    they do in the test, whose known distances end up as whole numbers.
    """
    random = torch.Generator().manual_seed(seed)
    axes = [torch.arange(low, high + 1e-9, SPACING_M) for low, high in REGION]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = points[torch.randperm(len(points), generator=random)]
    distance = sdf.distance(points)
    parts = (
        (points[distance > KNOWN_M], Semantics.FREE),
        (points[distance < -KNOWN_M], Semantics.OCCUPIED),
        (points[distance.abs() <= KNOWN_M], Semantics.SURFACE),
    )
    observation = concatenate([Observation.of(part[:each], kind) for part, kind in parts])
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=random), dim=0)
    angle = 2 * torch.atan2(quaternion[1:].norm(), quaternion[0])
    rotation = so3.exp(angle * torch.nn.functional.normalize(quaternion[1:], dim=0))
    placed = observation.points @ rotation.mT
    middle = placed.mean(0)
    return Problem(se3.make(rotation, -middle), replace(observation, points=placed - middle))


def one_part(whole: Problem, low: float, high: float, count: int) -> Problem:
    """A second view that may mean several poses: surface points of one slab of the drill, and free ones near them.

    Args:
        whole: the problem that it is a part of.
        low: metres, lower end of the slab along the drill's z axis.
        high: upper end.
        count: points of each class at most.
    """
    local = se3.apply(se3.inverse(whole.truth), whole.observation.points)
    within = (local[:, 2] >= low) & (local[:, 2] <= high)
    chosen = []
    for kind in (Semantics.FREE, Semantics.SURFACE):
        chosen.append((within & (whole.observation.semantics == kind)).nonzero()[:count, 0])
    observation = whole.observation[torch.cat(chosen)]
    middle = observation.points.mean(0)
    truth = whole.truth.clone()
    truth[:3, 3] -= middle
    return Problem(truth, replace(observation, points=observation.points - middle))


def surface_error(model: ObjectModel, world_T_object: Float[Tensor, "P 4 4"], truth: Tensor) -> Float[Tensor, "P"]:
    """Mean distance of the true surface from the object at each pose, metres."""
    points = se3.apply(truth, model.surface_points)
    return posed_distance(model.sdf, world_T_object, points).abs().mean(-1)
