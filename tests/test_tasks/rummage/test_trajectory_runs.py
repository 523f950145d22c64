"""Runs without a sensor of the object's motion, by trajectories: what is refused, and when they stop."""

import math
from dataclasses import replace

import pytest
import torch

import rumi
from rumi.belief.particles import PoseBelief
from rumi.errors import UsageError
from rumi.information.stopping import StopEvidence, StopSettings, converged, shortfalls, turns
from rumi.tasks.rummage.build import build
from sdf import se3
from sdf.symmetry import Symmetries


def settings(**changes):
    chosen = rumi.preset("fast", task="mug", seed=1000, steps=2, **changes)
    few = replace(chosen.filter.trajectories, particles=20, branches=2, rounds=1)
    return replace(
        chosen,
        filter=replace(chosen.filter, motion="trajectory", trajectories=few),
        stop=replace(chosen.stop, rule="probability"),
        planner=replace(chosen.planner, mppi=replace(chosen.planner.mppi, samples=20), rollouts=1),
    )


@pytest.mark.sim
@pytest.mark.parametrize("task", ["drill-0", "drawn-shelf-box"])
def test_objects_in_space_are_followed_from_their_prior(task, all_in_reach):
    own = settings()
    own = replace(own, task=task, simulator=replace(own.simulator, measures_motion=False))
    few = replace(own.filter.trajectories, unseen_particles=20)
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        result = rumi.run(sim, agent, seed=0)
        assert agent.stop_rule.rule == "probability"
    assert result.stopped_by == "steps" and result.final_nll is not None


@pytest.mark.parametrize(
    ("motion", "measures", "rule", "taken"),
    [
        ("auto", False, "auto", "probability"),
        ("auto", True, "auto", "probability"),
        ("measured", True, "auto", "auto"),
        ("auto", False, "self", "self"),
    ],
)
def test_the_rule_that_suits_is_that_of_the_probability_in_space(motion, measures, rule, taken, all_in_reach):
    own = rumi.preset("fast", task="drill-0", seed=1000, conditions="ideal", **{"filter.motion": motion})
    own = replace(own, stop=replace(own.stop, rule=rule), simulator=replace(own.simulator, measures_motion=measures))
    with build(own, cache_dir=all_in_reach) as (_, agent):
        assert agent.stop_rule.rule == taken


def test_other_sensors_and_evidence_are_refused():
    own = settings()
    camera = replace(own, simulator=replace(own.simulator, sensors=replace(own.simulator.sensors, kind="camera")))
    wrench = replace(own, filter=replace(own.filter, evidence=("contact-points",)))
    for odd in (camera, wrench):
        with pytest.raises(UsageError, match=r"Expected --[a-z.]+ [a-z]+ with"):
            build(odd)


def test_the_probability_of_being_right_is_the_weight_within_the_tolerance():
    near, far = torch.zeros(3, 3), torch.tensor([[0.02, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = se3.from_planar(torch.cat((near, far)))
    belief = PoseBelief.uniform(poses).reweighted(torch.tensor([0.3, 0.2, 0.1, 0.15, 0.25]).log())
    none = Symmetries.none()
    for metres, expected in ((0.005, 0.6), (0.03, 0.75)):
        assert belief.probability_right(none, within_m=metres, within_rad=0.17) == pytest.approx(expected, abs=1e-6)
        assert belief.summary(none, within_m=metres, within_rad=0.17).probability == pytest.approx(expected, abs=1e-6)


def test_a_run_stops_where_it_is_probably_right_and_has_touched():
    rule, state = StopSettings(rule="probability"), {"expected_nll": 9.0, "fit": 9.0, "apc": 1.0, "diagonal": 0.1}
    for p, contacts, sure in ((0.96, 1, True), (0.94, 1, False), (0.99, 0, False), (float("nan"), 3, False)):
        evidence = StopEvidence(**state, contacts=contacts, p_right=p)
        assert converged(rule, evidence) is sure is not bool(shortfalls(rule, evidence))
    # poses that are all right may still lie too far apart
    evidence = StopEvidence(**state, contacts=1, p_right=0.96)
    for most, sure in ((9.0, True), (8.9, False)):
        asked = StopSettings(rule="probability", most_nll=most)
        assert converged(asked, evidence) is sure
        assert [short.part for short in shortfalls(asked, evidence)] == ([] if sure else ["nll"])
    with pytest.raises(UsageError, match="probability"):
        StopSettings(probability=0.0)


def test_who_counts_few_particles_needs_more_of_them_to_stop():
    """Else a run stops by the noise of the count, which it looks at after every action."""
    rule, state = StopSettings(rule="probability"), {"expected_nll": 9.0, "fit": 9.0, "apc": 1.0, "diagonal": 0.1}
    for right, draws, sure in (
        (386, 400, False),
        (388, 400, True),
        (150, 150, True),
        (145, 150, False),
        (20, 20, True),
    ):
        evidence = StopEvidence(**state, contacts=1, p_right=right / draws, draws=float(draws))
        assert converged(rule, evidence) is sure
        if not sure:
            (short,) = shortfalls(rule, evidence)
            share = right / draws
            assert short.part == "spread"
            assert short.value == pytest.approx(share - 2.0 * math.sqrt(share * (1.0 - share) / draws))


def test_once_it_has_let_go_it_may_be_less_sure():
    rule, state = StopSettings(rule="probability"), {"expected_nll": 9.0, "fit": 9.0, "apc": 1.0, "diagonal": 0.1}
    for p, let_go, sure in ((0.91, True, True), (0.89, True, False), (0.91, False, False), (0.96, False, True)):
        evidence = StopEvidence(**state, contacts=1, p_right=p, let_go=let_go)
        assert converged(rule, evidence) is sure is not bool(shortfalls(rule, evidence))
    before = StopEvidence(**state, contacts=1, p_right=0.91, let_go=True)
    assert not converged(StopSettings(rule="probability", leeway=1.0), before)
    (short,) = shortfalls(StopSettings(rule="probability", leeway=1.0), before)
    assert (short.part, short.allowed) == ("spread", 0.95)
    assert converged(StopSettings(rule="probability", probability=0.1, leeway=5.0), before)
    with pytest.raises(UsageError, match="leeway to be 1 or more"):
        StopSettings(leeway=0.5)


@pytest.mark.parametrize("most", [-3.0, math.nan])
def test_an_expected_nll_that_no_belief_has_is_refused(most):
    with pytest.raises(UsageError, match="most_nll to be 0 or more"):
        StopSettings(most_nll=most)


def test_the_belief_is_compared_by_all_points_where_the_stop_may_depend_on_it():
    sure = StopEvidence(0.0, 1.0, 0.0, 0.1, contacts=1, p_right=0.99)
    unsure = (sure._replace(p_right=0.5), sure._replace(contacts=0), sure._replace(chance=0.0))
    for most in (None, 9.0):
        rule = StopSettings(rule="probability", most_nll=most, points_in_turn=5)
        assert turns(rule, sure) == 1 and [turns(rule, evidence) for evidence in unsure] == [5, 5, 5]
    for other in ("auto", "self", "apc", "never"):
        assert all(turns(StopSettings(rule=other), evidence) == 1 for evidence in (sure, *unsure))


@pytest.mark.sim
def test_a_run_is_the_same_by_points_in_turn(all_in_reach):
    own = replace(settings(), task="drill-0", steps=4)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False))
    few = replace(own.filter.trajectories, unseen_particles=200)
    own = replace(own, filter=replace(own.filter, trajectories=few))
    told = []
    for every in (1, 8):
        with build(replace(own, stop=replace(own.stop, points_in_turn=every)), cache_dir=all_in_reach) as (sim, agent):
            records = []
            rumi.run(sim, agent, seed=0, on_step=records.append)
            told.append(records)
    for whole, part in zip(*told, strict=True):
        assert whole.converged == part.converged
        assert torch.equal(whole.belief.world_T_object, part.belief.world_T_object)
        assert part.expected_nll == pytest.approx(whole.expected_nll, rel=0.1)
    assert any(whole.expected_nll != part.expected_nll for whole, part in zip(*told, strict=True))
