"""A run that is lost: the test of its readings, and the search that begins anew from one of them."""

import math
from dataclasses import replace

import pytest
import torch

from rumi import seeding
from rumi.belief.island_filter import IslandFilter
from rumi.belief.misfit import MISFITS, MisfitSettings
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.belief.remarks import Remark
from rumi.belief.rival_filters import Rival
from rumi.tasks.rummage import lost
from rumi.tasks.rummage.entry import ENTRIES, Rummaging, ending
from rumi.tasks.rummage.explanations import (
    HAND_OR_CAMERA,
    IN_SPACE,
    NOTHING_FELT,
    PRIOR,
    SEARCHED,
    STATIC,
    all_faults_of,
    given,
    named,
)
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.lost import told, unseated, watch
from rumi.tasks.rummage.recovery import searched_again
from sdf import se3
from sdf.object_model import box_model
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from tests.fixtures.box_in_space import begin, felt_by, follow, towards
from tests.fixtures.made_up_run import make_up

OWN = MisfitSettings()
MADE_UP = make_up(2, particles=2)
ALL = (*PRIOR, *STATIC), (*PRIOR.values(), *STATIC.values())


@pytest.fixture(scope="module")
def model():
    return box_model(spacing=0.004, points=100)


@pytest.fixture(scope="module")
def pose_filter(model):
    return PoseFilter(FilterSettings(), [Discrepancy(model.sdf, model.radius)], "SE(2)")


def face(model, x):
    """Points of a side of a box that stands at x."""
    low = model.exact.bounds[0]
    y = 0.5 * float(low[1]) * torch.tensor([-1.0, 0.0, 1.0])
    return torch.stack((torch.full_like(y, x + float(low[0])), y, torch.zeros(3)), -1)


def step(model, number, felt_at, free_at=None, spread=1e-3):
    """A step whose belief has the box at the origin."""
    normal = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    belief = PoseBelief.uniform(se3.from_planar(spread * normal))
    parts = [Observation.empty()] if felt_at is None else [Observation.of(face(model, felt_at), Semantics.SURFACE)]
    if free_at is not None:
        parts.append(Observation.of(torch.tensor([[free_at, 0.0, 0.0]]), Semantics.FREE))
    return replace(MADE_UP.steps[1], step=number, belief=belief, added=concatenate(parts))


def followed(model, pose_filter, steps, own=OWN):
    now, found, generator = Watch(), [], torch.Generator().manual_seed(0)
    for record in steps:
        now, remark = watch(now, record, record, pose_filter, model, own, generator=generator)
        found.append((now, now.nats, remark))
    return found


def test_what_fits_says_nothing_however_often(model, pose_filter):
    steps = [step(model, number, 0.0) for number in range(1, 31)]
    assert all(remark is None and nats < 0.1 for _, nats, remark in followed(model, pose_filter, steps))


def test_a_surface_off_twice_is_a_knock_and_is_dated(model, pose_filter):
    steps = [step(model, number, 0.0 if number < 6 else -0.03) for number in range(1, 9)]
    found = followed(model, pose_filter, steps)
    remark = next(remark for _, _, remark in found if remark is not None)
    assert remark.name == "lost: knocked"
    assert remark.step in (6, 7)
    assert "since about action 6" in remark.sentence
    now = found[remark.step - 1][0]
    assert now.evidence is None and now.begun == remark.step and not now.lost


def test_what_is_told_of_a_step_is_the_reading_s_p_value_and_the_chance_of_each_fault(model, pose_filter):
    steps = [step(model, number, 0.0 if number < 3 else -0.03) for number in range(1, 4)]
    (*_, fits), (now, _, alarm) = (found for found in followed(model, pose_filter, steps)[1:])
    assert fits is None
    record = told(steps[2], now, alarm)
    assert record.p_value < 0.05 and record.remarks[-1] is alarm
    assert record.explanations.keys() == {"no fault", *MISFITS} and now.named == "knocked"
    assert sum(record.explanations.values()) == pytest.approx(1.0)
    assert record.explanations["knocked"] > 0.5
    quiet = followed(model, pose_filter, steps[:2])[-1][0]
    assert quiet.p_value == 1.0 and quiet.explanations["no fault"] > 0.8


def test_of_a_touch_that_was_none_the_belief_before_goes_on(model, pose_filter):
    before, record = step(model, 2, 0.0), step(model, 3, -0.3, spread=2e-3)
    generator = torch.Generator().manual_seed(0)
    known, after = before.added, concatenate([before.added, record.added])
    belief, memory = searched_again(
        (before, record), after, pose_filter, OWN, Watch(named="false contacts"), before=known, generator=generator
    )
    assert belief is before.belief and memory is known


def test_an_absent_object_leaves_the_run_lost(model, pose_filter):
    steps = [step(model, number, None, free_at=0.0) for number in range(1, 6)]
    found = followed(model, pose_filter, steps)
    assert [remark.name for _, _, remark in found if remark is not None] == ["lost: absent"]
    assert found[-1][0].lost


def test_faults_that_nothing_tells_apart_are_named_together():
    even = {"no fault": 0.1, "knocked": 0.4, "absent": 0.25, "dead hand": 0.25}
    assert named(even) == (NOTHING_FELT, 0.5)
    assert named(even | {"dead hand": 0.2}) == ("knocked", 0.4)
    assert named({"no fault": 0.5, "knocked": 0.2, "absent": 0.3}) == ("absent", 0.3)
    beside = even | {"hand off": 0.5, "camera off": 0.1}
    assert named(beside) == (HAND_OR_CAMERA, 0.6)
    assert named(beside | {"camera off": 0.01}) == ("hand off", 0.5)


def test_an_alarm_waits_for_two_telling_actions_at_most_where_its_fault_is_not_clear(model, pose_filter, monkeypatch):
    both = torch.tensor([9.0, 9.5, -9.0], dtype=torch.float64)  # knocked or absent
    given = iter((both, 0.0 * both, both - both.mean(), torch.tensor([9.0, -9.0, -9.0], dtype=torch.float64)))
    monkeypatch.setattr(lost, "_ratios", lambda *_: (next(given), 0.0))
    steps = [step(model, number, 0.0) for number in range(1, 5)]
    found = followed(model, pose_filter, steps)
    assert [now.waited for now, _, _ in found[:3]] == [1, 1, 2]
    assert [remark and remark.name for _, _, remark in found] == [None, None, None, "lost: knocked"]
    assert all(now.doubt() is not None for now, _, _ in found[:3]) and found[-1][0].waited == 0


def test_an_alarm_of_another_name_waits_while_the_hand_repeats_itself(model, pose_filter, monkeypatch):
    knocked = torch.tensor([9.0, -9.0, -9.0], dtype=torch.float64)
    steps = [step(model, number, 0.0) for number in range(1, 4)]
    for repeated, alarms in ((0.0, [True, True, True]), (5.0, [False, False, True])):
        monkeypatch.setattr(lost, "_ratios", lambda *_, repeated=repeated: (knocked, repeated))
        assert [remark is not None for _, _, remark in followed(model, pose_filter, steps)] == alarms


@pytest.mark.parametrize(("again", "alarmed"), [(0.0, False), (20.0, True)])
def test_an_alarm_by_a_rival_is_asked_again(model, pose_filter, monkeypatch, again, alarmed):
    asked = Rival("hand off", 0.0, None, None, torch.zeros(1), 0.0)

    def told(nats):
        return (asked,), dict.fromkeys(STATIC, -math.inf) | {"hand off": nats}

    monkeypatch.setattr(lost, "follows", lambda _: True)
    monkeypatch.setattr(lost, "static_of", lambda _: STATIC)
    monkeypatch.setattr(lost, "all_faults_of", lambda _: ALL)
    monkeypatch.setattr(lost, "_ratios", lambda *_: (torch.zeros(len(PRIOR), dtype=torch.float64), 0.0))
    monkeypatch.setattr(lost, "_rivals", lambda *_: told(20.0))
    monkeypatch.setattr(lost, "_asked_again", lambda *_: told(again))
    monkeypatch.setattr(lost.rival_filters, "is_asked_again", lambda _: False)
    [(now, _, remark)] = followed(model, pose_filter, [step(model, 1, 0.0)])
    assert (remark is not None) == alarmed and now.static["hand off"] == again
    assert remark is None or remark.name == "lost: hand off"


@pytest.mark.parametrize(("nats", "asked"), [(4.0, False), (8.0, True)])
def test_in_space_a_size_is_asked_again_as_soon_as_a_run_is_not_sure(pose_filter, model, monkeypatch, nats, asked):
    """Of a size by as many nats: enough for a doubt, and for no alarm."""
    names, shares = all_faults_of(pose_filter)
    called = list[int]()

    def again(rivals, *_):
        called.append(1)
        return rivals, {"another size": 0.0}

    rival = Rival("another size", 0.0, None, None, torch.zeros(1), 0.0)
    monkeypatch.setattr(lost, "IslandFilter", type(pose_filter))
    monkeypatch.setattr(lost, "static_of", lambda _: {"another size": 0.1})
    monkeypatch.setattr(lost, "_is_strange", lambda *_: False)
    monkeypatch.setattr(lost, "all_faults_of", lambda _: ((*names, "another size"), (*shares, 0.1)))
    monkeypatch.setattr(lost, "_ratios", lambda *_: (torch.zeros(len(names), dtype=torch.float64), 0.0))
    monkeypatch.setattr(lost, "_rivals", lambda *_: ((rival,), {"another size": nats - 1.0}))
    monkeypatch.setattr(lost, "_asked_again", again)
    [(now, _, remark)] = followed(model, pose_filter, [step(model, 1, 0.0)])
    assert bool(called) == asked and remark is None
    assert now.static["another size"] == (0.0 if asked else nats - 1.0)


def test_a_reading_with_a_false_touch_that_is_no_fault_is_left_out_and_told(model, pose_filter, monkeypatch):
    ratios = torch.zeros(len(PRIOR), dtype=torch.float64)
    ratios[list(PRIOR).index("false contacts")] = 3.0
    monkeypatch.setattr(lost, "follows", lambda _: True)
    monkeypatch.setattr(lost, "static_of", lambda _: STATIC)
    monkeypatch.setattr(lost, "all_faults_of", lambda _: ALL)
    monkeypatch.setattr(lost, "_ratios", lambda *_: (ratios, 0.0))
    monkeypatch.setattr(lost, "_rivals", lambda *_: (None, dict.fromkeys(STATIC, 0.0)))
    last, record = step(model, 1, 0.0), step(model, 2, 0.3)
    [(now, _, remark)] = followed(model, pose_filter, [record])
    assert remark is None and now.set_aside and not now.lost
    assert [odd.name for odd in told(record, now).remarks] == ["false touch"]
    memory, random = Observation.empty(), torch.Generator()
    belief, kept = searched_again((last, record), record.added, pose_filter, OWN, now, before=memory, generator=random)
    assert belief is last.belief and kept is memory
    [(left, _, _)] = followed(model, pose_filter, [record], replace(OWN, recover=False))
    assert not left.set_aside
    ratios[list(PRIOR).index("false contacts")] = 20.0  # now it is a fault, which drops the reading too
    [(now, _, remark)] = followed(model, pose_filter, [record])
    assert remark is not None and remark.name == "lost: false contacts" and not now.set_aside


def test_what_was_not_felt_and_is_felt_again_elsewhere_is_searched_for(model, pose_filter):
    steps = [step(model, number, None, free_at=0.0) for number in range(1, 6)]
    steps += [step(model, 6, -0.03)]
    reading = steps[-1].reading
    steps[-1] = replace(steps[-1], reading=replace(reading, in_contact=torch.ones_like(reading.in_contact)))
    found = followed(model, pose_filter, steps)
    names = [(remark.name, now.lost) for now, _, remark in found if remark is not None]
    assert names[0] == ("lost: absent", True) and names[1][1] is False and len(names) == 2
    assert names[1][0].removeprefix("lost: ") in SEARCHED


def test_a_probability_given_some_explanations_is_their_share():
    even = given({"a": 0.0, "b": 0.0, "no fault": 1.0}, ("a", "b"))
    assert even == {"a": 0.5, "b": 0.5}
    assert given({"a": 0.1, "b": 0.3, "no fault": 0.6}, ("a", "b")) == pytest.approx({"a": 0.25, "b": 0.75})


@pytest.mark.parametrize(("felt", "sought", "said"), [(True, 1, "knocked"), (False, 1, None), (True, None, None)])
def test_what_was_searched_for_and_is_felt_again_is_lost_no_more(model, pose_filter, felt, sought, said):
    """However well the belief, begun about where it was, explains the touch; without a search an alarm is due first."""
    record = step(model, 7, 0.0)
    record = replace(
        record, reading=replace(record.reading, in_contact=torch.full_like(record.reading.in_contact, felt))
    )
    before, random = Watch(named="absent", lost=True, unfelt_since=sought), torch.Generator().manual_seed(0)
    now, remark = watch(before, record, record, pose_filter, model, OWN, generator=random)
    assert (None if remark is None else remark.name) == (said and f"lost: {said}")
    assert now.lost == (said is None) and now.unfelt_since == (None if said else sought)


def test_without_recovery_an_alarm_leaves_the_run_lost_and_0_never_asks(model, pose_filter):
    steps = [step(model, number, -0.03) for number in range(1, 6)]
    assert followed(model, pose_filter, steps, replace(OWN, recover=False))[-1][0].lost
    assert all(
        nats == 0.0 and remark is None for _, nats, remark in followed(model, pose_filter, steps, MisfitSettings(0.0))
    )


def test_a_reading_that_speaks_for_a_fault_is_no_time_to_be_sure(model, pose_filter):
    own = replace(OWN, alpha=1e-6)  # no alarm yet
    silent = [step(model, number, None) for number in range(20)]
    assert all(now.doubt() is None for now, _, _ in followed(model, pose_filter, silent))
    steps = [step(model, 1, 0.0), step(model, 2, -0.03), *(step(model, number, 0.0) for number in range(3, 12))]
    doubts = [now.doubt() is not None for now, _, _ in followed(model, pose_filter, steps, own)]
    assert doubts[:2] == [False, True] and not doubts[-1]
    assert Watch().doubt() is None


def test_a_last_touch_beside_every_pose_is_no_time_to_be_sure():
    assert Watch(beside_m=0.001).doubt() is None
    assert "3 mm beside every pose" in (Watch(beside_m=0.003).doubt() or "")


def test_what_may_have_tipped_is_doubted_and_odd_heights_until_a_touch_says_otherwise():
    tips, high, resists = (Remark(name, 3, "") for name in ("tips", "other height", "resists"))
    assert unseated(None, (resists, tips, high), True) == "tips" and unseated(None, (high,), True) == "other height"
    assert unseated(None, (resists,), True) is None and unseated(None, (), False) is None
    assert unseated("other height", (), False) == "other height"
    assert unseated("other height", (resists,), True) is None
    assert unseated("tips", (resists,), True) == "tips"
    assert "'tips' was remarked" in (Watch(unseated="tips").doubt() or "")


def test_a_search_finds_the_object_by_the_reading_alone(model, pose_filter):
    record = step(model, 3, -0.03)
    generator = torch.Generator().manual_seed(0)
    belief, memory = searched_again(
        (record, record),
        record.added,
        pose_filter,
        OWN,
        Watch(named="knocked"),
        before=Observation.empty(),
        generator=generator,
    )
    assert belief.log_weights.shape == record.belief.log_weights.shape
    assert len(memory.points[memory.valid]) == 3
    felt = face(model, -0.03)
    off = model.sdf.distance(se3.apply(se3.inverse(belief.world_T_object), felt)).abs().median(-1).values
    assert float(off.median()) < 5e-3


def test_a_lost_run_says_so_and_does_not_succeed():
    record = replace(MADE_UP.steps[1], lost=7.5)
    result = replace(MADE_UP.result, stopped_by="sure", lost=False)
    entry = ENTRIES["mug-0"]
    assert entry.success(result) and not entry.success(replace(result, lost=True))
    assert ending(replace(result, lost=True))[0].startswith("lost; ")
    assert "lost 7.5" in Rummaging().describe(record) and "lost" not in Rummaging().describe(replace(record, lost=0.2))


@pytest.mark.parametrize(("false", "most"), [(0.0, 30.0), (2e-4, math.log(0.1 / (0.0001 + 1.0 - 0.9998**24)))])
def test_a_touch_that_may_be_false_hardly_speaks_for_something_unknown(false, most, monkeypatch):
    """A first touch far from all of a prior, by a pad at the last of twelve instants."""
    box = box_model(spacing=0.003)
    prior = PosePrior.of((0.0, 0.0), 0.02, box.exact.bounds, ("x", "z"))
    filtering = follow(box, prior, IslandFilter, unseen_particles=900, islands=3, false=false)
    reading = felt_by(
        box, se3.from_planar(torch.tensor([-0.29, 0.005, 0.0])) @ prior.ways[1], towards(-0.357, count=12)
    )
    before, memory = begin(filtering, prior)
    after, _, _ = filtering(before, memory, reading, generator=seeding.generator(3))
    monkeypatch.setattr(lost, "log_ratios", lambda *_: torch.full((len(MISFITS),), 30.0, dtype=torch.float64))
    last = replace(MADE_UP.steps[0], belief=before, reading=reading)
    steps = last, replace(MADE_UP.steps[1], belief=after, reading=reading)
    ratios, _ = lost._ratios(steps, filtering, box, OWN, seeding.generator(4), False)
    assert float(ratios[list(IN_SPACE).index("none of these")]) == pytest.approx(most)
