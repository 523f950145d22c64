"""The simulated slip sensor's noise."""

import torch

from rumi.sim.slip import measured_motion
from sdf import se3

START = se3.from_planar(torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64))


def moving(count=5):
    steps = torch.tensor([0.004, -0.001, 0.02], dtype=torch.float64) * torch.arange(1, count + 1)[:, None]
    poses = se3.from_planar(torch.tensor([0.5, 0.1, 0.3], dtype=torch.float64) + steps)
    return poses @ se3.inverse(START)


def test_no_noise_is_exact():
    motion = moving()
    assert torch.equal(measured_motion(START, motion, torch.zeros(3, dtype=torch.float64)), motion)


def test_standing_still_is_exact():
    still = se3.identity((4,), dtype=torch.float64)
    assert torch.equal(measured_motion(START, still, torch.full((3,), 0.1, dtype=torch.float64)), still)


def test_error_is_about_the_object_and_grows_with_its_path():
    """At the end the pose is off by the noise, at the object's own place; before that in proportion."""
    motion, noise = moving(), torch.tensor([0.001, -0.002, 0.02], dtype=torch.float64)
    poses, measured = motion @ START, measured_motion(START, motion, noise) @ START
    shift = (measured - poses)[:, :2, 3]
    share = torch.arange(1, 6, dtype=torch.float64)[:, None] / 5
    torch.testing.assert_close(shift, share * noise[:2], atol=1e-5, rtol=0)
    turn = se3.to_planar(measured)[:, 2] - se3.to_planar(poses)[:, 2]
    torch.testing.assert_close(turn, share[:, 0] * noise[2], atol=1e-4, rtol=0)


def test_pauses_add_no_error():
    motion = moving(3)[[0, 0, 1, 1, 2]]
    measured = measured_motion(START, motion, torch.tensor([0.001, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(measured[0], measured[1])
    torch.testing.assert_close(measured[2], measured[3])
