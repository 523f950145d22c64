"""What a run that ends without being sure was most likely lost by."""

import math
from dataclasses import replace

import pytest
import torch

from rumi import loop
from rumi.belief.change_test import ChangeTest
from rumi.belief.initialise import InitialiseSettings
from rumi.belief.misfit import MISFITS, MisfitSettings
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.fields.workspace import Workspace
from rumi.planning.rummaging import RummagingPolicy
from rumi.registration.descent import DescentSettings
from rumi.robot.tool import Tool
from rumi.runs.replay import LogTask, Repeat
from rumi.tasks.rummage import agent
from rumi.tasks.rummage import last_word as module
from rumi.tasks.rummage.explanations import all_faults_of
from rumi.tasks.rummage.fault_state import Watch
from rumi.tasks.rummage.last_word import last_word
from sdf import se3
from sdf.object_model import box_model
from sensors.discrepancy import Discrepancy
from sensors.log.reader import Taken
from sensors.observation import Observation
from tests.fixtures.made_up_run import make_up
from tests.fixtures.readings import make_reading

RECORD = make_up(2, particles=2).steps[1]
OWN = MisfitSettings()


@pytest.fixture(scope="module")
def pose_filter():
    model = box_model(spacing=0.004, points=100)
    return PoseFilter(FilterSettings(), [Discrepancy(model.sdf, model.radius)], "SE(2)")


def after(pose_filter, name, nats, **known):
    """What is known after one reading that speaks for one fault alone."""
    names, shares = all_faults_of(pose_filter)
    test = ChangeTest(shares, OWN.alpha)
    ratios = torch.tensor([nats if one == name else -math.inf for one in names], dtype=torch.float64)
    evidence = test.update(test.begin(), ratios)
    assert not bool(test.alarm(evidence))
    return Watch(evidence=evidence, **known)


@pytest.mark.parametrize(
    ("name", "share", "unsure", "nats", "is_told"),
    [
        ("absent", 0.25, 1.0, 1.9, False),
        ("absent", 0.25, 1.0, 2.1, True),
        ("knocked", 0.6, 0.2, 2.6, False),
        ("knocked", 0.6, 0.2, 2.8, True),
    ],
)
def test_a_fault_that_is_likelier_than_none_is_told(pose_filter, name, share, unsure, nats, is_told):
    """One run in five has a fault, from a first reading on in half of them; one in five ends without being sure.

    All do of an absent object, a quarter of the faults: .2 * .25 / 2 * e^r against .2 * (.2 / 2 + .8), even at 1.97
    nats, where an alarm takes 5.97; of one that was knocked, .6 of them, .2 * .6 / 2 * e^r against .9, at 2.71.
    """
    now, record = last_word(after(pose_filter, name, nats), RECORD, pose_filter, OWN)
    assert now.lost == is_told and [remark.name for remark in record.remarks] == is_told * [f"lost: {name}"]
    assert not is_told or (now.named == name and record.explanations == now.explanations)
    odds = 0.1 * share * math.exp(nats) * unsure / (0.9 * 0.2)
    assert not is_told or now.explanations[name] == pytest.approx(odds / (1.0 + odds))


def test_nothing_is_told_where_nothing_is_asked_or_it_was_told(pose_filter):
    known = after(pose_filter, "absent", 5.0)
    for now, own in ((known, MisfitSettings(0.0)), (replace(known, lost=True), OWN), (Watch(), OWN)):
        assert last_word(now, RECORD, pose_filter, own) == (now, RECORD)


def test_no_run_fails_by_contacts_that_were_left_out(pose_filter, monkeypatch):
    known = after(pose_filter, MISFITS[0], 5.0)
    told, _ = last_word(known, RECORD, pose_filter, OWN)
    assert told.lost
    monkeypatch.setattr(module, "named", lambda _: ("false contacts", 0.9))
    assert last_word(known, RECORD, pose_filter, OWN) == (known, RECORD)


@pytest.mark.parametrize(("steps", "asked"), [(2, [2]), (3, []), (None, [])])
def test_it_is_asked_at_the_last_action_of_a_run_that_is_not_sure(monkeypatch, steps, asked):
    def told(now, record, *_):
        called.append(record.step)
        return replace(now, lost=True), record

    called = list[int]()
    monkeypatch.setattr(agent, "last_word", told)
    box = box_model()
    prior = PosePrior.of((0.4, 0.0), 0.02, box.sdf.bounds, ("z",))
    bounds = torch.tensor([[0.2, -0.2, 0.02], [0.6, 0.2, 0.02]])
    nothing = make_reading(Observation.empty(), motion=se3.identity((1,)), contact=False)
    taken = [Taken(nothing, None, None, None), *(Taken(nothing, torch.zeros(3), None, None) for _ in range(2))]
    rummager = agent.Rummager(
        box,
        PoseFilter(
            FilterSettings(descent=DescentSettings(iterations=1)), [Discrepancy(box.sdf, box.radius)], "SE(3)", prior
        ),
        RummagingPolicy(torch.ones(0)),
        Workspace.from_bounds(bounds, 0.05, planar_height=0.02),
        Tool(bounds[:, :2]),
        initialise=InitialiseSettings(particles=20),
        steps=steps,
    )
    result = loop.run(LogTask(taken), Repeat(rummager, [torch.zeros(3)] * 2), seed=0, steps=2)
    assert called == asked and result.lost == bool(asked) and result.stopped_by == "steps"
