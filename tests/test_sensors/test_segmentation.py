"""Which part of an image or a cloud is the object."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sensors.vision.segmentation import Plane, cluster_mask, color_mask, fit_plane
from tests.fixtures.views import seeded

pytest.importorskip("cv2")


def painted(*colors):
    """A patch of 10 x 10 pixels of each colour in a row, on grey."""
    image = torch.full((14, 14 * len(colors), 3), 128, dtype=torch.uint8)
    for index, color in enumerate(colors):
        image[2:12, 14 * index + 2 : 14 * index + 12] = torch.tensor(color, dtype=torch.uint8)
    return image


def which(mask):
    return [bool(mask[2:12, 14 * i + 2 : 14 * i + 12].all()) for i in range(mask.shape[1] // 14)]


def test_colours_are_told_apart_and_grey_has_none():
    image = painted((220, 30, 30), (30, 200, 40), (20, 40, 220), (230, 30, 60), (250, 250, 250), (30, 5, 5))
    assert which(color_mask(image, (100.0, 140.0))) == [False, True, False, False, False, False]
    assert which(color_mask(image, (345.0, 15.0))) == [True, False, False, True, False, False]  # red goes round
    assert which(color_mask(image, (0.0, 360.0))) == [True, True, True, True, False, False]  # the last is too dark
    assert which(color_mask(image, (0.0, 360.0), (0.0, 1.0), (0.0, 1.0))) == [True] * 6
    grey = color_mask(image, (0.0, 360.0))
    assert not bool(grey[0].any()) and not bool(grey[:, 0].any())


def test_specks_and_holes_go():
    image = painted((20, 40, 220))
    image[6, 6] = 128
    image[0, 0] = torch.tensor([20, 40, 220], dtype=torch.uint8)
    mask = color_mask(image, (200.0, 260.0))
    assert bool(mask[6, 6]) and not bool(mask[0, 0])
    raw = color_mask(image, (200.0, 260.0), clean_px=0)
    assert not bool(raw[6, 6]) and bool(raw[0, 0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"color": np.zeros((4, 4, 3)), "hue_deg": (0.0, 10.0)}, "bytes"),
        ({"color": np.zeros((4, 4), np.uint8), "hue_deg": (0.0, 10.0)}, "H, W, 3"),
        ({"color": np.zeros((4, 4, 3), np.uint8), "hue_deg": (0.0, 400.0)}, "360"),
        ({"color": np.zeros((4, 4, 3), np.uint8), "hue_deg": (0.0, 10.0), "value": (0.5, 0.2)}, "value"),
        ({"color": np.zeros((4, 4, 3), np.uint8), "hue_deg": (0.0, 10.0), "saturation": (0.0, 255.0)}, "saturation"),
    ],
)
def test_wrong_colours_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        color_mask(**given)


@given(st.integers(0, 1000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_the_plane_is_found_among_others_and_noise(seed, a, b):
    """A third of the points stands off it; the normal points to the eye."""
    random = seeded(seed)
    flat = torch.rand(900, 2, generator=random) - 0.5
    normal = torch.nn.functional.normalize(torch.tensor([a, b, -1.0]), dim=0)
    height = (0.8 + normal[0] * flat[:, 0] + normal[1] * flat[:, 1]) / -normal[2]
    points = torch.cat((flat, height[:, None]), -1)
    points = points + 0.001 * torch.randn(900, 3, generator=random)
    points[:300] += normal * (0.02 + 0.2 * torch.rand(300, 1, generator=random))
    plane = fit_plane(points, generator=random)
    assert float(plane.normal @ normal) > 0.999 and plane.offset == pytest.approx(-0.8, abs=0.005)
    assert plane.share == pytest.approx(0.667, abs=0.06)
    assert float(plane.height(points[300:]).abs().mean()) < 0.003


def test_planes_need_points():
    with pytest.raises(ValueError, match="at least 3"):
        fit_plane(torch.zeros(2, 3), generator=seeded())
    with pytest.raises(ValueError, match="one line"):
        fit_plane(torch.arange(30.0)[:, None] * torch.ones(1, 3), generator=seeded())
    assert Plane(torch.tensor([0.0, 0.0, 1.0]), 0.2, 1.0).height(torch.tensor([0.0, 5.0, 0.5])) == pytest.approx(0.3)


def test_the_largest_patch_or_the_one_asked_for():
    candidates = torch.zeros(40, 60, dtype=torch.bool)
    candidates[2:12, 2:12] = True
    candidates[20:38, 20:38] = True
    candidates[5, 50] = True
    assert cluster_mask(candidates).sum() == 18 * 18
    near = cluster_mask(candidates, pixel=(5.0, 20.0))
    assert near.sum() == 100 and bool(near[5, 5])  # a speck is too small
    assert cluster_mask(candidates, pixel=(5.0, 50.0), least_px=1).sum() == 1
    assert not bool(cluster_mask(candidates, least_px=1000).any())
    assert not bool(cluster_mask(torch.zeros(4, 4, dtype=torch.bool)).any())
