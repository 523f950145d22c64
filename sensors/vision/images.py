"""Raw depth images: units, unknown pixels, lens distortion. OpenCV is loaded at its first use."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sdf.extras import optional

Unit = Literal["auto", "m", "mm"]
UNITS: tuple[str, ...] = ("auto", "m", "mm")

_NO_METRES = 50.0  # a median depth beyond it is in other units


def opencv() -> Any:  # noqa: ANN401  (a module without types)
    """The module cv2.

    Raises:
        ModuleNotFoundError: OpenCV is not installed; with what to install.
    """
    return optional("cv2", "An image")


def depth_metres(
    depth: np.ndarray | Tensor, unit: Unit | float = "auto", *, near_m: float = 0.0, far_m: float = math.inf
) -> Float[Tensor, "H W"]:
    """A camera's depth image in metres, what it does not know as 0.

    Whole numbers hold 0 where nothing is known (and their largest value where the camera overflows), floating ones 0, a
    negative number or NaN. Infinity says that nothing was met as far as the camera sees; it stays.

    Args:
        depth: (H, W), as it came.
        unit: "m", "mm", metres of one unit, or "auto": millimetres for whole numbers, metres for floating ones.
        near_m: what is nearer is not known.
        far_m: what is farther, but for infinity, is not known.

    Returns:
        (H, W), float32.

    Raises:
        ValueError: no image of depth, an unknown unit, or metres that can only be millimetres.
    """
    values = depth.detach().cpu().numpy() if isinstance(depth, Tensor) else np.asarray(depth)
    if values.ndim == 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise ValueError(f"Expected depth to be an image (H, W) of numbers, got {values.shape} of {values.dtype}")
    if values.size == 0:
        raise ValueError(f"Expected depth to be an image (H, W) with pixels, got {values.shape}")
    whole = values.dtype.kind in "ui"
    if isinstance(unit, str):
        if unit not in UNITS:
            raise ValueError(f"Expected unit to be one of {', '.join(UNITS)} or metres a unit, got {unit!r}")
        scale = 0.001 if unit == "mm" or (unit == "auto" and whole) else 1.0
    else:
        scale = float(unit)
        if not (scale > 0 and math.isfinite(scale)):
            raise ValueError(f"Expected metres of one unit above 0, got {unit}")
    found = values.astype(np.float32)
    found *= np.float32(scale)
    # of NaN no comparison holds
    lost = (values <= 0) | (values == np.iinfo(values.dtype).max) if whole else ~(values > 0)
    if near_m > 0:
        lost |= found < near_m
    if math.isfinite(far_m):
        lost |= (found > far_m) & np.isfinite(found)
    found[lost] = 0.0
    if scale == 1.0:
        some = found[:: max(1, len(found) // 64)]
        some = some[(some > 0) & np.isfinite(some)]
        if len(some) and float(np.median(some)) > _NO_METRES:
            raise ValueError(
                f"Expected depth in metres, got a median of {float(np.median(some)):.0f}: give unit 'mm' if that is it"
            )
    return torch.from_numpy(found)


def known(depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Where a depth image has a surface: neither unknown nor infinite."""
    return (depth > 0) & torch.isfinite(depth)


def undistorted(
    depth: Float[Tensor, "H W"], intrinsics: Float[Tensor, "3 3"], distortion: Sequence[float]
) -> Float[Tensor, "H W"]:
    """The image that a camera without lens distortion would have taken with the same intrinsics.

    Each pixel takes the nearest one of the camera's: depths on either side of an edge are not mixed. Pixels that the
    camera did not see are 0.

    Args:
        depth: (H, W), metres.
        intrinsics: (3, 3).
        distortion: OpenCV's coefficients k1, k2, p1, p2 and on.
    """
    if not any(distortion):
        return depth
    cv2 = opencv()
    matrix = intrinsics.double().numpy()
    size = (depth.shape[1], depth.shape[0])
    lens = np.asarray(distortion, dtype=np.float64)
    columns, rows = cv2.initUndistortRectifyMap(matrix, lens, None, matrix, size, cv2.CV_32FC1)
    image = np.ascontiguousarray(depth.float().numpy())
    return torch.from_numpy(cv2.remap(image, columns, rows, cv2.INTER_NEAREST, borderValue=0.0))
