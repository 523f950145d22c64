"""What holds for every sensor that gives points: cameras, views, clouds and bubbles of scenes in closed form."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from scripts.bench.known_scenes import SCENES, pressed_bubble, scene_view, with_noise
from sdf import se3
from sensors.observation import Observation
from sensors.touch.bubble import Bubble, BubbleSettings, bubble_patch
from sensors.vision.camera import depth_observation, pixel_points
from sensors.vision.cloud import cloud_observation
from sensors.vision.view import Image, KnownScene, view_observation
from tests.fixtures.views import BOUNDS, WAYS, parts, seeded

pytest.importorskip("cv2")


Observe = Callable[..., Observation]
"""Of a scene, its depth, and where its camera is thought to be: surface and free points; free ones only in bounds."""


def camera(scene, depth: Tensor, world_T_camera: Tensor, bounds: Tensor | None) -> Observation:
    return depth_observation(depth.float(), scene.intrinsics, world_T_camera, scene.mask, bounds=bounds)


def view(way: str) -> Observe:
    def observe(scene, depth: Tensor, world_T_camera: Tensor, bounds: Tensor | None) -> Observation:
        image = Image(depth, scene.intrinsics, scene.color, scene.mask)
        known = KnownScene(bounds=bounds)
        return view_observation(image, world_T_camera, WAYS[way], known, generator=seeded()).observation

    return observe


def cloud(way: str, frame: str) -> Observe:
    def observe(scene, depth: Tensor, world_T_camera: Tensor, bounds: Tensor | None) -> Observation:
        there = torch.isfinite(depth)
        points = pixel_points(depth.float(), there, scene.intrinsics)
        order = torch.randperm(len(points), generator=seeded())
        points, mask, colors = points[order], scene.mask[there][order], scene.color[there][order]
        return cloud_observation(
            points if frame == "camera" else se3.apply(world_T_camera, points), world_T_camera, WAYS[way],
            KnownScene(bounds=bounds), frame=frame, mask=mask, colors=colors, generator=seeded(),
        ).observation  # fmt: skip

    return observe


def bubble(scene, depth: Tensor, world_T_camera: Tensor, bounds: Tensor | None) -> Observation:
    settings = BubbleSettings(mean_px=1 if depth is scene.depth else BubbleSettings().mean_px)
    return bubble_patch(Bubble.of(scene.rest, scene.intrinsics, se3.identity()), depth, world_T_camera, settings)[0]


@dataclass(frozen=True)
class Member:
    """A sensor, the share of the object's pixels and the free points that it gives, and whether it filters noise."""

    observe: Observe
    surface: float = 0.5
    free: int = 3000
    filters: bool = True


MEMBERS = {
    "camera": Member(camera, 0.9, filters=False),
    **{f"view by {way}": Member(view(way), 0.6, 5000) for way in WAYS},
    **{f"cloud by {way}": Member(cloud(way, "camera")) for way in WAYS},
    "cloud in the world": Member(cloud("mask", "world")),
    "bubble": Member(bubble, 0.0, 200),
}


@pytest.fixture(scope="module", params=SCENES)
def scenes(request):
    return {"bubble": pressed_bubble(request.param), "camera": scene_view(request.param, 240, 320)}


@pytest.fixture(params=MEMBERS)
def case(request, scenes):
    """A member, its scene, and where its camera is."""
    scene = scenes["bubble" if request.param == "bubble" else "camera"]
    return MEMBERS[request.param], scene, getattr(scene, "world_T_camera", se3.identity())


def pixels(scene) -> int:
    return int(scene.mask.sum()) if hasattr(scene, "mask") else 100


def test_surface_on_and_free_outside_the_object(case):
    member, scene, pose = case
    surface, free = parts(member.observe(scene, scene.depth, pose, BOUNDS))
    assert len(surface) > max(50, member.surface * pixels(scene)) and len(free) > member.free
    assert float(scene.distance(surface).abs().max()) < 2e-5
    assert float(scene.distance(free).min()) > 0


def test_noise_lost_pixels_and_mixed_ones(case):
    """Of two millimetres, of one in a bubble: less than 1 % of the points are three times as far off."""
    member, scene, pose = case
    if not member.filters:
        pytest.skip("takes depth as it is")
    noise, mixed = (0.001, False) if pose.equal(se3.identity()) else (0.002, True)
    depth = with_noise(scene.depth, noise, lost=0.01, mixed=mixed, generator=torch.Generator().manual_seed(1))
    surface, free = parts(member.observe(scene, depth, pose, BOUNDS))
    assert len(surface) > max(50, 0.3 * pixels(scene) * (member.surface > 0)) and len(free) > 0.4 * member.free
    assert float((scene.distance(surface).abs() > 3 * noise).double().mean()) < 0.01
    assert float(scene.distance(free).min()) > 0


def test_points_move_with_the_world(case):
    member, scene, pose = case
    change = se3.exp(torch.tensor([0.1, -0.2, 0.3, 0.2, -0.4, 0.5]))
    here = member.observe(scene, scene.depth, pose, None)
    there = member.observe(scene, scene.depth, change @ pose, None)
    assert torch.equal(there.semantics, here.semantics)
    torch.testing.assert_close(there.points, se3.apply(change, here.points), atol=1e-5, rtol=0)
