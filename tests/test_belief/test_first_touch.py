"""Particles drawn anew for a first touch: rejection control leaves their distribution as it is."""

import math

import pytest
import torch

from rumi.belief import first_poses
from rumi.belief.drawn_segments import drawn_view
from rumi.belief.first_poses import drawn_again, of_view
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.seeding import generator

DOUBLE = {"dtype": torch.float64}
OWN = PoseTrajectorySettings(
    first_particles=2000, tool_off_m=0.002, tool_off_rad=0.02, worn=(0.0, 0.0003), view_off_m=0.002, seen_points=12.0
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


def test_what_is_given_up_is_made_up_for_by_what_is_kept(viewed, model, monkeypatch):
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

        tried, usual = [], type(viewed).replayed
        with monkeypatch.context() as patch:
            patch.setattr(first_poses, "_BELOW", below)
            patch.setattr(first_poses, "DRAWS", 20000)
            patch.setattr(first_poses, "resample_systematic", noted)
            patch.setattr(type(viewed), "replayed", replayed)
            again = drawn_again(viewed, model, OWN, generator(4))
        assert len(again) == OWN.first_particles and bool(again.log_likelihood.isfinite().all())
        start, lever = tried[-1].poses[:, 0], tried[-1].physics[:, 1]
        sides = [start[:, 0] > TRUTH[0], start[:, 1] > TRUTH[1], lever > 0.0]
        return torch.stack([found[-1].mean(), *(found[-1][side].sum() / 20000 for side in sides)]), len(tried)

    (kept, once), (whole, _) = mean_weights(-1.0), mean_weights(math.inf)
    torch.testing.assert_close(kept / whole, torch.ones_like(kept), atol=0.04, rtol=0)
    none, twice = mean_weights(-1e4)  # a floor that nothing reaches: all are weighed as they are
    torch.testing.assert_close(none, whole, atol=0, rtol=0)
    assert (once, twice) == (1, 2)


def test_most_draws_are_given_up_early(viewed, model, monkeypatch):
    seen, replayed = [], type(viewed).replayed

    def counted(self, *arguments):
        found = replayed(self, *arguments)
        seen.append(float(found.log_likelihood.isfinite().all(-1).double().mean()))
        return found

    monkeypatch.setattr(type(viewed), "replayed", counted)
    drawn_again(viewed, model, OWN, generator(7))
    assert len(seen) == 1 and 0.0 < seen[0] < 0.6
