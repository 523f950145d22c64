"""Ratios of faults against a belief: which way each reading turns them, and what has no meaning."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.misfit import MISFITS, MisfitSettings, knocked, log_ratios
from rumi.belief.particles import PoseBelief
from sdf import se3
from sdf.primitives import Box
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

BOX, OWN = Box((0.05, 0.05, 0.05)), MisfitSettings()
FACE = torch.tensor([[-0.05, 0.0, 0.0], [-0.05, 0.004, 0.0], [-0.05, -0.004, 0.002]])


def belief(count=50, spread=1e-3):
    normal = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return PoseBelief.uniform(se3.from_planar(normal * torch.tensor([spread, spread, 10 * spread])))


def felt(shift=(0.0, 0.0, 0.0)):
    return Observation.of(FACE + torch.tensor(shift), Semantics.SURFACE)


def free(x):
    return Observation.of(torch.tensor([[x, 0.0, 0.0], [x - 0.02, 0.01, 0.0]]), Semantics.FREE)


def ratios(*parts, **changes):
    return dict(zip(MISFITS, log_ratios(belief(), concatenate(list(parts)), BOX, replace(OWN, **changes)), strict=True))


def test_what_fits_speaks_against_every_fault():
    assert all(float(value) < 0 for value in ratios(felt(), free(-0.08)).values())


def test_what_tells_nothing_leaves_them():
    assert log_ratios(belief(), Observation.empty(), BOX, OWN).tolist() == [0.0, 0.0, 0.0]
    far = ratios(free(-0.5))
    assert all(abs(float(far[name])) < 0.02 for name in ("absent", "none of these"))


def test_a_surface_that_is_off_speaks_for_a_knock():
    off = ratios(felt((-0.03, 0.0, 0.0)))
    assert float(off["knocked"]) > 3.0
    assert float(off["knocked"]) > float(off["absent"])


def test_free_space_where_the_object_should_be_speaks_for_its_absence():
    through = ratios(free(0.0))
    assert max(through, key=lambda name: float(through[name])) == "absent"
    assert float(through["absent"]) > 4.0


def test_what_is_felt_speaks_against_absence():
    both = ratios(felt((-0.03, 0.0, 0.0)), free(-0.01))
    assert float(both["absent"]) < float(both["none of these"]) - 4.0


def test_many_points_that_err_together_count_as_one_reading():
    once = ratios(felt((-0.03, 0.0, 0.0)))
    often = ratios(*[felt((-0.03, 0.0, 0.0))] * 40)
    for name in MISFITS:
        assert float(often[name]) == pytest.approx(float(once[name]), abs=0.2)


@pytest.mark.parametrize("count", [1, 50])
def test_readings_far_off_leave_numbers(count):
    for distance in (1.0, 1e4):
        found = log_ratios(belief(count), felt((-distance, 0.0, 0.0)), BOX, OWN)
        assert bool(found.isfinite().all())


def test_poses_after_a_knock_are_spread_about_the_belief_and_upright():
    poses = knocked(belief(spread=1e-6), OWN, 4096)
    planar = se3.to_planar(poses)
    torch.testing.assert_close(planar.std(0), torch.tensor([0.03, 0.03, 0.4]), rtol=0.05, atol=0)
    torch.testing.assert_close(poses[:, 2, 2], torch.ones(4096))
