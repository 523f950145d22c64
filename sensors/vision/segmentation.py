"""Segmentation of the object in an image or a cloud: by colour, or as what stands on a plane."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sensors.vision.images import opencv

Range = tuple[float, float]


class Plane(NamedTuple):
    """Points x with normal . x = offset.

    Attributes:
        normal: (3,), of length 1, to the side that is seen.
        offset: metres.
        share: of the points that lie on it.
    """

    normal: Float[Tensor, "3"]
    offset: float
    share: float

    def height(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Metres in front of the plane."""
        return points @ self.normal.to(points) - self.offset


def color_mask(
    color: np.ndarray | Tensor,
    hue_deg: Range,
    saturation: Range = (0.25, 1.0),
    value: Range = (0.15, 1.0),
    *,
    clean_px: int = 1,
) -> Bool[Tensor, "H W"]:
    """Pixels whose colour is in a range of hue, saturation and value.

    Args:
        color: (H, W, 3), bytes, red, green, blue.
        hue_deg: from, to, degrees; from above to below 360 where from > to (red: 345, 15).
        saturation: from, to, in [0, 1]; grey has none.
        value: from, to, in [0, 1]; black has none.
        clean_px: specks and holes up to so many pixels either way go.

    Raises:
        ValueError: no such image, or a range outside of its scale.
    """
    image = np.ascontiguousarray(color.numpy() if isinstance(color, Tensor) else color)
    if image.ndim != 3 or image.shape[-1] != 3 or image.dtype != np.uint8:
        raise ValueError(f"Expected color to be an image (H, W, 3) of bytes, got {image.shape} of {image.dtype}")
    for name, (low, high), end in (("saturation", saturation, 1.0), ("value", value, 1.0)):
        if not 0 <= low <= high <= end:
            raise ValueError(f"Expected {name} from, to with 0 <= from <= to <= 1, got {(low, high)}")
    if not all(0 <= angle <= 360 for angle in hue_deg):
        raise ValueError(f"Expected hue_deg from 0 to 360, got {hue_deg}")
    cv2 = opencv()
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)  # hue in steps of 2 degrees, the rest up to 255
    rest = [(math.floor(255 * low), math.ceil(255 * high)) for low, high in (saturation, value)]
    first, last = hue_deg
    hues = [(first, last)] if first <= last else [(first, 360.0), (0.0, last)]
    mask = np.zeros(image.shape[:2], np.uint8)
    for low, high in hues:
        bottom, top = (math.floor(0.5 * low), rest[0][0], rest[1][0]), (math.ceil(0.5 * high), rest[0][1], rest[1][1])
        mask |= cv2.inRange(hsv, np.array(bottom, np.float64), np.array(top, np.float64))
    if clean_px > 0:
        square = np.ones((2 * clean_px + 1,) * 2, np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, square)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square)
    return torch.from_numpy(mask > 0)


def fit_plane(
    points: Float[Tensor, "M 3"],
    *,
    tolerance_m: float = 0.006,
    tries: int = 200,
    sample: int = 2000,
    generator: torch.Generator,
) -> Plane:
    """The plane that most points lie on: random triples, then least squares on what agrees with the best.

    Args:
        points: (M, 3), metres, in the frame of the camera, which the plane's normal is towards.
        tolerance_m: a point this near the plane is on it.
        tries: triples.
        sample: points, drawn at random, that triples are judged by.
        generator: of the draws.

    Raises:
        ValueError: fewer than 3 points, or all on a line.
    """
    if len(points) < 3:
        raise ValueError(f"Expected at least 3 points to fit a plane to, got {len(points)}")
    few = points[torch.randint(len(points), (min(sample, 4 * len(points)),), generator=generator)]
    corners = few[torch.randint(len(few), (tries, 3), generator=generator)]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = normals.norm(dim=-1)
    good = length > 1e-9
    if not bool(good.any()):
        raise ValueError("Expected points that span a plane, got points on one line")
    normals, corners = normals[good] / length[good, None], corners[good]
    away = (few @ normals.mT - (normals * corners[:, 0]).sum(-1)).abs()
    best = int((away < tolerance_m).sum(0).argmax())
    normal, offset = normals[best], (normals[best] * corners[best, 0]).sum()
    for _ in range(3):
        on = (few @ normal - offset).abs() < tolerance_m
        own = few[on]
        center = own.mean(0)
        normal = torch.linalg.eigh((own - center).mT @ (own - center))[1][:, 0]
        offset = normal @ center
    if float(offset) > 0:
        normal, offset = -normal, -offset
    return Plane(normal, float(offset), float(((few @ normal - offset).abs() < tolerance_m).to(points.dtype).mean()))


def cluster_mask(
    candidates: Bool[Tensor, "H W"], *, pixel: tuple[float, float] | None = None, least_px: int = 50
) -> Bool[Tensor, "H W"]:
    """The largest connected patch of an image, or the one nearest to a pixel; none where all are too small.

    Args:
        candidates: (H, W), with edges left out, so that what lies one behind the other does not hang together.
        pixel: (row, column) near which it is; None for the largest.
        least_px: pixels that a patch must have.
    """
    count, labels, stats, centers = opencv().connectedComponentsWithStats(candidates.numpy().view(np.uint8), None, 8)
    sizes = stats[1:, 4]
    if count < 2 or sizes.max() < least_px:
        return torch.zeros_like(candidates)
    if pixel is None:
        chosen = 1 + int(sizes.argmax())
    else:
        away = np.hypot(centers[1:, 1] - pixel[0], centers[1:, 0] - pixel[1])
        chosen = 1 + int(np.where(sizes >= least_px, away, np.inf).argmin())
    return torch.from_numpy(labels == chosen)
