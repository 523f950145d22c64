"""Soft-bubble tactile sensor: contact by the deformation of a membrane that a camera inside watches."""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple, Self

import numpy as np
import torch
from annotated_types import Ge
from jaxtyping import Bool, Float
from torch import Tensor

from sdf import se3
from sdf.bounds import Checked, Count, Law, NotNegative, ShareAbove0
from sdf.check import check_finite, check_shape
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.vision.camera import pixel_rays
from sensors.vision.images import Unit, depth_metres, known, opencv


@dataclass(frozen=True)
class BubbleSettings(Checked):
    """Settings of the contact patch of a bubble's image (RUMI, V.C).

    Attributes:
        contact_m: deformation beyond which the membrane may touch something.
        top: part of the membrane, the most deformed, that counts as touching.
        mean_px: side of the square that deformations are averaged over; odd, 1 for none.
        still_m: deformation below which the membrane is at rest: there is nothing in front of it.
        free_inset_m: free points lie this far inside of the resting membrane, beyond `still_m`.
        free_stride_px: pixels between free points.
        patch_stride_px: pixels between points of the patch.
        unit: of the depth image (`images.depth_metres`).
    """

    contact_m: float = 0.004
    top: ShareAbove0 = 0.1
    mean_px: Annotated[int, Ge(1), Law("to be odd", lambda count: count % 2 == 1)] = 5
    still_m: NotNegative = 0.001
    free_inset_m: float = 0.001
    free_stride_px: Count = 4
    patch_stride_px: Count = 1
    unit: Unit | float = "auto"

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        super().__post_init__()
        if not self.still_m < self.contact_m:
            raise ValueError(f"Expected still_m below contact_m, got {self.still_m} and {self.contact_m}")


@dataclass(frozen=True)
class Bubble:
    """A bubble as it is at rest.

    Attributes:
        rest: (H, W), metres, depth of the membrane at rest from the camera inside; 0 where the camera does not see it.
        rays: (H, W, 3), from the camera through each pixel, z 1.
        along: (H, W), metres that the membrane moves inward, along its own normal, for a metre less of depth.
        tool_T_camera: (4, 4), z forward, x right, y down.
    """

    rest: Float[Tensor, "H W"]
    rays: Float[Tensor, "H W 3"]
    along: Float[Tensor, "H W"]
    tool_T_camera: Float[Tensor, "4 4"]

    @classmethod
    def of(
        cls,
        rest_depth: np.ndarray | Tensor,
        intrinsics: Float[Tensor, "3 3"],
        tool_T_camera: Float[Tensor, "4 4"],
        *,
        unit: Unit | float = "auto",
        membrane: Bool[Tensor, "H W"] | None = None,
    ) -> Self:
        """A bubble from the image of its membrane at rest; the mean of some frames has less noise.

        Args:
            rest_depth: (H, W), taken while nothing touches, in `unit`.
            intrinsics: (3, 3), for pixel centres at whole numbers.
            tool_T_camera: (4, 4).
            unit: of the image.
            membrane: (H, W), the pixels that show it; None for all that are known.

        Raises:
            ValueError: no image, a membrane a metre away, which is another unit's, or a pose that is not finite.
        """
        check_shape("intrinsics", intrinsics, "(3, 3)", last=(3, 3))
        check_shape("tool_T_camera", tool_T_camera, "(4, 4)", last=(4, 4))
        check_finite("tool_T_camera", tool_T_camera)
        rest = _membrane(rest_depth, unit)
        seen = known(rest) if membrane is None else known(rest) & membrane
        rest = torch.where(seen, rest, torch.zeros_like(rest))
        rays = pixel_rays(rest.shape[0], rest.shape[1], intrinsics.to(rest))
        return cls(rest, rays, _inward(rest, rays, seen), tool_T_camera.to(rest))


class BubblePatch(NamedTuple):
    """Contact patch of a bubble's image.

    Attributes:
        observation: world points: surface ones of the patch, then free ones inside of the membrane at rest.
        deformation: (H, W), metres inward, averaged; 0 where the membrane is not seen.
        contact: (H, W), pixels of the patch.
    """

    observation: Observation
    deformation: Float[Tensor, "H W"]
    contact: Bool[Tensor, "H W"]


def bubble_patch(
    bubble: Bubble,
    depth: np.ndarray | Tensor,
    world_T_tool: Float[Tensor, "4 4"],
    settings: BubbleSettings | None = None,
) -> BubblePatch:
    """Contact patch of a soft bubble, and free points before its membrane, by its deformation.

    A pixel touches where the membrane has moved in by more than `contact_m` and by no less than the share `top` of the
    membrane that moved most (RUMI, V.C). The deformation is along the membrane's own normal at rest: along the line of
    sight, one at a slant would count for more than it is.

    Args:
        bubble: at rest.
        depth: (H, W), as the camera inside gives it now.
        world_T_tool: (4, 4), where the tool was when the image was taken.
        settings: of the contact threshold and the spacing of points.

    Raises:
        ValueError: an image of another size than that at rest, or in another unit, or a pose that is not finite.
    """
    settings = settings or BubbleSettings()
    check_shape("world_T_tool", world_T_tool, "(4, 4)", last=(4, 4))
    check_finite("world_T_tool", world_T_tool)
    now = _membrane(depth, settings.unit)
    if now.shape != bubble.rest.shape:
        raise ValueError(
            f"Expected an image of the size of that at rest, {tuple(bubble.rest.shape)}, got {tuple(now.shape)}"
        )
    seen = known(now) & (bubble.rest > 0)
    lost = _averaged(torch.where(seen, bubble.rest - now, torch.zeros_like(now)), seen, settings.mean_px)
    deformation = lost * bubble.along
    values = deformation[seen]
    contact = torch.zeros_like(seen)
    if len(values):
        least = float(torch.quantile(values, 1.0 - settings.top, interpolation="lower"))
        contact = seen & (deformation > settings.contact_m) & (deformation >= least)
    world_T_camera = world_T_tool.to(now) @ bubble.tool_T_camera
    patch = contact & _grid(now.shape, settings.patch_stride_px)
    surface = bubble.rays[patch] * (bubble.rest - lost)[patch][:, None]
    free = seen & (deformation.abs() < settings.still_m) & _grid(now.shape, settings.free_stride_px)
    inset = (settings.still_m + settings.free_inset_m) / bubble.along[free]
    clear = bubble.rays[free] * (bubble.rest[free] - inset)[:, None]
    observation = concatenate(
        [
            Observation.of(se3.apply(world_T_camera, surface), Semantics.SURFACE),
            Observation.of(se3.apply(world_T_camera, clear), Semantics.FREE),
        ]
    )
    return BubblePatch(observation, deformation, contact)


def _membrane(depth: np.ndarray | Tensor, unit: Unit | float) -> Float[Tensor, "H W"]:
    """The image in metres; refused where it can only be in another unit."""
    metres = depth_metres(depth, unit)
    some = metres[:: max(1, len(metres) // 64)]
    some = some[known(some)]
    if len(some) and float(some.median()) > _FARTHEST_M:
        raise ValueError(
            f"Expected a bubble's membrane within {_FARTHEST_M:g} m of the camera inside it, got a median depth of "
            f"{float(some.median()):.3g} m: give unit 'mm', or the metres of one unit of the image"
        )
    return metres


_FARTHEST_M = 1.0

_LEAST_ALONG = math.cos(math.radians(80.0))
"""A membrane seen at more of a slant than this is taken to be at this slant: its normal is not known so well."""


def _inward(rest: Tensor, rays: Tensor, seen: Tensor) -> Float[Tensor, "H W"]:
    """Metres along the membrane's normal for a metre of depth: the ray's part along the normal."""
    # the smoothed shape at rest: its normals must not have its noise
    smooth = _averaged(torch.where(seen, rest, torch.zeros_like(rest)), seen, 5)
    points = rays * torch.where(seen, smooth, torch.zeros_like(rest))[..., None]
    down, right = torch.zeros_like(points), torch.zeros_like(points)
    rows = seen[2:] & seen[:-2]
    down[1:-1][rows] = (points[2:] - points[:-2])[rows]
    columns = seen[:, 2:] & seen[:, :-2]
    right[:, 1:-1][columns] = (points[:, 2:] - points[:, :-2])[columns]
    normal = torch.linalg.cross(right, down)
    length = normal.norm(dim=-1)
    along = (normal * rays).sum(-1).abs() / length.clamp_min(1e-12)
    # at the border, where no normal is known, the line of sight stands for it
    return torch.where(length > 1e-12, along, rays.norm(dim=-1)).clamp_min(_LEAST_ALONG)


def _averaged(values: Tensor, seen: Tensor, pixels: int) -> Float[Tensor, "H W"]:
    """Mean over squares of pixels, of those that are seen."""
    if pixels == 1:
        return values
    cv2 = opencv()
    box = (pixels, pixels)
    total = cv2.blur(np.ascontiguousarray(values.numpy()), box, borderType=cv2.BORDER_CONSTANT)
    weight = cv2.blur(seen.float().numpy(), box, borderType=cv2.BORDER_CONSTANT)
    mean = torch.from_numpy(total / np.maximum(weight, 1e-6))
    return torch.where(seen, mean, torch.zeros_like(mean))


def _grid(shape: torch.Size, stride: int) -> Bool[Tensor, "H W"]:
    grid = torch.zeros(shape, dtype=torch.bool)
    grid[::stride, ::stride] = True
    return grid
