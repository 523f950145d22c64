"""Pushes from their true starts: which are by two sides, and how they are put down."""

import torch

from rumi.belief.pushed_object import PushedObject
from rumi.robot.gripper import GripperShape
from scripts.trajectory_starts import tables, two_sides
from sdf.primitives import Cylinder

DOUBLE = {"dtype": torch.float64}


def test_a_bar_between_both_pads_is_touched_by_two_sides() -> None:
    border, radius = GripperShape().outline(1e-3).double(), 0.01
    model = PushedObject.of(
        Cylinder(radius, 0.05), GripperShape(), height_m=0.0, resting_m=0.05, spacing_m=0.005, pad_spacing_m=0.01
    )
    tool = torch.zeros(1, 3, **DOUBLE)
    for y, found in ((0.0, 1), (0.024, 0)):  # between the pads, and at the tip of one
        x = torch.linspace(0.0, 0.06, 601, **DOUBLE)
        far = torch.cdist(torch.stack((x, torch.full_like(x, y)), -1), border).amin(-1)
        first = float(x[(far < radius).nonzero().max() + 1])
        assert two_sides(model, torch.tensor([[first, y, 0.3]], **DOUBLE), tool) == found


def test_tables_of_pushes_and_updates() -> None:
    own = {"set": ["across=0.1"], "defaults": "abc"}
    push = {"two": True, "mm": 2.0, "deg": 1.0, "level": 0.6, "nats": -2.0}
    step = {"contacts": 4, "touched": True, "right": True, "p_right": 0.9, "mm": 1.0, "cpu_s": 0.1}
    step |= {"both": 0.92, "place": 0.3, "turn": 0.7}
    lines = [own | {"command": "pushes", "pushes": [push, push | {"two": False, "level": 0.2}]}]
    lines += [own | {"command": "replay", "updates": [step]}]
    text = tables(lines)
    assert "| abc across=0.1 | 1 | 2 | 2.0; 2.0; 2.0 | 1.0; 1.0; 1.0 | 50, 100, 100, 100 % | -2.00 |" in text
    assert "1 by two sides" in text and "1 of later ones" in text and "| 0, 0, 100, 100 |" in text
