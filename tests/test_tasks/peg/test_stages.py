"""The two stages of the peg task and what the robot may do in them."""

import math
from itertools import pairwise

import pytest
import torch

from rumi.clock import SimulatedClock
from rumi.information.contact_gain import ContactKind
from rumi.tasks.peg import selection as refine
from rumi.tasks.peg.cell import TouchCell
from rumi.tasks.peg.moves import direct_ways, motions, outcomes, presses
from rumi.tasks.peg.search import free_ways, joined, lanes, start, taken_in
from rumi.tasks.peg.selection import (
    Chooser,
    aim_of,
    block_filter,
    confirmed,
    evidence_of,
    probability_of,
    sides_touched,
)
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import random_pose
from sdf.sweep import sweep_rectangle
from sensors.touch.rectangle_touch import RectangleTouches, way_clearances

F64 = torch.float64
SETTINGS = PegSettings(particles=200, search_particles=600)


def cell_of(seed, settings=SETTINGS):
    truth = random_pose(settings, generator=torch.Generator().manual_seed(seed))
    first = torch.cat((lanes(settings)[0], torch.tensor([settings.low_m], dtype=F64)))
    noise = torch.Generator().manual_seed(seed)
    return TouchCell(
        truth, settings.block, settings.radius_m, settings.noise, settings.limits, first, SimulatedClock(), noise
    )


def search(cell, settings, *, generator):
    found = start(settings, generator=generator)
    for corner in lanes(settings)[1:]:
        felt = cell.follow(torch.stack((cell.tip, torch.cat((corner, cell.tip[2:])))))
        found = taken_in(found, felt, settings, generator=generator)
        if felt.kind != ContactKind.NOTHING:
            return found
    pytest.fail("nothing was met")


def stage_two(seed, settings=SETTINGS):
    cell, draws = cell_of(seed, settings), torch.Generator().manual_seed(seed)
    found = search(cell, settings, generator=draws)
    every = RectangleTouches.none(settings.block.half(), settings.noise, settings.radius_m)
    for felt in found.felt:
        every = every.joined(evidence_of(felt, settings))
    follow = block_filter(settings)
    return cell, found, every, follow, joined(found, follow, every, settings, generator=draws)


def test_lanes_meet_every_block():
    generator = torch.Generator().manual_seed(0)
    poses = torch.stack([random_pose(SETTINGS, generator=generator) for _ in range(800)])
    assert float(poses[:, 0].abs().max()) <= 0.4 and float(poses[:, 1].abs().max()) <= 0.25
    assert float(poses[:, 2].abs().max()) <= 0.5 * math.pi
    corners = lanes(SETTINGS)
    met = torch.zeros(800, dtype=torch.bool)
    for here, there in pairwise(corners):
        met |= sweep_rectangle(poses, SETTINGS.block.half(), here, there, SETTINGS.radius_m).hit
    assert bool(met.all())
    # and none is met before it has begun
    assert float(way_clearances(poses, SETTINGS.block.half(), corners[:1].expand(1, 2, 2)).min()) > SETTINGS.radius_m


def test_the_search_keeps_the_truth_and_the_stages_meet_in_it():
    for seed in range(4):
        cell, found, every, _, belief = stage_two(seed)
        assert found.felt[-1].kind == ContactKind.TOUCH and all(
            felt.kind == ContactKind.NOTHING for felt in found.felt[:-1]
        )
        circle = found.circle.log_likelihood(cell.truth[None, :2])
        best = found.circle.log_likelihood(found.belief.states).max()
        assert float(circle) > float(best) - 8.0
        weights = found.belief.log_weights.exp()
        near = float(((found.belief.states - cell.truth[:2]).norm(dim=-1) < 0.1).double() @ weights)
        assert near > 0.1
        # of the poses with a yaw some are near the truth, modulo half a turn
        apart = belief.states - cell.truth
        turn = torch.remainder(apart[:, 2] + 0.5 * math.pi, math.pi) - 0.5 * math.pi
        assert bool(((apart[:, :2].norm(dim=-1) < 0.05) & (turn.abs() < 0.3)).any())
        assert float(every.log_likelihood(cell.truth[None])) > float(every.log_likelihood(belief.states).max()) - 15.0


def test_free_ways_are_cut_short_of_contacts():
    cell = cell_of(0)
    felt = search(cell, SETTINGS, generator=torch.Generator().manual_seed(0)).felt[-1]
    (start, end), *_ = free_ways(felt, SETTINGS)
    assert torch.equal(start, felt.free[-1][0])
    assert float((end - felt.tip[:2]).norm()) == pytest.approx(3 * SETTINGS.point_m)
    # the way back from the side tells nothing: the ball was not clear of it
    back = torch.stack((cell.tip, cell.tip + torch.tensor([0.01, 0.0, 0.0]) * torch.sign(felt.normal[0])))
    leaving = cell.follow(back)
    assert leaving.leaving and free_ways(leaving, SETTINGS) == []


def test_twelve_presses_meet_their_sides():
    pose = torch.tensor([0.1, -0.05, 0.6], dtype=F64)
    press = presses(pose, SETTINGS)
    half = SETTINGS.block.half()
    found = sweep_rectangle(pose.expand(12, 3), half, press.standoff, press.target, SETTINGS.radius_m)
    assert bool(found.hit.all())
    assert torch.allclose(found.distance, torch.full((12,), SETTINGS.standoff_m, dtype=F64))
    assert len(torch.unique((found.normal * 1e6).round(), dim=0)) == 4
    assert len(torch.unique((found.point * 1e6).round(), dim=0)) == 12


def test_ways_round_the_block_and_over_it():
    pose = torch.zeros(1, 3, dtype=F64)
    even = torch.zeros(1, dtype=F64)
    normal = torch.tensor([0.0, 1.0], dtype=F64)
    tip = torch.tensor([0.0, 0.0625, 0.03], dtype=F64)
    found = motions(pose[0], tip, normal, pose, even, SETTINGS)
    directly = [motion.direct for motion in found]
    # the sides in view: the one just touched; over the top to the far one
    assert directly[6:9] == [True] * 3 and directly[9:12] == [False] * 3
    for motion in found:
        assert torch.equal(motion.path[0], tip)
        steps = motion.path.diff(dim=0)
        assert bool(((steps[:, :2].norm(dim=-1) == 0) | (steps[:, 2] == 0)).all())
        assert bool((motion.path[:, 2] >= SETTINGS.low_m).all())
        felt = outcomes(motion, pose, SETTINGS)
        assert int(felt.kind) == ContactKind.TOUCH
    press = presses(pose[0], SETTINGS)
    assert torch.equal(direct_ways(tip[:2] + 0.01 * normal, press, pose, even, SETTINGS), torch.tensor(directly))


def test_outcomes_are_what_the_cell_does():
    """Every motion, of every kind of end, carried out in a cell without noise, ends as foreseen."""
    kinds = set()
    generator = torch.Generator().manual_seed(5)
    poses = torch.stack([random_pose(SETTINGS, generator=generator) for _ in range(12)]) * torch.tensor([0.2, 0.3, 1.0])
    even = torch.zeros(len(poses), dtype=F64)
    exact = PegSettings(point_m=1e-9, normal_deg=1e-9)
    tip = torch.tensor([-0.5, 0.3, 0.03], dtype=F64)
    for motion in motions(poses[0], tip, None, poses[:1], even[:1], SETTINGS):
        foreseen = outcomes(motion, poses, exact)
        for k, truth in enumerate(poses):
            cell = TouchCell(
                truth, exact.block, exact.radius_m, exact.noise, exact.limits, tip, SimulatedClock(), generator
            )
            felt = cell.follow(motion.path)
            kinds.add(felt.kind)
            assert int(foreseen.kind[k]) == felt.kind
            if felt.kind == ContactKind.TOUCH:
                assert torch.allclose(foreseen.point[k], felt.point, atol=1e-6)
                assert torch.allclose(foreseen.normal[k], felt.normal, atol=1e-6)
    assert kinds == {ContactKind.NOTHING, ContactKind.TOUCH, ContactKind.TOP}


def test_a_decision_keeps_its_deadline_on_the_clock():
    cell, found, _, _, belief = stage_two(1)
    for seconds in (0.5, 1.0):
        settings = PegSettings(particles=200, evaluation_s=seconds, action_budget_s=12.0)
        clock = SimulatedClock()
        chooser = Chooser(settings, clock, torch.Generator().manual_seed(0), [])
        thought = chooser.choose(belief, cell.tip, found.felt[-1].normal)
        selection = thought.selection
        assert selection.candidate is not None and selection.gain > 0
        assert thought.ended_s == clock() == pytest.approx(seconds * selection.evaluated)
        assert clock() + selection.candidate.execution_s <= 12.0 + 1e-9 and selection.late_s <= 1e-9
    measured = Chooser(PegSettings(particles=200, evaluation_s=None), clock, torch.Generator().manual_seed(0), [])
    assert measured.choose(belief, cell.tip, None).selection.evaluated > 12
    assert len(measured.measured) > 12


def test_real_time_counts_the_making_of_candidates(monkeypatch):
    """On a machine where twelve motions take 0.6 s to make, drawing particles 0.1 s and a gain 0.05 s."""
    machine = SimulatedClock()
    monkeypatch.setattr(refine.time, "perf_counter", machine)

    def slow(what, seconds):
        def done(*arguments, **options):
            machine.advance(seconds)
            return what(*arguments, **options)

        return done

    for name, seconds in (("motions", 0.6), ("resample_systematic", 0.1), ("touch_gain", 0.05)):
        monkeypatch.setattr(refine, name, slow(getattr(refine, name), seconds))
    cell, found, _, _, belief = stage_two(1)
    clock = SimulatedClock(7.0)
    settings = PegSettings(particles=200, evaluation_s=None, action_budget_s=12.0)
    chooser = Chooser(settings, clock, torch.Generator().manual_seed(0), [])
    for number in range(6):
        before, real = clock(), machine()
        thought = chooser.choose(belief, cell.tip, found.felt[-1].normal)
        selection = thought.selection
        # what was done once before the first decision, for nothing, is of no decision
        spent = machine() - real - (0.75 if number == 0 else 0.0)
        assert thought.begun_s == before and thought.ended_s == clock() == pytest.approx(before + spent)
        rounds = -(-selection.generated // 12)
        assert spent == pytest.approx(0.1 + 0.6 * rounds + 0.05 * selection.evaluated)
        # late by no more than the motions that it did not know of at first
        assert selection.late_s <= (0.6 if number == 0 else 1e-9)
        ended = thought.ended_s + selection.candidate.execution_s - thought.begun_s
        assert ended - 12.0 == pytest.approx(selection.late_s)
    assert max(chooser.making) == pytest.approx(0.6) and min(chooser.making) == 0.0


def test_sure_by_other_particles():
    _, _, every, _, belief = stage_two(2)
    aim = aim_of(belief, SETTINGS)
    assert probability_of(aim.points, belief, SETTINGS) == pytest.approx(aim.probability, abs=1e-9)
    assert probability_of(aim.points.flip(0), belief, SETTINGS) == pytest.approx(aim.probability, abs=1e-9)
    fresh, again = confirmed(belief, every, aim, SETTINGS, generator=torch.Generator().manual_seed(0))
    assert not torch.equal(fresh.states, belief.states)
    assert torch.equal(again.points, aim.points) and 0 <= again.probability <= 1


def test_sides():
    half = SETTINGS.block.half()
    every = RectangleTouches.none(half, SETTINGS.noise, SETTINGS.radius_m)
    pose = torch.tensor([0.2, 0.1, 0.0], dtype=F64)
    assert sides_touched(pose, every) == 0
    up, right = torch.tensor([0.0, 1.0], dtype=F64), torch.tensor([1.0, 0.0], dtype=F64)
    for x in (-0.05, 0.0, 0.05):
        every = every.with_touch(pose[:2] + torch.tensor([x, 0.05], dtype=F64), up)
    assert sides_touched(pose, every) == 1
    assert sides_touched(pose, every.with_touch(pose[:2] + 0.1 * right, right)) == 2
