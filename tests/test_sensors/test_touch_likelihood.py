"""A touch's point and normal as evidence."""

import math

import pytest
import torch

from sdf import se3
from sdf.mesh.triangles import Triangles
from sensors.touch.touch_likelihood import (
    TouchNoise,
    box_face_log_likelihoods,
    box_log_likelihoods,
    touch_log_likelihoods,
)
from tests.fixtures import meshes

F64 = torch.float64
HALF = torch.tensor([0.03, 0.05, 0.08], dtype=F64)


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


@pytest.fixture
def box():
    return Triangles(meshes.box(HALF.tolist()).corners)


def scene(count=12, poses=7):
    generator = torch.Generator().manual_seed(0)
    pose = se3.exp(0.3 * torch.randn(poses, 6, generator=generator, dtype=F64))
    points = 0.08 * torch.randn(count, 3, generator=generator, dtype=F64)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=F64), dim=-1)
    return pose, points, normals


def in_frame(pose, points, normals):
    own = se3.apply(se3.inverse(pose), points.expand(len(pose), *points.shape))
    return own, (pose[:, None, :3, :3].mT @ normals[:, :, None])[..., 0]


def test_golden_rectangle(golden):
    case = golden("s003.rect")
    given, wanted = case["inputs"], case["expected"]
    x, y, yaw = torch.tensor(given["poses"], dtype=F64).T
    back = torch.stack((yaw.cos(), yaw.sin(), -yaw.sin(), yaw.cos()), -1).view(-1, 2, 2)
    points = back @ (torch.tensor(given["zp"], dtype=F64) - torch.stack((x, y), -1))[..., None]
    normals = back @ torch.tensor(given["zn"], dtype=F64)[:, None]
    noise = TouchNoise(given["sigma_p"], given["sigma_n"])
    half = torch.tensor(given["half"], dtype=F64)
    faces = box_face_log_likelihoods(points[..., 0], normals[..., 0], half, noise)
    assert torch.allclose(faces, torch.tensor(wanted["log_per_face"], dtype=F64), atol=case["atol"])
    best = box_log_likelihoods(points[..., 0], normals[..., 0], half, noise)
    assert torch.allclose(best, torch.tensor(wanted["loglik"], dtype=F64), atol=case["atol"])


@pytest.mark.parametrize("with_normals", [False, True])
@pytest.mark.parametrize("outlier", [0.0, 0.05])
def test_a_mesh_of_a_box_is_the_box(box, with_normals, outlier):
    pose, points, normals = scene()
    noise = TouchNoise(0.004, 0.15, outlier)
    found = touch_log_likelihoods(pose, points, normals if with_normals else None, box, noise)
    own, facing = in_frame(pose, points, normals)
    assert torch.allclose(found, box_log_likelihoods(own, facing if with_normals else None, HALF, noise), atol=1e-8)


def test_point_and_normal_are_of_one_face(box):
    # 1 mm inside of the edge between +x and +y, facing +x: nearer to +y, but no face has both
    pose = torch.eye(4, dtype=F64)[None]
    point = torch.tensor([[0.026, 0.049, 0.0]], dtype=F64)
    normal = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    found = touch_log_likelihoods(pose, point, normal, box)
    assert float(found) == pytest.approx(-0.5 * (0.004 / 0.005) ** 2, abs=1e-9)
    # facing the other way it must be the far face, 56 mm off
    assert float(touch_log_likelihoods(pose, point, -normal, box)) == pytest.approx(-0.5 * (0.056 / 0.005) ** 2)
    # six degrees off cost half a nat, in radians, and not next to nothing
    angle = math.radians(6.0)
    tilted = torch.tensor([[math.cos(angle), math.sin(angle), 0.0]], dtype=F64)
    on = torch.tensor([[0.03, 0.0, 0.0]], dtype=F64)
    assert float(touch_log_likelihoods(pose, on, tilted, box)) == pytest.approx(-0.4995, abs=1e-4)


def test_an_outlier_costs_so_much_and_no_more(box):
    noise = TouchNoise(outlier=0.1)
    pose, far = torch.eye(4, dtype=F64)[None], torch.tensor([[1.0, 2.0, 3.0]], dtype=F64)
    wanted = math.log(0.1 * math.sqrt(2.0 * math.pi) * 0.005 / 0.5)
    assert float(touch_log_likelihoods(pose, far, None, box, noise)) == pytest.approx(wanted)
    on = torch.tensor([[0.03, 0.0, 0.0]], dtype=F64)
    own = float(touch_log_likelihoods(pose, on, None, box, noise))
    assert own == pytest.approx(math.log(0.9 + math.exp(wanted)))
    # with a normal, also a chord of 0 to 2 that may be anything
    normal = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    wanted += math.log(math.sqrt(2.0 * math.pi) * noise.normal_rad / 2.0)
    assert float(touch_log_likelihoods(pose, far, normal, box, noise)) == pytest.approx(wanted)


def test_batches(box):
    pose, points, normals = scene(poses=6)
    found = touch_log_likelihoods(pose.view(2, 3, 4, 4), points, normals, box)
    assert torch.equal(found.view(6, -1), touch_log_likelihoods(pose, points, normals, box))
    assert touch_log_likelihoods(pose, points[:0], normals[:0], box).shape == (6, 0)


def test_a_box_in_four_dimensions():
    with pytest.raises(ValueError, match="2 or 3"):
        box_face_log_likelihoods(torch.zeros(1, 4), None, torch.ones(4), TouchNoise())
