"""The chance of readings at the best trajectory: a p-value that bounds, and that finds what no particle explains."""

import math

import pytest
import torch

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.trajectory_chance import log_chance
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_likelihood import log_likelihood_of
from rumi.belief.trajectory_settings import PoseTrajectorySettings

OWN = PoseTrajectorySettings()
DOUBLE = {"dtype": torch.float64}


def segment(kind: Kind, count: int, weight: float = 1.0) -> Segment:
    """Readings of one kind, at two instants."""
    instant = torch.arange(count) // max(1, (count + 1) // 2)
    kinds = torch.full((count,), int(kind))
    return Segment(
        torch.zeros(2, 2, 3, **DOUBLE), True, torch.zeros(count, 3, **DOUBLE), instant, kinds, weight + 0.0 * instant
    )


def told(*parts: tuple[Segment, list[float]]) -> Trajectories:
    """Particles with a log-likelihood of each segment."""
    history = History.empty()
    for part, _ in parts:
        history = history.appended(replace_weight(part))
    logs = torch.tensor([given for _, given in parts], **DOUBLE).mT
    count, segments = logs.shape
    noise, poses = torch.zeros(count, segments, NOISE, **DOUBLE), torch.zeros(count, segments + 1, 3, **DOUBLE)
    return Trajectories(torch.zeros(count, PHYSICS, **DOUBLE), noise, poses, logs, history, poses[:0, 0])


def replace_weight(part: Segment) -> Segment:
    return part._replace(weight=part.weight.double())


def even(now: Trajectories) -> torch.Tensor:
    return torch.zeros(len(now), **DOUBLE).log_softmax(0)


def test_what_readings_are_worth_is_counted_by_segment_and_kind():
    now = told((segment(Kind.SEEN, 3, 0.5), [0.0]), (segment(Kind.FELT, 0), [0.0]), (segment(Kind.PAD_CLEAR, 5), [0.0]))
    worth = torch.zeros(3, len(Kind), **DOUBLE)
    worth[0, Kind.SEEN], worth[2, Kind.PAD_CLEAR] = 1.5, 5.0
    assert torch.equal(now.history.worth(), worth)


def test_pads_that_are_dead_all_but_a_few_tell_nothing_and_no_pad_has_a_negative_chance():
    off = torch.tensor([-0.01, 0.0, 0.01], **DOUBLE)
    for kind in (Kind.PAD_FELT, Kind.PAD_CLEAR):
        told = log_likelihood_of(off, torch.tensor(int(kind)), PoseTrajectorySettings(dead=0.99))
        assert bool(told.isfinite().all()) and float(told.max()) == float(told.min())


@pytest.mark.parametrize("kind", list(Kind))
def test_it_is_small_no_more_often_than_it_says(kind):
    random = torch.Generator().manual_seed(1)
    runs, count = 2000, 40
    if kind >= Kind.PAD_FELT:  # points right at the border of what the pads feel: as uncertain as can be
        feels = torch.rand(runs, count, generator=random) < 0.5
        kinds = torch.where(feels, int(Kind.PAD_FELT), int(Kind.PAD_CLEAR))
        logs = log_likelihood_of(torch.full((runs, count), OWN.pad_m, **DOUBLE), kinds, OWN)
    else:
        scale, middle = {
            Kind.SEEN: (OWN.seen_sd_m, 0.0),
            Kind.FREE: (OWN.free_sd_m, -OWN.free_m),
            Kind.FELT: (OWN.felt_sd_m, OWN.felt_m),
        }[kind]
        off = middle + scale * torch.randn(runs, count, generator=random, **DOUBLE)
        off = torch.where(torch.rand(runs, count, generator=random) < OWN.outliers, 0.1, off)
        logs = log_likelihood_of(off, torch.full((runs, count), int(kind)), OWN)
    one = segment(kind, count)
    found = torch.tensor([log_chance(told((one, [float(sum_)])), torch.zeros(1), OWN) for sum_ in logs.sum(-1)])
    for chance in (0.3, 0.1, 0.01):
        assert float((found < math.log(chance)).double().mean()) <= chance


def test_it_is_of_the_best_particle_that_is_not_ruled_out():
    poor, good = -100.0, -10.0
    now = told((segment(Kind.SEEN, 30), [poor, good]))
    assert log_chance(now, even(now), OWN) == 0.0
    assert log_chance(now, torch.tensor([0.0, -math.inf]), OWN) < math.log(1e-9)


def test_what_fitted_long_ago_hides_nothing():
    good, bad = (segment(Kind.SEEN, 100), [-20.0]), (segment(Kind.FELT, 20), [-60.0])
    alone, after = (log_chance(told(*parts), torch.zeros(1), OWN) for parts in ((bad,), (*[good] * 20, bad)))
    assert alone < math.log(1e-6)
    assert after == pytest.approx(alone + math.log(21))
    assert log_chance(told(*[good] * 20), torch.zeros(1), OWN) == 0.0


def test_nothing_sensed_is_explained_by_all():
    now = told((segment(Kind.SEEN, 0), [0.0]))
    assert log_chance(now, torch.zeros(1), OWN) == 0.0
    none, poses = torch.zeros(1, 0, **DOUBLE), torch.zeros(1, 1, 3, **DOUBLE)
    none = Trajectories(now.physics, torch.zeros(1, 0, NOISE, **DOUBLE), poses, none, History.empty(), poses[0])
    assert log_chance(none, torch.zeros(1), OWN) == 0.0
