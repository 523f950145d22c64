"""Self-filter: the robot's own rigid links at the measured joints."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.check import check_finite, check_shape


class RobotBody:
    """Links, each a signed distance function in its own frame.

    Forward kinematics is the caller's: it gives each link's pose at the measured joints.

    Args:
        links: the links' shapes.
    """

    def __init__(self, links: Sequence[SDF]) -> None:
        self.links = tuple(links)

    def near(
        self, points_w: Float[Tensor, "M 3"], world_T_links: Float[Tensor, "L 4 4"], margin_m: float = 0.01
    ) -> Bool[Tensor, "M"]:
        """Which points are within `margin_m` of a link, or in it.

        Args:
            points_w: (M, 3), metres.
            world_T_links: (L, 4, 4), one a link, at the joints that were measured when the points were seen.
            margin_m: what calibration, joints and the model may be off.
        """
        count = len(self.links)
        check_shape("world_T_links", world_T_links, f"({count}, 4, 4)", last=(count, 4, 4))
        check_finite("world_T_links", world_T_links)
        found = torch.zeros(len(points_w), dtype=torch.bool, device=points_w.device)
        for link, pose in zip(self.links, world_T_links.to(points_w), strict=True):
            # only points in the link's box can be near it
            low, high = link.bounds.to(points_w)
            center, radius = se3.apply(pose, (0.5 * (low + high))[None])[0], 0.5 * float((high - low).norm()) + margin_m
            index = ((points_w - center).square().sum(-1) < radius**2).nonzero()[:, 0]
            places = se3.apply(se3.inverse(pose), points_w[index])
            boxed = ((places >= low - margin_m) & (places <= high + margin_m)).all(-1)
            index, places = index[boxed], places[boxed]
            if len(index):
                with torch.no_grad():
                    found[index] |= link.distance(places) <= margin_m
        return found
