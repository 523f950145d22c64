"""Soft bubbles that things in closed form are pressed into."""

import math
from dataclasses import replace

import pytest
import torch

from scripts.bench.known_scenes import SCENES, pressed_bubble
from sdf import se3
from sensors.touch.bubble import Bubble, BubbleSettings, bubble_patch
from tests.fixtures.views import parts

pytest.importorskip("cv2")


@pytest.fixture(scope="module", params=SCENES)
def pressed(request):
    return pressed_bubble(request.param)


def bubble_of(pressed):
    return Bubble.of(pressed.rest, pressed.intrinsics, se3.identity())


def test_the_mean_filter_keeps_the_patch_within_a_millimetre(pressed):
    surface, free = parts(bubble_patch(bubble_of(pressed), pressed.depth, se3.identity()).observation)
    assert float(pressed.distance(surface).abs().max()) < 0.001
    assert float(pressed.distance(free).min()) > 0


def test_contact_is_deep_and_in_the_top_tenth(pressed):
    """The definition, written out; without the mean filter."""
    patch = bubble_patch(bubble_of(pressed), pressed.depth, se3.identity(), BubbleSettings(mean_px=1))
    deepest = sorted(patch.deformation.reshape(-1).tolist(), reverse=True)
    least = deepest[math.ceil(0.1 * len(deepest)) - 1]
    expected = (patch.deformation > 0.004) & (patch.deformation >= least - 1e-9)
    assert torch.equal(patch.contact, expected)
    assert 0 < int(patch.contact.sum()) <= 0.11 * patch.contact.numel()
    wide = bubble_patch(bubble_of(pressed), pressed.depth, se3.identity(), BubbleSettings(mean_px=1, top=1.0))
    assert torch.equal(wide.contact, wide.deformation > 0.004)


def test_deformation_is_along_the_normal():
    """A ball of membrane that shrinks by 3 mm is pushed in by 3 mm everywhere, also where it is seen at a slant."""
    pressed = pressed_bubble("plane")
    rays = torch.stack(torch.meshgrid(torch.arange(171.0), torch.arange(224.0), indexing="ij"))
    rays = torch.stack(
        (
            (rays[1] - pressed.intrinsics[0, 2]) / pressed.intrinsics[0, 0],
            (rays[0] - pressed.intrinsics[1, 2]) / pressed.intrinsics[1, 1],
            torch.ones(171, 224),
        ),
        -1,
    ).double()
    center = torch.tensor([0.0, 0.0, 0.025]).double()
    a, b = (rays * rays).sum(-1), rays @ center
    small = (b + (b * b - a * (center @ center - 0.047**2)).sqrt()) / a
    patch = bubble_patch(bubble_of(pressed), small, se3.identity(), BubbleSettings(mean_px=1, contact_m=0.0025))
    inner = patch.deformation[3:-3, 3:-3]
    assert float((inner - 0.003).abs().max()) < 0.0002


def test_at_rest_nothing_is_touched_and_all_is_free():
    pressed = pressed_bubble("plane")
    patch = bubble_patch(bubble_of(pressed), pressed.rest, se3.identity())
    assert not bool(patch.contact.any()) and float(patch.deformation.abs().max()) == 0
    surface, free = parts(patch.observation)
    assert len(surface) == 0 and len(free) == len(range(0, 171, 4)) * len(range(0, 224, 4))
    # inside of the membrane by 2 mm
    gap = 0.05 - (free - torch.tensor([0.0, 0.0, 0.025])).norm(dim=-1)
    assert float(gap.min()) > 0.0015 and float(gap.max()) < 0.0025


def test_points_go_with_the_tool(generator):
    world_T_tool = se3.exp(torch.randn(6, generator=generator))
    tool_T_camera = se3.exp(torch.randn(6, generator=generator))
    pressed = pressed_bubble("sphere", height=40, width=50)
    bubble = Bubble.of(pressed.rest, pressed.intrinsics, tool_T_camera)
    here = bubble_patch(replace(bubble, tool_T_camera=se3.identity()), pressed.depth, se3.identity()).observation
    there = bubble_patch(bubble, pressed.depth, world_T_tool).observation
    expected = se3.apply(world_T_tool @ tool_T_camera, here.points)
    assert torch.allclose(there.points, expected, atol=1e-5) and torch.equal(there.semantics, here.semantics)


def test_units_unknown_pixels_and_nothing_seen():
    pressed = pressed_bubble("box")
    bubble = bubble_of(pressed)
    millimetres = (1e3 * pressed.depth).round().to(torch.int32)
    surface, _ = parts(bubble_patch(bubble, millimetres, se3.identity()).observation)
    assert float(pressed.distance(surface).abs().max()) < 0.002
    holed = pressed.depth.clone()
    holed[60:110, 80:140] = 0.0
    patch = bubble_patch(bubble, holed, se3.identity())
    assert not bool(patch.contact[60:110, 80:140].any()) and not bool(patch.deformation[60:110, 80:140].any())
    blind = bubble_patch(bubble, torch.zeros_like(pressed.depth), se3.identity())
    assert len(blind.observation) == 0 and not bool(blind.contact.any())


def test_millimetres_without_their_unit_are_refused():
    """A membrane of 40, which no guard for cameras across a room refuses."""
    pressed = pressed_bubble("box", height=40, width=50)
    near, eye = 1e3 * pressed.rest * (40.0 / float(1e3 * pressed.rest.max())), se3.identity()
    assert float(near.max()) == pytest.approx(40.0)
    with pytest.raises(ValueError, match="unit 'mm'"):
        Bubble.of(near, pressed.intrinsics, eye)
    right = Bubble.of(near, pressed.intrinsics, eye, unit="mm")
    assert float(right.rest.max()) == pytest.approx(0.04)
    with pytest.raises(ValueError, match="unit 'mm'"):
        bubble_patch(right, near, eye)
    assert not bool(bubble_patch(right, near, eye, BubbleSettings(unit="mm")).contact.any())


def test_wrong_images_are_refused():
    pressed = pressed_bubble("box", height=40, width=50)
    with pytest.raises(ValueError, match="size of that at rest"):
        bubble_patch(bubble_of(pressed), torch.zeros(10, 10), se3.identity())
    with pytest.raises(ValueError, match="finite"):
        bubble_patch(bubble_of(pressed), pressed.depth, torch.full((4, 4), math.nan))
