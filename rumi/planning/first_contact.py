"""First contacts: where on its way a tool that moves in space first meets an object, at each pose that it may have."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.robot.border import bounding_balls, near_groups
from rumi.robot.gripper import GripperShape
from sdf import backend, compiled, se3
from sdf.base import SDF
from sdf.grid_sdf import takes
from sdf.posed import posed_distance

GROUP = 16
"""Points of the tool that lie near each other, as many as the compiled version leaves out at a time."""

NEAR_M = 0.001
"""Distance that counts as contact."""

LET_GO_M = 0.0005
"""By which the tool may go deeper into what it touches at first, and still lets go of it."""


class FirstContacts(NamedTuple):
    """First contacts of K ways with an object at N poses.

    Attributes:
        step: (K, N), of the way, from 0; the way's own number of steps where it meets nothing.
        point: (K, N), of the tool, that is deepest then; 0 where there is none.
        checked: share of the steps at which distances were looked up, at most.
    """

    step: Int[Tensor, "K N"]
    point: Int[Tensor, "K N"]
    checked: float


@dataclass(frozen=True, eq=False)
class TouchingSurface:
    """Points of a gripper's surface, tool frame, GROUP of them to a group that lie near each other.

    Attributes:
        points: (M, 3), metres.
        patch: (M), number of the part of the pads that a point is on; -1 on the palm, which feels nothing.
    """

    points: Float[Tensor, "M 3"]
    patch: Int[Tensor, "M"]

    @classmethod
    def of(cls, shape: GripperShape, *, pad_spacing_m: float, palm_spacing_m: float, patch_m: float) -> Self:
        """Of a palm and two pads.

        Args:
            shape: of the gripper.
            pad_spacing_m: between points of the pads.
            palm_spacing_m: between points of the palm.
            patch_m: side of the parts of a pad that feel differently.
        """
        pads, every = shape.pad_shell(pad_spacing_m), shape.surface(palm_spacing_m)
        palm = every[shape.in_palm(every)]
        cells = torch.cat(((pads / patch_m).round(), (pads[:, 1:2] > 0).to(pads)), -1)
        cells = torch.unique(cells, dim=0, return_inverse=True)[1]
        points = torch.cat((pads, palm)).float()
        patch = torch.cat((cells, torch.full((len(palm),), -1)))
        groups = near_groups(points, GROUP).flatten()
        return cls(points[groups].contiguous(), patch[groups])

    @cached_property
    def radius_m(self) -> float:
        """Distance of the outermost point from the tool's upright axis."""
        return float(self.points[:, :2].norm(dim=-1).max())

    @cached_property
    def spheres(self) -> Float[Tensor, "G 4"]:
        """Middle and radius of a ball about each group."""
        middle, radius = bounding_balls(self.points.view(-1, GROUP, 3))
        return torch.cat((middle, radius[:, None]), -1)

    def to(self, device: torch.device) -> Self:
        """The same on a device."""
        return type(self)(self.points.to(device), self.patch.to(device))


def first_contacts(
    sdf: SDF,
    world_T_object: Float[Tensor, "N 4 4"],
    ways: Float[Tensor, "K S 4"],
    steps: Int[Tensor, "K"],
    tool: TouchingSurface,
) -> FirstContacts:
    """Where each of K ways first comes as near to an object as `NEAR_M`, for each of N poses of it.

    A way's first step is where the tool is. What it touches there it may let go of: that is a contact, of step 0, where
    a later step is deeper in it than those before.

    Args:
        sdf: of the object.
        world_T_object: poses.
        ways: (x, y, z, yaw) of the level tool at each step.
        steps: how many of them each way has.
        tool: its surface.
    """
    version = backend.dispatch("first_contacts", world_T_object, ways, *sdf.tensors())
    found: FirstContacts = version(sdf, world_T_object, ways, steps, tool)
    return found


@backend.register("first_contacts")
def _first_contacts(
    sdf: SDF, world_T_object: Tensor, ways: Tensor, steps: Tensor, tool: TouchingSurface
) -> FirstContacts:
    poses = len(world_T_object)
    step = steps[:, None].repeat(1, poses)
    point = torch.zeros_like(step)
    for row, way in enumerate(ways):
        floor = torch.full((poses,), NEAR_M).to(way)
        for first, part in enumerate(way[: int(steps[row])].split(1)):
            cos, sin = part[:, 3].cos(), part[:, 3].sin()
            x, y, z = tool.points.to(part).unbind(-1)
            placed = torch.stack((cos * x - sin * y, sin * x + cos * y, z), -1) + part[:, :3]
            open_yet = (step[row] == steps[row]).nonzero()[:, 0]
            deepest, which = posed_distance(sdf, world_T_object[open_yet], placed).min(-1)
            deepest = deepest.clamp_max(NEAR_M)
            if first == 0:
                floor = deepest
            before = floor[open_yet]
            held = before < NEAR_M
            met = deepest < torch.where(held, before - LET_GO_M, before)
            rows = open_yet[met]
            step[row, rows] = torch.where(held[met], 0, first)
            point[row, rows] = which[met]
            floor[open_yet] = torch.maximum(before, deepest)
    return FirstContacts(step, point, 1.0)


@backend.register("first_contacts", "numba", compiled.supports)
def _first_contacts_numba(
    sdf: SDF, world_T_object: Tensor, ways: Tensor, steps: Tensor, tool: TouchingSurface
) -> FirstContacts:
    if not takes(sdf, world_T_object, ways):
        return _first_contacts(sdf, world_T_object, ways, steps, tool)
    from rumi.planning.first_contact_numba import first_contacts as kernel
    from sdf.grid_numba import grid_arguments

    shape = len(ways), len(world_T_object)
    step, point, looked = (torch.zeros(shape, dtype=torch.int32) for _ in range(3))
    numbers = torch.tensor((NEAR_M, tool.radius_m, LET_GO_M))
    kernel(
        ways.float().contiguous().numpy(),
        steps.to(torch.int32).contiguous().numpy(),
        se3.inverse(world_T_object)[:, :3].float().reshape(-1, 12).contiguous().numpy(),
        tool.points.T.flatten().numpy(),
        tool.spheres.T.flatten().numpy(),
        numbers.numpy(),
        grid_arguments(sdf, torch.float32),
        step.numpy(),
        point.numpy(),
        looked.numpy(),
    )
    whole = max(1, int(steps.sum()) * len(world_T_object))
    return FirstContacts(step.long(), point.long(), int(looked.sum()) / whole)
