"""A hand that repeats itself is stuck; one that touches an object feels it otherwise as it goes."""

import math

import pytest
import torch

from rumi.belief.change_test import ChangeTest
from rumi.belief.misfit import MisfitSettings
from rumi.belief.stuck_hand import Told, told_by
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.tasks.rummage.explanations import IN_SPACE
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

OWN = PoseTrajectorySettings()


def reading(model, felt: list[list[int]], way_m: float = 0.005, begins_m: float = 0.0) -> Reading:
    """Points of the pads that feel at each instant, of a hand that goes straight ahead."""
    count = len(felt)
    pose = torch.eye(4).repeat(count, 1, 1)
    pose[:, 0, 3] = begins_m + way_m * torch.arange(count)
    there = [model.reported[some].float() + pose[at, :3, 3] for at, some in enumerate(felt)]
    points = Observation.of(torch.cat(there) if sum(map(len, felt)) else torch.zeros(0, 3), Semantics.SURFACE)
    instant = torch.arange(count).repeat_interleave(torch.tensor([len(some) for some in felt]))
    in_contact = torch.tensor([bool(some) for some in felt])
    return Reading(points, instant, pose, in_contact, None, pose[-1, :3, 3], torch.tensor(0.0))


HERE, THERE = [3, 4, 5], [4, 5, 6]
SAME, OTHER = math.log(9.9), math.log(0.01 / 0.9)


def ratio(model, *readings: Reading, **more: float) -> float:
    return told_by(readings, model, OWN, **more).ratio


def test_what_repeats_itself_as_it_goes_is_stuck(model):
    nothing = reading(model, [[]])
    assert ratio(model, nothing, reading(model, [HERE] * 3)) == pytest.approx(2 * SAME)
    # a steady push goes on as it began
    assert ratio(model, nothing, reading(model, [HERE] * 9)) == pytest.approx(3 * SAME)


def test_the_instant_before_the_action_counts(model):
    last = reading(model, [[], HERE], begins_m=-0.01)
    assert ratio(model, last, reading(model, [HERE])) == pytest.approx(SAME)
    assert ratio(model, last, reading(model, [THERE])) == pytest.approx(OTHER)
    assert ratio(model, reading(model, [HERE])) == 0.0  # the first of a run has none before it


def test_other_points_or_none_speak_against_it(model):
    nothing = reading(model, [[]])
    assert ratio(model, nothing, reading(model, [HERE, THERE, HERE])) == pytest.approx(2 * OTHER)
    assert ratio(model, nothing, reading(model, [HERE, HERE, []])) == -math.inf
    assert ratio(model, nothing, nothing) == -math.inf


def test_a_hand_that_stands_still_tells_nothing(model):
    last = reading(model, [HERE])
    assert ratio(model, last, reading(model, [HERE] * 20, way_m=0.0)) == 0.0
    assert ratio(model, last, reading(model, [HERE, THERE] * 10, way_m=0.0)) == 0.0


def test_its_ratio_has_a_mean_of_one_at_most(model):
    """Under no fault, where the same points feel again with the chance that is stated: no evidence by chance alone."""
    last = reading(model, [HERE])
    same, other = (ratio(model, last, reading(model, [some], begins_m=0.01)) for some in (HERE, THERE))
    assert 0.1 * math.exp(same) + 0.9 * math.exp(other) == pytest.approx(1.0)
    for pairs in (2, 5, 20):
        told = ratio(model, reading(model, [[]]), reading(model, [HERE] * (pairs + 1)))
        assert 0.1**pairs * math.exp(told) <= 1.0


def test_a_sensor_of_few_taxels_repeats_itself_and_is_not_stuck(model):
    """It felt nothing, and then the same all along, at each touch: so it does where nothing is wrong."""
    touches = [reading(model, [[], [], *[HERE] * 10]) for _ in range(3)]
    held = reading(model, [HERE] * 10)
    told = [ratio(model, *touches[:count], reading(model, [[]]), held) for count in range(4)]
    assert told == sorted(told, reverse=True)
    assert told[0] == pytest.approx(3 * SAME) and told[3] < 0.25 * told[0]


@pytest.mark.parametrize("anywhere", [-50.0, 0.0, 3.0, 800.0])
def test_what_is_felt_where_nothing_is_believed_speaks_for_it_too(model, anywhere):
    found = told_by([reading(model, [[]]), reading(model, [HERE] * 3)], model, OWN, anywhere=anywhere)
    assert found.repeated == pytest.approx(2 * SAME)
    assert found.ratio == pytest.approx(2 * SAME + float(torch.tensor([0.0, anywhere]).logsumexp(0)) - math.log(2.0))


def test_instants_that_lie_close_together_are_compared_as_far_ones_are(model):
    nothing = reading(model, [[]])
    assert ratio(model, nothing, reading(model, [HERE] * 12, way_m=0.0011)) == pytest.approx(3 * SAME)
    assert ratio(model, nothing, reading(model, [HERE, HERE, THERE, THERE] * 3, way_m=0.0011)) < 2 * OTHER


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_push_that_goes_on_is_one_piece_of_evidence(model, count):
    """However many actions it takes, of however many instants."""
    steps = [reading(model, [HERE] * count, begins_m=0.005 * count * number) for number in range(8)]
    steps = [reading(model, [[]], begins_m=-0.005), *steps]
    told = [ratio(model, *steps[: number + 1]) for number in range(1, len(steps))]
    assert sum(told) == pytest.approx(3 * SAME) and max(told[4:]) == 0.0


def test_what_feels_the_same_another_way_is_another_piece_of_evidence(model):
    there = reading(model, [HERE] * 5)
    ahead = reading(model, [HERE] * 5, begins_m=0.025)
    back = reading(model, [HERE] * 5, way_m=-0.005, begins_m=0.015)
    assert ratio(model, there, ahead) == pytest.approx(0.0)
    assert ratio(model, there, back) == pytest.approx(3 * SAME)


def test_a_push_is_none_any_more_once_nothing_is_felt(model):
    came_off = reading(model, [HERE] * 5 + [[]])
    chance = 5.0 / 14.0  # one in ten, and all four pairs of that push, which came off by itself
    assert ratio(model, came_off, reading(model, [HERE] * 5, begins_m=0.025)) == pytest.approx(
        3 * math.log(0.99 / chance)
    )


def test_one_instant_tells_nothing_wherever_it_felt(model):
    assert told_by([reading(model, [[]]), reading(model, [HERE])], model, OWN, anywhere=5.0) == Told(0.0, 0.0)


def test_one_steady_push_is_no_alarm_in_space(model):
    """Pairs of one push are not independent: it takes more than one action that repeats itself."""
    test = ChangeTest(tuple(IN_SPACE.values()), MisfitSettings().alpha)
    held = ratio(model, reading(model, [[]]), reading(model, [HERE] * 20))
    names = list(IN_SPACE)
    one = torch.tensor([held if name == "stuck hand" else 0.0 for name in names], dtype=torch.float64)
    evidence = test.update(test.begin(), one)
    assert not bool(test.alarm(evidence))
    for _ in range(2):
        evidence = test.update(evidence, one)
    assert bool(test.alarm(evidence))
