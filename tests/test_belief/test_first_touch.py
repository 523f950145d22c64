"""Particles drawn anew for a first touch: rejection control leaves their distribution as it is."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief import first_poses
from rumi.belief.first_poses import drawn_again, of_view
from rumi.belief.systematic_errors import as_seen
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.bench.drawn_segments import drawn_view
from rumi.seeding import generator
from rumi.weights import effective_sample_size

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(
    first_particles=2000,
    tool_off_m=0.002,
    tool_off_rad=0.02,
    worn=(0.0, 0.0003),
    view_off_m=0.001,
    view_off_rad=0.01,
    view_about_m=(0.0, -0.3),
    seen_points=12.0,
)
TRUTH = torch.tensor([0.002, -0.001, 0.1], **DOUBLE)

pytestmark = pytest.mark.usefixtures("by_numba")


@pytest.fixture(scope="module")
def viewed(model):
    """Particles of a view of a block that is seen where it is."""
    random = generator(1)
    view = drawn_view(model, OWN, TRUTH, 200, random)
    view = view._replace(weight=torch.full_like(view.weight, OWN.seen_points / len(view.points)))
    return of_view(view, TRUTH[None] + torch.tensor([0.001, 0.0005, 0.01], **DOUBLE), model, OWN, random)


@pytest.fixture(scope="module")
def left_open(viewed):
    """The same where proposals are drawn about poses much farther apart."""
    apart = torch.randn(len(viewed.starts), 3, generator=generator(2), **DOUBLE) * torch.tensor([3e-3, 3e-3, 0.1])
    return replace(viewed, starts=viewed.starts + apart)


def test_what_is_given_up_is_made_up_for_by_what_is_kept(left_open, model, monkeypatch):
    """The mean weight of draws, and of parts of them, is that of draws whose whole likelihood is known."""
    resampled = first_poses.resample_systematic

    def mean_weights(below):
        """Of all draws, and of those on either side of the truth, in order of x, of y and of the lever."""
        found = []

        def noted(log_weights, *arguments, **options):
            found.append(log_weights.exp())
            return resampled(log_weights, *arguments, **options)

        def replayed(self, *arguments):
            tried.append(self)
            return usual(self, *arguments)

        tried, usual = [], type(left_open).replayed
        with monkeypatch.context() as patch:
            patch.setattr(first_poses, "_BELOW", below)
            patch.setattr(first_poses, "AGAIN", 20000)
            patch.setattr(first_poses, "resample_systematic", noted)
            patch.setattr(type(left_open), "replayed", replayed)
            again = drawn_again(left_open, model, OWN, generator(4))
        assert len(again) == OWN.first_particles and bool(again.log_likelihood.isfinite().all())
        start, lever = tried[-1].poses[:, 0], tried[-1].physics[:, 1]
        sides = [start[:, 0] > TRUTH[0], start[:, 1] > TRUTH[1], lever > 0.0]
        return torch.stack([found[-1].mean(), *(found[-1][side].sum() / 20000 for side in sides)]), len(tried)

    (kept, once), (whole, _) = mean_weights(-1.0), mean_weights(math.inf)
    # by chance parts of 20000 draws are off by 2.5 % or so
    torch.testing.assert_close(kept / whole, torch.ones_like(kept), atol=0.08, rtol=0)
    none, twice = mean_weights(-1e4)  # a floor that nothing reaches: all are weighed as they are
    torch.testing.assert_close(none, whole, atol=0, rtol=0)
    assert (once, twice) == (1, 2)


def test_most_draws_of_little_weight_are_given_up_early(left_open, model, monkeypatch):
    seen, replayed = [], type(left_open).replayed

    def counted(self, *arguments):
        found = replayed(self, *arguments)
        seen.append(float(found.log_likelihood.isfinite().all(-1).double().mean()))
        return found

    monkeypatch.setattr(type(left_open), "replayed", counted)
    drawn_again(left_open, model, OWN, generator(7))
    assert len(seen) == 1 and 0.0 < seen[0] < 0.6


@pytest.mark.parametrize("again", [False, True])
def test_a_belief_is_as_wide_as_its_camera_may_be_off_where_the_object_stands(viewed, model, again):
    """Beside the point that the camera is turned about it is off across the way to it, and less along it."""
    now = drawn_again(viewed, model, OWN, generator(5)) if again else viewed
    assert OWN.view_about_m[0] == 0.0
    shown = as_seen(OWN, now.systematic, now.pose)[:, :2]
    known = shown.std(0).tolist()
    across, along = now.pose[:, :2].std(0).tolist()
    turned_m = OWN.view_off_rad * (TRUTH[1] - OWN.view_about_m[1]).item()
    assert across == pytest.approx(math.hypot(turned_m, OWN.view_off_m, known[0]), rel=0.15)
    assert along == pytest.approx(math.hypot(OWN.view_off_m, known[1]), rel=0.15)
    assert max(known) < 0.6 * across  # where the camera has it, it is known better
    assert float((shown.mean(0) - TRUTH[:2]).norm()) < 1e-3


def test_many_draws_for_a_first_touch_count(viewed, model, monkeypatch):
    """By where the camera has the object they are drawn where the view is likely, whatever it is off by."""
    found, resampled = [], first_poses.resample_systematic

    def noted(log_weights, *arguments, **options):
        found.append(float(effective_sample_size(log_weights.log_softmax(-1))) / len(log_weights))
        return resampled(log_weights, *arguments, **options)

    monkeypatch.setattr(first_poses, "resample_systematic", noted)
    drawn_again(viewed, model, OWN, generator(5))
    assert found[-1] > 0.15
