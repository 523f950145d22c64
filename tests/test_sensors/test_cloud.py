"""From point clouds of scenes in closed form to surface and free points."""

import pytest
import torch

from scripts.bench.known_scenes import SCENES, scene_view
from sensors.semantics import Semantics
from sensors.vision.camera import pixel_points
from sensors.vision.cloud import cloud_observation, organised_intrinsics, pinhole_about
from sensors.vision.view import Image, KnownScene, ViewSettings, view_observation
from tests.fixtures.views import BOUNDS, HEIGHT, WIDTH, parts, seeded

pytest.importorskip("cv2")


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    return scene_view(request.param, HEIGHT, WIDTH)


def scattered(scene, seed=0):
    """The image's points in no order, camera frame, and which are the object's."""
    there = torch.isfinite(scene.depth)
    points = pixel_points(scene.depth.float(), there, scene.intrinsics)
    order = torch.randperm(len(points), generator=seeded(seed))
    return points[order], scene.mask[there][order]


def test_an_organised_cloud_is_its_image(scene):
    depth = scene.depth.float()
    points = torch.full((HEIGHT, WIDTH, 3), torch.nan)
    there = torch.isfinite(depth)
    points[there] = pixel_points(depth, there, scene.intrinsics)
    assert torch.allclose(organised_intrinsics(points), scene.intrinsics, atol=0.01)
    known = KnownScene(bounds=BOUNDS)
    found = cloud_observation(points, scene.world_T_camera, None, known, mask=scene.mask)
    image = Image(depth.nan_to_num(posinf=0.0), scene.intrinsics, mask=scene.mask)
    expected = view_observation(image, scene.world_T_camera, None, known)
    assert torch.equal(found.surface, expected.surface)
    surface, free = parts(found.observation)
    assert torch.allclose(surface, parts(expected.observation)[0], atol=1e-4)
    assert len(free) == pytest.approx(int(expected.observation.of_class(Semantics.FREE).sum()), rel=0.01)


def test_clouds_persist_in_one_camera():
    scene = scene_view("box", 120, 160)
    points, _ = scattered(scene)
    pinhole = pinhole_about(points)
    memory, counts = None, []
    for frame in range(8):
        points, mask = scattered(scene, seed=frame)
        view = cloud_observation(
            points,
            scene.world_T_camera,
            ViewSettings(persist_s=0.4),
            pinhole=pinhole,
            mask=mask,
            stamp=0.1 * frame,
            memory=memory,
        )
        memory = view.memory
        counts.append(len(view.observation))
    assert counts[:4] == [0] * 4 and min(counts[4:]) > 0.5 * int(scene.mask.sum())


def test_the_camera_about_a_cloud_has_points_in_its_pixels():
    points, _ = scattered(scene_view("box", HEIGHT, WIDTH))
    pinhole = pinhole_about(points)
    flat = points @ pinhole.intrinsics.mT
    pixel = (flat[:, :2] / flat[:, 2:]).round()
    assert float(pixel.min()) >= 0 and float(pixel[:, 0].max()) < pinhole.width
    assert float(pixel[:, 1].max()) < pinhole.height
    a_pixel = len(points) / len(torch.unique(pixel, dim=0))
    assert 2.5 < a_pixel < 6.5


def test_what_is_no_cloud_of_a_camera_is_refused():
    with pytest.raises(ValueError, match="z points forward"):
        cloud_observation(-torch.rand(50, 3), torch.eye(4), mask=torch.ones(50, dtype=torch.bool))
    aside = torch.tensor([[1.0, 0.0, 0.1], [-1.0, 0.3, 0.2]])
    with pytest.raises(ValueError, match="within 75 degrees"):
        cloud_observation(aside, torch.eye(4), mask=torch.ones(2, dtype=torch.bool))
    random = torch.rand(20, 30, 3, generator=seeded())
    with pytest.raises(ValueError, match="pixels off"):
        cloud_observation(random, torch.eye(4), mask=torch.ones(20, 30, dtype=torch.bool))
    with pytest.raises(ValueError, match="at least 10"):
        cloud_observation(torch.full((4, 4, 3), torch.nan), torch.eye(4), mask=torch.ones(4, 4, dtype=torch.bool))
