"""Evidence: every member carries over a known motion, is finite, and is batched."""

import pytest
import torch

from sdf import se3
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.evidence import SemanticPoints, SensorPoints
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics, SemanticSensor

F64 = torch.float64
MODULE = Discrepancy(Box((0.03, 0.05, 0.02)).double(), 0.062, free_scale=20.0).double()


def points(batch=(), attached=True):
    random = torch.Generator().manual_seed(0)
    parts = [
        Observation.of(0.06 * torch.randn(*batch, 30, 3, generator=random, dtype=F64), s, attached=attached)
        for s in Semantics
    ]
    return concatenate(parts)


def poses(batch=()):
    random = torch.Generator().manual_seed(1)
    return se3.exp(0.2 * torch.randn(*batch, 7, 6, generator=random, dtype=F64))


def members(observation, frame):
    sensor = SemanticSensor().double()
    return [
        SemanticPoints(observation, MODULE, frame, peakiness=2.0),
        SensorPoints(observation, MODULE, frame, sensor),
    ]


@pytest.mark.parametrize("member", [0, 1])
def test_attached_points_and_poses_move_together(member):
    motion = se3.exp(torch.tensor([0.1, -0.3, 0.2, 0.4, -0.5, 0.9], dtype=F64))
    evidence = members(points(), se3.identity((), dtype=F64, device="cpu"))[member]
    before = evidence.log_likelihood(poses())
    torch.testing.assert_close(evidence.moved(motion).log_likelihood(motion @ poses()), before, atol=1e-9, rtol=0)
    assert float(before.max() - before.min()) > 0.1


@pytest.mark.parametrize("member", [0, 1])
def test_fixed_points_stay_in_the_world(member):
    motion = se3.exp(torch.tensor([0.02, -0.01, 0.0, 0.0, 0.0, 0.3], dtype=F64))
    start = se3.identity((), dtype=F64, device="cpu")
    evidence = members(points(attached=False), start)[member]
    torch.testing.assert_close(
        evidence.moved(motion).log_likelihood(poses()), evidence.log_likelihood(poses()), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("member", [0, 1])
def test_a_batch_row_equals_the_scene_alone_and_all_is_finite(member):
    frame = se3.exp(0.3 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2), dtype=F64))
    observation, pose = points((3,)), poses((3,))
    together = members(observation, frame)[member].log_likelihood(pose)
    assert torch.isfinite(together).all()
    for row in range(3):
        alone = Observation(*(getattr(observation, n)[row] for n in Observation.__dataclass_fields__))
        torch.testing.assert_close(
            members(alone, frame[row])[member].log_likelihood(pose[row]), together[row], atol=1e-9, rtol=0
        )


@pytest.mark.parametrize("member", [0, 1])
def test_no_points_say_nothing(member):
    evidence = members(Observation.empty(dtype=F64), se3.identity((), dtype=F64, device="cpu"))[member]
    assert evidence.log_likelihood(poses()).tolist() == [0.0] * 7


def test_the_sensor_s_likelihood_is_the_sum_of_its_logs():
    observation, pose = points(), poses()
    evidence = members(observation, se3.identity((), dtype=F64, device="cpu"))[1]
    expected = torch.zeros(7, dtype=F64)
    for n in range(7):
        for m in range(len(observation)):
            inverse = torch.linalg.inv(pose[n])
            v = MODULE.sdf.distance(inverse[:3, :3] @ observation.points[m] + inverse[:3, 3])
            excess = max(0.0, abs(float(v)) - 0.003)
            off = 1 - torch.exp(torch.tensor(-100.0 * excess, dtype=F64))
            p = {0: off if v > 0 else off * 0, 1: off if v <= 0 else off * 0, 2: 1 - off}[int(observation.semantics[m])]
            expected[n] += torch.log(p.clamp_min(1e-6))
    torch.testing.assert_close(evidence.log_likelihood(pose), expected, atol=1e-6, rtol=1e-6)
