"""Filters of a depth image: edges, grazing views and neighbours of unknown pixels."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.bounds import Checked, CountOr0, Positive
from sensors.vision.images import known, opencv


@dataclass(frozen=True)
class EdgeSettings(Checked):
    """Settings of the edge filter of a depth image.

    Attributes:
        jump_m: depths of neighbours that differ by more, beyond what a slanted surface explains, are an edge. Seven
            standard deviations of the depth's noise are rarely reached by noise alone.
        grazing_rad: angle between a surface's normal and the line of sight beyond which it counts as an edge.
        margin_px: pixels about an edge that go with it: there a camera mixes the two depths.
        rim_px: pixels about unknown ones that go with them.
    """

    jump_m: Positive = 0.015
    grazing_rad: Annotated[float, Interval(gt=0.0, lt=0.5 * math.pi)] = math.radians(75.0)
    margin_px: CountOr0 = 1
    rim_px: CountOr0 = 1


def reliable(
    depth: Float[Tensor, "H W"], intrinsics: Float[Tensor, "3 3"], settings: EdgeSettings | None = None
) -> Bool[Tensor, "H W"]:
    """Where a depth image shows a surface away from edges, from grazing views and from unknown pixels.

    A surface whose normal is `a` off the line of sight changes its depth by about z tan(a) / f a pixel; the range of
    depths in 3 x 3 pixels is compared with twice that, and `jump_m`.

    Args:
        depth: (H, W), metres; 0 where not known.
        intrinsics: (3, 3).
        settings: how strict.
    """
    settings = settings or EdgeSettings()
    cv2 = opencv()
    image = np.ascontiguousarray(depth.float().numpy())
    there = known(depth).numpy()
    box = np.ones((3, 3), np.uint8)
    # unknown pixels say nothing of an edge: they are neither the least nor the largest
    positive = image > 0
    least = cv2.erode(np.where(positive, image, np.float32(np.inf)), box)
    largest = cv2.dilate(np.where(positive, image, np.float32(0.0)), box)
    slope = 2.0 * math.tan(settings.grazing_rad) / float(min(intrinsics[0, 0], intrinsics[1, 1]))
    with np.errstate(over="ignore"):  # where nothing is known nor met
        least *= np.float32(1.0 + slope)
    least += np.float32(settings.jump_m)
    bad = (largest > least).view(np.uint8)
    # the range reaches one pixel beyond an edge by itself
    if settings.margin_px > 1:
        bad = cv2.dilate(bad, _square(settings.margin_px - 1))
    lost = (~there).view(np.uint8)
    if settings.rim_px:
        lost = cv2.dilate(lost, _square(settings.rim_px))
    return torch.from_numpy((bad == 0) & (lost == 0) & there)


def nearest_about(depth: Float[Tensor, "H W"], pixels: int) -> Float[Tensor, "H W"]:
    """The least depth within some pixels of each, 0 where one of them is not known: what is surely seen past."""
    if pixels < 1:
        return depth
    cv2 = opencv()
    image = np.ascontiguousarray(depth.float().numpy())
    image = np.where(image > 0, image, np.float32(0.0))  # of NaN no comparison holds
    return torch.from_numpy(cv2.erode(image, _square(pixels), borderType=cv2.BORDER_REPLICATE))


def _square(pixels: int) -> np.ndarray:
    return np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
