"""Evidence of recorded actions: poses at rest are found again, and what happened is likelier than what did not."""

import math

import pytest
import torch

from rumi.belief.prior import lying
from rumi.belief.toppled_object import ToppledObject
from rumi.robot.gripper import GripperShape
from scripts.space_motion import resting
from sdf import se3
from sdf.object_model import box_model


def test_a_pose_at_rest_is_found_again_whichever_side_is_up():
    box = box_model(spacing=0.004)
    ways = torch.stack([lying(box.exact.bounds, up) for up in "xyz"])
    model = ToppledObject.of(box.sdf, GripperShape(), ways, box.symmetries, spacing_m=0.02, pad_spacing_m=0.01)
    for rest in range(3):
        wanted = torch.tensor([0.3, -0.1, 1.2, rest, -1.0, 0.0], dtype=torch.float64)
        pose = model.world_T_object(wanted)
        for turn in box.symmetries.rotations.double():
            alike = pose @ se3.make(turn, torch.zeros(3, dtype=torch.float64))
            found, leans = resting(model, alike, box.symmetries)
            assert leans == pytest.approx(0.0, abs=1e-3)
            assert found[3:].tolist() == wanted[3:].tolist()
            torch.testing.assert_close(found[:2], wanted[:2], atol=1e-6, rtol=0)
            assert abs(math.remainder(float(found[2] - wanted[2]), math.pi)) < 1e-3  # half a turn looks the same
