"""Faults of what may topple: each against the belief of islands, by an action's predictive density."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.change_test import ChangeTest
from rumi.belief.island_faults import ISLAND_FAULTS, false_touch, log_ratios
from rumi.belief.island_filter import IslandFilter, islands_of
from rumi.belief.misfit import MisfitSettings
from rumi.belief.predicted_action import predicted
from rumi.belief.stuck_hand import Told
from rumi.belief.trajectory_faults import ALIKE, by_brief_touch
from rumi.seeding import generator
from rumi.tasks.rummage.explanations import IN_SPACE, all_faults_of
from rumi.tasks.rummage.lost import _is_strange
from sdf import se3
from tests.fixtures.box_in_space import begin, felt_by, follow, towards
from tests.fixtures.made_up_run import make_up

PLACE = torch.tensor([0.01, 0.005, 0.0], dtype=torch.float64)
STUCK = Told(0.0, -1.5)


def known(followed, prior, place=PLACE):
    """A belief of which every population is about a place, on the same side."""
    belief, _ = begin(followed, prior)
    parts = []
    for number, island in enumerate(islands_of(belief)):
        poses, random = island.every.poses.clone(), torch.Generator().manual_seed(number)
        spread = torch.randn(len(poses), 3, generator=random, dtype=torch.float64)
        poses[:, -1, :3] = place + spread * torch.tensor([0.001, 0.001, 0.01])
        poses[:, -1, 3] = 1.0
        now = replace(island.every, poses=poses, apart=False)
        parts.append(followed.belief_of(now, island.every_log_weight, island.world_T_attached, island.log_weights))
    return followed.mixture(parts)


def told(followed, before, reading, seed=3, **own):
    after, _, _ = followed(before, begin(followed, followed.prior)[1], reading, generator=generator(seed))
    settings = MisfitSettings(**own)
    found = log_ratios(before, after, reading, followed, settings, generator=generator(seed + 1), stuck=STUCK)
    assert bool(found.isfinite().all())
    return dict(zip(ISLAND_FAULTS, found.tolist(), strict=True)), after


def pose(prior, place=PLACE):
    return se3.from_planar(place.float()) @ prior.ways[1]


@pytest.fixture(scope="module")
def followed(box, prior):
    return follow(box, prior, IslandFilter, unseen_particles=900, islands=3)


@pytest.fixture(scope="module")
def nothing(box, prior):
    """A way through the object's place by which nothing is felt."""
    return felt_by(box, se3.from_planar(torch.tensor([5.0, 0.0, 0.0])) @ prior.ways[1], towards(0.03, count=16))


def test_silence_where_the_object_should_be_tells_of_its_absence_or_a_dead_hand(prior, followed, nothing):
    ratio, _ = told(followed, known(followed, prior), nothing)
    assert ratio["absent"] == ratio["dead hand"] > 4.0
    assert ratio["absent"] >= ratio["knocked"]
    assert ratio["false contacts"] == ratio["second object"] == 0.0
    assert ratio["stuck hand"] == STUCK.ratio


def test_silence_beside_the_object_tells_nothing(box, prior, followed):
    aside = towards(-0.15)
    ratio, _ = told(followed, known(followed, prior), felt_by(box, pose(prior), aside))
    assert max(abs(ratio[name]) for name in ISLAND_FAULTS[:-1]) < 0.05


def test_what_is_felt_as_expected_speaks_against_every_fault(box, prior, followed):
    ratio, _ = told(followed, known(followed, prior), felt_by(box, pose(prior), towards(-0.055, count=12)))
    assert ratio["absent"] == ratio["dead hand"] < -4.0
    assert max(ratio.values()) < 0.0


def test_silence_before_any_touch_counts_by_what_of_the_prior_was_swept(box, prior, followed, nothing):
    before = begin(followed, prior)[0]
    ratio, _ = told(followed, before, nothing)
    assert 1.0 < ratio["absent"] < 8.0
    assert ratio["knocked"] == ratio["false contacts"] == ratio["second object"] == 0.0


def test_a_first_touch_is_no_knock(box, prior, followed):
    ratio, _ = told(followed, begin(followed, prior)[0], felt_by(box, pose(prior), towards(-0.055, count=12)))
    assert ratio["absent"] < -1.0
    assert ratio["knocked"] == ratio["false contacts"] == ratio["second object"] == 0.0


def test_a_knock_within_reach_explains_an_early_touch(box, prior, followed):
    """The object stands nearer to the tool than any particle has it."""
    moved = PLACE - torch.tensor([0.025, 0.0, 0.0], dtype=torch.float64)
    reading = felt_by(box, pose(prior, moved), towards(-0.075, count=12))
    ratio, _ = told(followed, known(followed, prior), reading)
    assert ratio["knocked"] > 4.0
    shares = {name: value + math.log(IN_SPACE[name]) for name, value in ratio.items()}
    assert max(shares, key=shares.__getitem__) == "knocked"


def test_what_is_felt_for_long_far_beside_is_a_second_object(box, prior, followed):
    """Out of a knock's reach: a hand's length ahead of the object."""
    away = PLACE - torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    path = towards(-0.25, count=6)
    reading = felt_by(box, pose(prior, away), torch.cat((path, path[-1:].expand(4, 4))))
    assert int(reading.in_contact.sum()) > 2
    ratio, _ = told(followed, known(followed, prior), reading)
    assert ratio["second object"] > 4.0
    assert ratio["second object"] > max(ratio["knocked"], ratio["absent"])


def test_populations_that_are_wrong_do_not_make_a_fault(box, prior, followed):
    """Two of three believe in another place: the mixture expects the touch with a third of the belief."""
    parts = list(islands_of(known(followed, prior)))
    parts[1:] = islands_of(known(followed, prior, PLACE + torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)))[1:]
    ratio, _ = told(followed, followed.mixture(parts), felt_by(box, pose(prior), towards(-0.055, count=12)))
    assert max(ratio.values()) < math.log(3.0)
    assert max(ratio[name] for name in ("knocked", "absent", "second object")) < 0.0


def test_no_fault_is_what_the_filter_adds_up(box, prior, followed):
    """Particles of which none jumps expect an ordinary touch about as well as the filter's own."""
    before, reading = known(followed, prior), felt_by(box, pose(prior), towards(-0.055, count=12))
    after, _, _ = followed(before, begin(followed, prior)[1], reading, generator=generator(3))
    for last, now in zip(islands_of(before), islands_of(after), strict=True):
        history = now.every.history
        again = predicted(last.every, last.every_log_weight, history, followed, generator(5)).log_evidence
        assert abs(again - (now.every.log_evidence - last.every.log_evidence)) < 1.0


def test_a_belief_begun_anew_keeps_how_unlikely_that_was(box, prior, followed):
    moved = PLACE - torch.tensor([0.09, 0.0, 0.0], dtype=torch.float64)
    reading = felt_by(box, pose(prior, moved), towards(-0.13, count=12))
    before = known(followed, prior)
    after, _, _ = followed(before, begin(followed, prior)[1], reading, generator=generator(3))
    anew = [island.every for island in islands_of(after) if not len(island.every.history)]
    assert anew and all(every.log_evidence < -12.0 for every in anew)
    ratio, _ = told(followed, before, reading)
    assert max(ratio["second object"], ratio["knocked"]) > 4.0 > ratio["absent"]


def test_what_a_hand_repeats_is_hardly_a_second_object(box, prior, followed):
    away = PLACE - torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    path = towards(-0.25, count=6)
    reading = felt_by(box, pose(prior, away), torch.cat((path, path[-1:].expand(4, 4))))
    before, ratio = known(followed, prior), []
    after, _, _ = followed(before, begin(followed, prior)[1], reading, generator=generator(3))
    for stuck in (STUCK, Told(6.9, 6.9)):
        own = MisfitSettings()
        found = log_ratios(before, after, reading, followed, own, generator=generator(4), stuck=stuck)
        ratio.append(dict(zip(ISLAND_FAULTS, found.tolist(), strict=True)))
    assert ratio[1]["second object"] == pytest.approx(ratio[0]["second object"] + math.log(ALIKE))
    assert ratio[1]["stuck hand"] == pytest.approx(6.9)


def test_one_touch_of_nothing_is_no_fault_where_pads_are_stated_to_have_some(box, prior):
    away = PLACE - torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    reading = felt_by(box, pose(prior, away), towards(-0.258, count=12))
    assert 0 < int(reading.in_contact.sum()) <= 2
    alarms = []
    for false in (0.0, 2e-4):
        filtering = follow(box, prior, IslandFilter, unseen_particles=900, islands=3, false=false)
        ratio, _ = told(filtering, known(filtering, prior), reading)
        test = ChangeTest(tuple(IN_SPACE.values()), 0.02)
        ratios = torch.tensor([ratio.get(name, 0.0) for name in IN_SPACE], dtype=torch.float64)
        alarms.append(bool(test.alarm(test.update(test.begin(), ratios))))
    assert alarms == [True, False]


@pytest.mark.parametrize(("away", "false", "is_false"), [(0.3, 2e-4, True), (0.3, 0.0, False), (0.0, 2e-4, False)])
def test_a_brief_first_touch_where_hardly_any_of_the_prior_is_may_be_false(box, prior, away, false, is_false):
    """Pads feel falsely by .0002 an instant each: by 1 - .9998^(2 * 12) an action, and a touch is brief by .1."""
    filtering = follow(box, prior, IslandFilter, unseen_particles=900, islands=3, false=false)
    there = PLACE - torch.tensor([away, 0.0, 0.0], dtype=torch.float64)
    reading = felt_by(box, pose(prior, there), towards(-0.057 - away, count=12))
    assert 0 < int(reading.in_contact.sum()) <= 2
    before = begin(filtering, prior)[0]
    ratio, _ = told(filtering, before, reading)
    stated = 1.0 - (1.0 - false) ** 24
    expected = math.log(0.3 * 0.8 / (0.001 * 0.1 + stated)) if is_false else 0.0
    assert ratio["false contacts"] == pytest.approx(expected)
    ratios = torch.tensor([ratio[name] for name in ISLAND_FAULTS])
    assert false_touch(ratios, reading, filtering) == is_false
    ratios[ISLAND_FAULTS.index("knocked")] = 9.0  # an object that is elsewhere is no false touch
    assert not false_touch(ratios, reading, filtering)
    assert by_brief_touch(MisfitSettings(), stated) == pytest.approx(math.log(0.1 / (0.001 * 0.1 + stated)))


def test_a_first_touch_of_an_unknown_place_is_not_asked_about(box, prior):
    filtering = follow(box, prior, IslandFilter, unseen_particles=900, islands=3, false=2e-4)
    reading = felt_by(box, pose(prior), towards(-0.055, count=6))
    nowhere = replace(reading, observation=reading.observation[reading.instant < 0], instant=reading.instant[:0])
    brief = reading.in_contact & (reading.in_contact.cumsum(0) == 1)
    ratio, _ = told(filtering, begin(filtering, prior)[0], replace(nowhere, in_contact=brief))
    assert int(brief.sum()) == 1 and ratio["false contacts"] == 0.0


def test_a_long_first_touch_is_never_false(box, prior):
    filtering = follow(box, prior, IslandFilter, unseen_particles=900, islands=3, false=2e-4)
    there = PLACE - torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)
    path = towards(-0.35, count=6)
    reading = felt_by(box, pose(prior, there), torch.cat((path, path[-1:].expand(4, 4))))
    assert int(reading.in_contact.sum()) > 2
    ratio, _ = told(filtering, begin(filtering, prior)[0], reading)
    assert ratio["false contacts"] == 0.0


def test_a_run_leaves_out_what_is_felt_falsely_and_no_knock(box, prior):
    filtering = follow(box, prior, IslandFilter, unseen_particles=90, islands=3, false=2e-4)
    names, _ = all_faults_of(filtering)
    assert names[: len(ISLAND_FAULTS)] == ISLAND_FAULTS
    reading = felt_by(box, pose(prior), towards(-0.055, count=6))
    brief = reading.in_contact & (reading.in_contact.cumsum(0) == 1)
    record = make_up(2, particles=2).steps[1]
    for contact, knocked, strange in ((brief, 0.0, True), (brief, 3.0, False), (~brief, 0.0, False)):
        told_by = dict.fromkeys(names, 0.0) | {"false contacts": 2.0, "knocked": knocked}
        felt = replace(record, reading=replace(reading, in_contact=contact))
        assert _is_strange(torch.tensor([told_by[name] for name in names]), names, felt, filtering) == strange
