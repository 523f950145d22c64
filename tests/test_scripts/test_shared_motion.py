"""The figure of one run believed twice: both beliefs are of the same readings."""

import pytest
import torch

pytest.importorskip("mujoco")

from scripts import shared_motion
from scripts.shared_motion import believed, draw, off

pytestmark = pytest.mark.sim


def test_both_beliefs_are_of_the_same_readings(monkeypatch, tmp_path, at_home):
    monkeypatch.setattr(shared_motion, "STEPS", 1)
    shared, own, agent = believed(1050)
    assert len(shared) == len(own) == 2
    for one, other in zip(shared, own, strict=True):
        assert torch.equal(one.reading.tool_pose, other.reading.tool_pose)
        assert one.truth is not None and other.truth is not None and torch.equal(one.truth, other.truth)
    assert not torch.equal(shared[-1].belief.world_T_object, own[-1].belief.world_T_object)
    assert off(own[-1], agent)[0] < 20.0
    assert draw(shared, own, agent, tmp_path / "both.png").stat().st_size > 10_000
