"""Volume, middle and inertia against closed forms."""

import math

import pytest
import torch

from sdf import se3, so3
from sdf.primitives import Box, Cup, Cylinder, Placed, Sphere, Union
from sdf.solid import solid

TILT = se3.make(so3.exp(torch.tensor([0.3, -0.5, 0.8])), torch.tensor([0.02, -0.01, 0.05]))


def test_box():
    a, b, c = 0.03, 0.079, 0.105
    body = solid(Box((a, b, c)))
    assert body.volume == pytest.approx(8 * a * b * c, rel=2e-3)
    assert float(body.center.abs().max()) < 1e-9
    expected = torch.diag(torch.tensor([b * b + c * c, a * a + c * c, a * a + b * b], dtype=torch.float64)) / 3
    torch.testing.assert_close(body.inertia, expected, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "volume", "moments"),
    [
        (Sphere(0.05), 4 / 3 * math.pi * 0.05**3, [0.4 * 0.05**2] * 3),
        (Cylinder(0.04, 0.05), math.pi * 0.04**2 * 0.1, [(3 * 0.04**2 + 0.1**2) / 12] * 2 + [0.5 * 0.04**2]),
    ],
)
def test_moved_and_turned(shape, volume, moments):
    body = solid(Placed(shape, TILT))
    assert body.volume == pytest.approx(volume, rel=5e-3)
    torch.testing.assert_close(body.center, TILT[:3, 3].double(), rtol=0, atol=5e-5)
    turn = TILT[:3, :3].double()
    expected = turn @ torch.diag(torch.tensor(moments, dtype=torch.float64)) @ turn.mT
    torch.testing.assert_close(body.inertia, expected, rtol=5e-3, atol=5e-3 * max(moments))


def test_a_cup_is_hollow():
    """Wall of three lattice steps: against the difference of two cylinders."""
    body = solid(Cup(0.041, 0.095, 0.004, 0.004), 0.0013)
    full, cavity = math.pi * 0.041**2 * 0.095, math.pi * 0.037**2 * 0.091
    assert body.volume == pytest.approx(full - cavity, rel=0.02)
    assert float(body.center[2]) == pytest.approx((full * 0.0475 - cavity * 0.0495) / (full - cavity), abs=3e-4)


def test_two_boxes_apart():
    one = Box((0.01, 0.01, 0.01))
    there = se3.make(torch.eye(3), torch.tensor([0.1, 0.0, 0.0]))
    body = solid(Union((one, Placed(one, there))), 0.002)
    torch.testing.assert_close(body.center, torch.tensor([0.05, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-4)
    assert float(body.inertia[1, 1]) == pytest.approx(0.05**2 + 2 / 3 * 0.01**2, rel=0.01)


def test_nothing_inside():
    class Nothing(Sphere):
        def distance(self, points_o):
            return super().distance(points_o) + 1.0

    with pytest.raises(ValueError, match="something inside"):
        solid(Nothing(0.1))
