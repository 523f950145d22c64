"""Systematic errors of a run, as numbers of every particle: what is off by the same at all instants is no noise.

A robot takes its tool to be where it is not, the object's surface lies deeper than its model's, it is of another size,
and a camera's calibration is off: each of these is drawn once, and every reading of a run shares it. Independent
readings whose noise is as wide would count each of them anew, and a belief grow sure of what they have in common.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import rotated

NUMBERS, WEAR, VIEW, SIZE = 8, 3, 4, 7
"""Standard normals of a particle: where its tool is taken to be (x, y, yaw), its wear, its view (x, y, yaw), and its
size; where among them wear is, where the view begins and ends, which is where size is."""


@dataclass(frozen=True)
class SystematicErrors:
    """Systematic errors of N particles; float64.

    Attributes:
        tool_m: (N, 2), where the tool is taken to be, seen from where it is, along the axes of the true one.
        tool_rad: (N), by which it is taken to be turned.
        worn_m: (N), how much deeper the object's surface lies than its model's.
        view_m: (N, 2), where what a camera saw is taken to be, seen from where it is, world axes,
        view_rad: (N), and by which it is taken to be turned about a point of the world,
        about_m: (2), which is this.
        size: (N), of the object, times its model's.
    """

    tool_m: Float[Tensor, "N 2"]
    tool_rad: Float[Tensor, "N"]
    worn_m: Float[Tensor, "N"]
    view_m: Float[Tensor, "N 2"]
    view_rad: Float[Tensor, "N"]
    about_m: Float[Tensor, "2"]
    size: Float[Tensor, "N"]

    @classmethod
    def of(cls, own: PoseTrajectorySettings, numbers: Float[Tensor, "N 8"]) -> Self:
        """Those of standard normals."""
        return cls(
            own.tool_off_m * numbers[:, :2],
            own.tool_off_rad * numbers[:, 2],
            own.worn[0] + own.worn[1] * numbers[:, WEAR],
            own.view_off_m * numbers[:, VIEW : VIEW + 2],
            own.view_off_rad * numbers[:, VIEW + 2],
            numbers.new_tensor(own.view_about_m or (0.0, 0.0)),
            (own.size_off * numbers[:, SIZE]).exp(),
        )

    @property
    def table(self) -> Float[Tensor, "N 8"]:
        """All of them in the order of the normals, as the compiled version takes them, the view turned about 0."""
        view_m = self.about_m - rotated(self.about_m.expand_as(self.view_m), self.view_rad) + self.view_m
        turns = self.tool_rad[:, None], self.worn_m[:, None], view_m, self.view_rad[:, None], self.size[:, None]
        return torch.cat((self.tool_m, *turns), -1)

    def of_the_model(self, local: Float[Tensor, "N M 3"], resting_m: float) -> Float[Tensor, "N M 3"]:
        """Points in the object's frame, as those of its model, which stands on the floor by as much as it is worn."""
        height = local[..., 2:] + resting_m + self.worn_m[:, None, None]
        return torch.cat((local[..., :2], height), -1) / self.size[:, None, None] - local.new_tensor(
            (0.0, 0.0, resting_m)
        )

    def tool(self, taken: Float[Tensor, "3"]) -> Float[Tensor, "N 3"]:
        """Where the tool is, (x, y, yaw), by where it is taken to be."""
        yaw = taken[2] - self.tool_rad
        return torch.cat((taken[:2] - rotated(self.tool_m, yaw), yaw[:, None]), -1)

    def felt(self, pose: Float[Tensor, "N 3"], taken: Float[Tensor, "3"]) -> Float[Tensor, "N 3"]:
        """Where the object would be if the tool were where it is taken to be, and felt the same."""
        place = taken[:2] + rotated(pose[:, :2] - self.tool(taken)[:, :2], self.tool_rad)
        return torch.cat((place, (pose[:, 2] + self.tool_rad)[:, None]), -1)

    def seen(self, pose: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Where a camera has the object."""
        place = self.about_m + rotated(pose[:, :2] - self.about_m, self.view_rad) + self.view_m
        return torch.cat((place, (pose[:, 2] + self.view_rad)[:, None]), -1)

    def unseen(self, seen: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Where the object is by where a camera has it."""
        place = self.about_m + rotated(seen[:, :2] - self.view_m - self.about_m, -self.view_rad)
        return torch.cat((place, (seen[:, 2] - self.view_rad)[:, None]), -1)


def as_seen(
    own: PoseTrajectorySettings, numbers: Float[Tensor, "N E"], pose: Float[Tensor, "N D"]
) -> Float[Tensor, "N D"]:
    """Where a camera has objects, by standard normals of systematic errors; where they are, if there are none."""
    return SystematicErrors.of(own, numbers).seen(pose) if numbers.shape[1] else pose


def as_it_is(
    own: PoseTrajectorySettings, numbers: Float[Tensor, "N E"], seen: Float[Tensor, "N D"]
) -> Float[Tensor, "N D"]:
    """Where objects are that a camera has there; as `as_seen`."""
    return SystematicErrors.of(own, numbers).unseen(seen) if numbers.shape[1] else seen
