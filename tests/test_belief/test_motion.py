"""How the object moved by what is told of it: stuck to the tool, slipping in its hand, or found from its points."""

import pytest
import torch

from rumi.belief.motion import object_motion, slip_motion
from rumi.belief.particles import PoseBelief
from rumi.registration.descent import DescentSettings
from sdf import se3
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

F64 = torch.float64
MODULE = Discrepancy(Box((0.04, 0.06, 0.1)).double(), 0.125, free_scale=10.0, tolerance=0.001).double()


def test_golden_sticking_and_noise_about_the_object(golden):
    case = golden("rumi.sticking")
    tool = torch.tensor([case["inputs"]["E0"], case["inputs"]["E1"]], dtype=F64)
    motion = slip_motion(tool, torch.tensor([True, True]))
    torch.testing.assert_close(motion[-1], torch.tensor(case["expected"]["M"], dtype=F64), atol=1e-9, rtol=0)
    world_T_object = se3.inverse(torch.tensor(case["inputs"]["T"], dtype=F64))
    torch.testing.assert_close(
        se3.inverse(motion[-1] @ world_T_object), torch.tensor(case["expected"]["T_new"], dtype=F64), atol=1e-9, rtol=0
    )
    # an approach without contact moves nothing
    torch.testing.assert_close(slip_motion(tool, torch.tensor([False, True]))[-1], torch.eye(4, dtype=F64))


@pytest.mark.parametrize("seed", range(5))
def test_measured_slip_gives_the_objects_motion(seed):
    """Any tool and any object in its hand: exact while both ends of a step touch, none where they do not."""
    random = torch.Generator().manual_seed(seed)
    tool = se3.exp(torch.randn(2, 6, 6, generator=random, dtype=F64))
    tool_T_object = se3.exp(torch.randn(2, 6, 6, generator=random, dtype=F64))
    slip = se3.exp(torch.randn(2, 6, 6, generator=random, dtype=F64))
    slip[:, 1:] = tool_T_object[:, 1:] @ se3.inverse(tool_T_object[:, :-1])
    world_T_object = tool @ tool_T_object
    found = slip_motion(tool, torch.ones(2, 6, dtype=torch.bool), slip)
    torch.testing.assert_close(found @ world_T_object[:, :1], world_T_object)
    late = torch.tensor([[False, False, True, True, True, False]]).expand(2, 6)
    found = slip_motion(tool, late, slip)
    torch.testing.assert_close(found[:, :3], torch.eye(4, dtype=F64).expand(2, 3, 4, 4))
    torch.testing.assert_close(found[:, 2:5] @ world_T_object[:, 2:3], world_T_object[:, 2:5])
    torch.testing.assert_close(found[:, 5], found[:, 4])
    stuck = slip_motion(tool, late, torch.eye(4, dtype=F64).expand(2, 6, 4, 4))
    torch.testing.assert_close(stuck, slip_motion(tool, late))


def test_estimated_motion_recovers_a_slip():
    truth = se3.from_planar(torch.tensor([0.4, 0.0, 0.0], dtype=F64), 0.1)
    true_motion = se3.from_planar(torch.tensor([0.03, 0.004, 0.0], dtype=F64))
    # the tool says 40 mm, the object slipped 10 mm back and 4 mm aside
    tool = torch.stack([se3.from_planar(torch.tensor([x, 0.0, 0.0], dtype=F64)) for x in (0.0, 0.04)])
    corner = torch.tensor(
        [[-0.04, y, 0.0] for y in (-0.04, 0.0, 0.04)] + [[x, -0.06, 0.0] for x in (-0.02, 0.0, 0.02)], dtype=F64
    )
    seen = Observation.of(se3.apply(true_motion @ truth, corner), Semantics.SURFACE)
    one = make_reading(seen, tool=tool, contact=True, dtype=F64)
    start = PoseBelief.uniform(truth[None])
    descent = DescentSettings(iterations=20)
    moved = object_motion("estimated", start, one, MODULE, "SE(2)", descent)[-1] @ truth
    metres, radians = se3.distance(moved, true_motion @ truth)
    assert float(metres) < 1e-3
    assert float(radians) < 5e-3
    sticking = object_motion("sticking", start, one, MODULE, "SE(2)", descent)[-1] @ truth
    assert float(se3.distance(sticking, true_motion @ truth)[0]) > 0.01
    with pytest.raises(ValueError, match="sticking"):
        object_motion("measured", start, one, MODULE, "SE(2)", descent)
