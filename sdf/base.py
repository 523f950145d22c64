"""What every signed distance function is: a callable on object-frame points."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SDFQuery(NamedTuple):
    """Signed distance and its gradient at some points.

    Attributes:
        distance: (*b), metres, positive outside.
        gradient: (*b, 3), d distance / d point in the object frame, pointing outward.
    """

    distance: Float[Tensor, "*b"]
    gradient: Float[Tensor, "*b 3"]


class SDF(nn.Module):
    """Signed distance function of one rigid object, in the object's own frame.

    Members implement `distance` (value only, differentiable) and `forward` (value and gradient).
    `bounds` (2, 3), metres, is an axis-aligned box that holds the object.
    """

    bounds: Float[Tensor, "2 3"]

    def __init__(self, bounds: Float[Tensor, "2 3"]) -> None:
        super().__init__()
        self.register_buffer("bounds", bounds)

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance of object-frame points, metres; autograd reaches the points."""
        raise NotImplementedError  # abstract: every member has one

    def forward(self, points_o: Float[Tensor, "*b 3"]) -> SDFQuery:
        """Signed distance and outward gradient of object-frame points (*b, 3)."""
        points = points_o if points_o.requires_grad else points_o.detach().requires_grad_()
        with torch.enable_grad():
            distance = self.distance(points)
            (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=points_o.requires_grad)
        if not points_o.requires_grad:
            distance = distance.detach()
        return SDFQuery(distance, gradient)

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, metres (the papers' l_c)."""
        return float((self.bounds[1] - self.bounds[0]).norm())
