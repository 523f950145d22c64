"""Worlds far from their origin: brought to a near one in float64, before single precision, and results back.

Neighbouring float32 numbers are 6e-5 m apart 1 km from the origin, and 0.03 m at the coordinates of a map. What is
rounded there is lost; so the middle of the workspace is subtracted while the numbers are still float64.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from sdf.check import check_finite, check_near, check_shape


@dataclass(frozen=True, eq=False)
class Recentred:
    """A frame that is parallel to the world's, with its origin near what is worked on.

    Attributes:
        origin_w: (3,), its origin in the world, metres, float64.
    """

    origin_w: Float[Tensor, "3"]

    @classmethod
    def about(cls, places_w: Float[Tensor, "*b 3"]) -> Self:
        """About the middle of some places, such as a workspace's corners, in whole metres: so that sums stay exact.

        Raises:
            ValueError: there are none, some are not finite, or they come rounded already.
        """
        check_shape("places_w", places_w, "(*b, 3)", last=(3,))
        if places_w.numel() == 0:
            raise ValueError("Expected places to be about, got none")
        check_finite("places_w", places_w)
        check_near("places_w", places_w)
        flat = places_w.detach().double().reshape(-1, 3)
        return cls((0.5 * (flat.amin(0) + flat.amax(0))).round())

    def points(self, points_w: Float[Tensor, "*b 3"], dtype: torch.dtype = torch.float32) -> Float[Tensor, "*b 3"]:
        """World points in this frame.

        Raises:
            ValueError: they come rounded already, or are too far from this origin for the dtype.
        """
        return self._near("points_w", points_w, dtype)

    def poses(
        self, world_T_object: Float[Tensor, "*b 4 4"], dtype: torch.dtype = torch.float32
    ) -> Float[Tensor, "*b 4 4"]:
        """Poses in the world as poses in this frame; raises as `points`."""
        place = self._near("world_T_object", world_T_object[..., :3, 3], dtype)
        made = world_T_object.to(dtype)
        return torch.cat((torch.cat((made[..., :3, :3], place[..., None]), -1), made[..., 3:, :]), -2)

    def world_points(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Points of this frame in the world, float64."""
        return points.double() + self.origin_w.to(points.device)

    def world_poses(self, frame_T_object: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
        """Poses in this frame as poses in the world, float64."""
        made = frame_T_object.double()
        place = self.world_points(made[..., :3, 3])
        return torch.cat((torch.cat((made[..., :3, :3], place[..., None]), -1), made[..., 3:, :]), -2)

    def _near(self, name: str, places: Tensor, dtype: torch.dtype) -> Tensor:
        check_near(name, places)
        near = places.double() - self.origin_w.to(places.device)
        check_near(f"{name} less origin_w", near, dtype)
        return near.to(dtype)
