"""Retreat: the tool goes back to where it felt nothing, from what leans on it and before a run is sure, and not far."""

import math
from dataclasses import replace

import pytest
import torch

import rumi
from rumi.belief.island_filter import IslandFilter
from rumi.clock import Clock
from rumi.tasks.rummage import evaluation
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.retreat import way_back
from tests.fixtures.readings import make_reading
from tests.test_tasks.rummage.test_trajectory_runs import settings

SCALE = torch.tensor([0.08, 0.08, 0.08, 0.5])
HERE = torch.tensor([0.41, 0.02, 0.1, -3.1])


def came(*steps):
    """Readings of (configuration, whether each instant felt anything)."""
    return [
        make_reading(
            tool=torch.eye(4).repeat(len(felt), 1, 1), contact=torch.tensor(felt).bool(), configuration=configuration
        )
        for configuration, felt in steps
    ]


def test_the_way_back_is_that_of_the_last_action_and_short():
    short = way_back(came((torch.tensor([0.4, 0.0, 0.1, 3.1]), [0]), (HERE, [0, 1])), SCALE)
    turned = 2.0 * math.pi - 6.2  # the nearer way round
    torch.testing.assert_close(short, torch.tensor([-0.125, -0.25, 0.0, -turned / 0.5]), atol=1e-5, rtol=0)
    long = way_back(came((HERE + torch.tensor([0.0, 0.0, 0.1, 0.3]), [1, 0]), (HERE, [1])), SCALE)
    torch.testing.assert_close(long, torch.tensor([0.0, 0.0, 0.5, 0.24]), atol=1e-5, rtol=0)
    assert way_back(came((HERE, [0]), (HERE, [1])), SCALE) is None
    assert way_back(came((HERE + torch.tensor([0.0, 0.0, 0.0, 0.2]), [0]), (HERE, [1])), SCALE) is None


def test_the_way_back_is_to_where_nothing_was_felt():
    far, near = HERE + torch.tensor([0.03, 0.0, 0.0, 0.0]), HERE + torch.tensor([0.01, 0.0, 0.0, 0.0])
    back = way_back(came((HERE + 1.0, [0]), (far, [1, 1, 0]), (near, [0, 1]), (HERE, [1])), SCALE)
    torch.testing.assert_close(back, torch.tensor([0.03 / 0.08, 0.0, 0.0, 0.0]), atol=1e-5, rtol=0)
    assert way_back(came((near, [1]), (HERE, [1])), SCALE) is None
    assert way_back(came((HERE, [0])), SCALE) is None


@pytest.mark.sim
@pytest.mark.parametrize("asked", [None, False])
def test_a_run_in_space_goes_back_once_where_it_leans(asked, all_in_reach, monkeypatch):
    own = replace(settings(), task="drill-0", steps=3, retreats=asked)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False))
    few = replace(own.filter.trajectories, unseen_particles=20)
    monkeypatch.setattr(IslandFilter, "leaning", lambda *_: 0.6)
    records = []
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        assert agent.retreats == (asked is None)
        rumi.run(sim, agent, seed=0, on_step=records.append)
    planned = [record.plan is not None for record in records[1:]]
    assert planned == ([True, False, True] if asked is None else [True, True, True])
    if asked is None:
        there = records[2].reading.configuration - records[1].reading.configuration
        back = records[1].reading.configuration - records[0].reading.configuration
        assert float((there * back)[:3].sum()) < 0.0 and float(there[:3].norm()) < 0.05


def test_a_mug_never_retreats(all_in_reach):
    with build(rumi.preset("fast", task="mug", conditions="lab"), cache_dir=all_in_reach) as (_, agent):
        assert not agent.retreats


@pytest.mark.sim
@pytest.mark.parametrize(
    ("retreats", "felt", "lets_go"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_a_run_lets_go_before_it_is_sure(retreats, felt, lets_go, all_in_reach):
    own = replace(settings(), task="drill-0", steps=3, retreats=retreats)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False), stop=replace(own.stop, further=0))
    few = replace(own.filter.trajectories, unseen_particles=20)
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        state = agent.begin(sim.reset(0), seed=0, clock=Clock())
        assert agent.stop(state) is None
        state, control = agent.act(state)
        found = sim.step(control).reading
        felt_at_the_end = torch.zeros_like(found.in_contact)
        felt_at_the_end[-1] = felt
        record = replace(state.record, step=1, reading=replace(found, in_contact=felt_at_the_end), converged=True)
        state = replace(state, record=record, history=(*state.history, record))
        assert agent.stop(state) == (None if lets_go else "sure")
        if lets_go:
            after, back = agent.act(state)
            assert after.plan is None and after.retreated == 1
            stuck = replace(state, retreated=4)  # a pad that feels wherever it is
            assert agent.stop(stuck) == "sure" and agent.act(stuck)[0].plan is not None
            assert float((back * control)[:3].sum()) < 0.0
            begun = state.history[0].reading.configuration
            there = replace(record, step=2, reading=replace(record.reading, configuration=begun))
            state = replace(after, record=there, history=(*state.history, there))
            assert agent.stop(state) == "sure"  # felt where it never touched: there is nowhere to go back to


@pytest.mark.sim
@pytest.mark.parametrize(
    ("held", "holds_on", "retreats", "expected"),
    [
        (True, False, True, True),
        (True, True, True, False),
        (False, False, True, False),
        (True, False, False, False),
    ],
)
def test_less_is_asked_for_only_once_it_has_let_go(held, holds_on, retreats, expected, all_in_reach, monkeypatch):
    own = replace(settings(), task="drill-0", steps=3, retreats=retreats)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False))
    few = replace(own.filter.trajectories, unseen_particles=20)
    asked = []
    monkeypatch.setattr(evaluation, "converged", lambda rule, evidence: bool(asked.append(evidence)))
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        result = sim.reset(0)
        state = agent.begin(result, seed=0, clock=Clock())
        at = [torch.tensor([touches]) for touches in (held, holds_on)]
        readings = [replace(result.reading, in_contact=each, tool_pose=result.reading.tool_pose[:1]) for each in at]
        last = replace(state.record, reading=readings[0], converged=True)
        now = replace(result, reading=readings[1])
        evaluation.evaluate_step(agent, Clock(), (last,), now, state.record.belief, state.record.added)
    assert asked[-1].let_go is expected


@pytest.mark.sim
@pytest.mark.parametrize(
    ("further", "steps", "stops"),
    [
        (None, [(True, True)], False),  # sure by a touch, and sure or touched, as each step is
        (None, [(True, True), (True, True)], True),
        (None, [(True, True), (True, False)], False),
        (None, [(True, False), (True, False), (True, True)], True),
        (None, [(True, True), (False, True), (True, True)], False),
        (0, [(True, True)], True),
        (2, [(True, True), (True, True)], False),
        (2, [(True, True), (True, True), (True, False), (True, True)], True),
        (0, [(True, True), (False, True)], False),
    ],
)
def test_a_belief_in_space_has_to_stay_sure_through_a_further_touch(further, steps, stops, all_in_reach):
    own = replace(settings(), task="drawn-shelf-box", steps=9)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False), stop=replace(own.stop, further=further))
    few = replace(own.filter.trajectories, unseen_particles=20)
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        assert not agent.retreats and agent.stop_rule.further == (1 if further is None else further)
        state = agent.begin(sim.reset(0), seed=0, clock=Clock())
        for sure, touched in steps:
            reading = replace(state.record.reading, in_contact=torch.tensor([touched]))
            record = replace(state.record, step=state.record.step + 1, converged=sure, reading=reading)
            state = replace(state, record=record, history=(*state.history, record))
        assert agent.stop(state) == ("sure" if stops else None)
        if not stops and steps[-1][0]:
            assert "no further touch" in agent.result(state, "steps", None).why_not


def test_drills_let_go_and_mugs_are_seen(all_in_reach):
    for task in ("drill", "mug"):
        with build(rumi.preset("fast", task=task, conditions="lab"), cache_dir=all_in_reach) as (_, agent):
            assert not agent.stop_rule.further
