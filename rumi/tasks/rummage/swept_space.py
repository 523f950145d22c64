"""Swept space: what a gripper's points went through, which is free of the object."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf import se3
from sensors.touch.tactile import InstantPoints, swept_points


class SweptSpace:
    """Points that a gripper swept in a run, action by action.

    Args:
        bounds: lower and upper corner of the workspace, x and y.
        spacing_m: of the lattice that points are reported on.
    """

    def __init__(self, bounds: tuple[tuple[float, float], tuple[float, float]], spacing_m: float) -> None:
        self._bounds, self._spacing_m = bounds, spacing_m
        self._attached = se3.identity()

    def ridden(self, measured: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
        """attached_T_world at each instant of an action, of the frame that rides with the object; takes note of it.

        Args:
            measured: the object's motion since the action's start.
        """
        attached_T_world = se3.inverse(measured @ self._attached)
        self._attached = measured[-1] @ self._attached
        return attached_T_world

    def swept(
        self,
        tool_pose: Float[Tensor, "K 4 4"],
        body: Float[Tensor, "n 3"],
        measured: Float[Tensor, "K 4 4"] | None,
        in_contact: Bool[Tensor, "K"],
        region: Float[Tensor, "2 3"],
    ) -> tuple[InstantPoints, Int[Tensor, "M"]]:
        """World points that an action swept, with the index of the body's point; takes note of a measured motion.

        Args:
            tool_pose: world_T_tool at each instant.
            body: points of the gripper, tool frame.
            measured: the object's motion since the action's start; None where nothing measures it.
            in_contact: whether anything was felt.
            region: box that rides with the object in which points are reported; of one whose motion nothing measures
                its top alone counts.
        """
        if measured is None:
            # nothing moves while nothing is touched; what was swept while touching belongs to its instant alone
            group = in_contact.long().cumsum(0)
            low, high = self._bounds
            region = torch.tensor(((*low, 0.0), (*high, float(region[1, 2]))))
            return swept_points(tool_pose, body, self._spacing_m, group=group, region=region)
        return swept_points(tool_pose, body, self._spacing_m, attached_T_world=self.ridden(measured), region=region)
