"""The summary of a belief: pose, covariance, mass within a tolerance, modes."""

import json
import math

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.registration.pose_summary import PoseSummary, answer_lines, summarise_particles
from sdf import se3, so3
from sdf.symmetry import Symmetries

F64 = torch.float64


def cloud(count: int, spread: float | torch.Tensor, planar: bool, dtype: torch.dtype) -> torch.Tensor:
    draw = spread * torch.randn(count, 6, generator=torch.Generator().manual_seed(2), dtype=F64)
    draw[:, 2:5] *= 0.0 if planar else 1.0
    at = se3.from_planar(torch.tensor([0.5, -0.2, 2.5], dtype=F64))
    return se3.make(so3.exp(draw[:, 3:]) @ at[:3, :3], at[:3, 3] + draw[:, :3]).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("count", [1, 5, 300])
@pytest.mark.parametrize("spread", [0.0, 0.002])
@pytest.mark.parametrize("symmetry", ["none", "z", "x2,y2", "ball"])
def test_every_number_is_finite_and_comes_back_from_json(dtype, planar, count, spread, symmetry):
    belief = PoseBelief.uniform(cloud(count, spread, planar, dtype))
    found = belief.summary(Symmetries.parse(symmetry))
    text = json.dumps(found.as_dict(), allow_nan=False)
    assert PoseSummary.of(json.loads(text)).as_dict() == found.as_dict()
    assert torch.allclose(found.world_T_object, belief.mode().double(), atol=1e-6)
    assert sum(mode.weight for mode in found.modes) == pytest.approx(1.0, abs=0.02)
    assert torch.linalg.eigvalsh(found.covariance)[0] > -1e-12
    if spread == 0.0 or count == 1:
        assert found.probability == pytest.approx(1.0) and float(found.covariance.abs().max()) < 1e-10
    if symmetry == "ball":
        assert float(found.covariance[3:].abs().max()) < 1e-10


def test_the_covariance_is_of_the_place_and_of_turns_about_the_worlds_axes():
    scale = 1e-3 * torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], dtype=F64)
    poses = cloud(4000, scale, False, F64)
    found = summarise_particles(poses, torch.zeros(len(poses), dtype=F64), se3.mean(poses, torch.ones(len(poses))))
    scaled = found.covariance / (scale[:, None] * scale)
    assert torch.allclose(scaled, torch.eye(6, dtype=F64), atol=0.1)
    x, y, z, w = found.as_dict()["quaternion_xyzw"]
    turn = so3.exp(2.0 * math.acos(w) / math.sin(math.acos(w)) * torch.tensor([x, y, z], dtype=F64))
    assert torch.allclose(turn, found.world_T_object[:3, :3], atol=1e-9) and w >= 0


def test_poses_that_look_the_same_are_one_mode():
    poses = cloud(40, 0.001, True, F64)
    poses[20:] = poses[20:] @ se3.from_planar(torch.tensor([0.0, 0.0, math.pi], dtype=F64))
    log_weights = torch.log(torch.tensor([0.035] * 20 + [0.015] * 20, dtype=F64))
    two = summarise_particles(poses, log_weights)
    assert [mode.weight for mode in two.modes] == pytest.approx([0.7, 0.3]) and two.probability == pytest.approx(0.7)
    assert float(two.covariance[5, 5]) > 1.0
    one = summarise_particles(poses, log_weights, symmetries=Symmetries.parse("z2"))
    assert [mode.weight for mode in one.modes] == pytest.approx([1.0]) and one.probability == pytest.approx(1.0)
    assert float(one.covariance[5, 5]) < 1e-5
    assert any("0.30" in line for line in answer_lines(two, "why", ("what",)))
    with pytest.raises(ValueError, match="at least one particle"):
        summarise_particles(poses[:0], log_weights[:0])
