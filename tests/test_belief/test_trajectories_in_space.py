"""Trajectories from a prior, of a box that slides and topples: touches find it, histories replay, nothing is NaN."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief import bootstrap_filter
from rumi.belief.sample_size import kld_sample_size, occupied_cells
from rumi.belief.segments import felt_pads, path_of, pushed
from rumi.belief.trajectory_history import Kind, Segment
from rumi.belief.trajectory_starts import from_prior
from rumi.resampling import systematic
from rumi.seeding import generator
from sdf import se3
from sensors.observation import Observation
from sensors.reading import FORCE
from sensors.semantics import Semantics
from tests.fixtures.box_in_space import OWN, begin, felt_by, follow, towards


def test_a_touch_finds_a_box_of_which_only_a_prior_was_known(box, prior):
    followed = follow(box, prior)
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    belief, memory = begin(followed, prior)
    wide = belief.world_T_object[:, 0, 3].std()
    belief, memory, info = followed(belief, memory, felt_by(box, truth, towards(-0.10)), generator=generator(1))
    assert belief.every.apart
    # the pads' tips are 35 mm ahead, the box's face is at -20 mm
    reading = felt_by(box, truth, towards(-0.055))
    assert bool(reading.in_contact.any())
    assert int(felt_pads(reading, followed.model, followed.own).sum()) == int(
        reading.observation.of_class(Semantics.SURFACE).sum()
    )
    runs = [followed(belief, memory, reading, generator=generator(2)) for _ in range(2)]
    assert torch.equal(runs[0][0].world_T_object, runs[1][0].world_T_object)  # the same seed, the same bits
    belief, memory, info = runs[0]
    assert bool(info.moved) and bool(info.resampled)
    assert float(belief.world_T_object[:, 0, 3].std()) < float(wide)
    # all of it touches where it was felt
    there = reading.observation.points[reading.observation.of_class(Semantics.SURFACE)].mean(0, keepdim=True)
    local = se3.apply(se3.inverse(belief.world_T_object), there)
    assert float(box.exact.distance(local[:, 0]).abs().median()) < 0.006
    # what is shown stands for all
    assert len(belief.every) >= 100 and not belief.every.apart
    shown = followed.model.world_T_object(belief.trajectories.pose)
    torch.testing.assert_close(shown.float(), belief.world_T_object, atol=1e-6, rtol=0)
    every = belief.every.pose[:, :2].T @ belief.every_log_weight.exp()
    torch.testing.assert_close(belief.world_T_object[:, :2, 3].mean(0).double(), every, atol=0.003, rtol=0)


def test_a_recorded_force_tells_nothing_in_space(box, prior):
    followed = follow(box, prior, unseen_particles=20)
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    reading = felt_by(box, truth, towards(-0.055))
    felt = replace(reading, measurements={FORCE: torch.tensor([-3.0, 0.5, 0.0]).expand(len(reading.tool_pose), 3)})
    belief, memory = begin(followed, prior)
    alone, with_force = (followed(belief, memory, own, generator=generator(2))[0] for own in (reading, felt))
    assert float(with_force.trajectories.history.force[:, 2].sum()) > 0
    assert torch.equal(alone.world_T_object, with_force.world_T_object)


def sideways(last_y: float, x: float = 0.08, height: float = 0.03, count: int = 20) -> torch.Tensor:
    """A way of the tool to its left, with what is behind the pads beside the box."""
    y = torch.linspace(last_y - 0.08, last_y, count)
    return torch.stack((0 * y + x, y, 0 * y, 0 * y + height), -1)


def test_what_the_palm_pushes_unfelt_goes_along_before_a_first_touch(box, prior):
    followed = follow(box, prior)
    belief, memory = begin(followed, prior)
    reading = felt_by(box, prior.ways[0] @ se3.from_planar(torch.tensor([0.0, 9.0, 0.0])), sideways(0.0))
    assert not bool(reading.in_contact.any())
    after, _, info = followed(belief, memory, reading, generator=generator(1))
    assert bool(info.moved) and after.every.apart
    # none is where the palm is, and none is lost for having been there
    there = followed.model.tool + torch.tensor([0.08, 0.0, 0.03])
    inside = [
        (box.sdf.distance(followed.model.local(now.every.pose, there).float()).amin(-1) < -0.004).double().mean()
        for now in (belief, after)
    ]
    assert float(inside[0]) > 0.9 and float(inside[1]) < 0.1
    assert float(after.every.pose[:, 1].mean()) > float(belief.every.pose[:, 1].mean()) + 0.02
    assert len(after.every) == len(belief.every)
    # what is far from all of it moves nothing
    far = felt_by(box, prior.ways[0], sideways(0.0) + torch.tensor([0.4, 0.0, 0.0, 0.0]))
    same, _, info = followed(belief, memory, far, generator=generator(1))
    assert not bool(info.moved) and torch.equal(same.every.pose, belief.every.pose)


def test_what_is_felt_while_the_tool_stands_still_counts_by_its_way(box, prior):
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    way = towards(-0.055)
    still = torch.cat((way, way[-1:].repeat(6, 1)))
    weights = []
    for fresh_m in (0.0, 0.003):
        followed = follow(box, prior, fresh_m=fresh_m)
        reading = felt_by(box, truth, still)
        path, felt = path_of(reading, followed.model), felt_pads(reading, followed.model, followed.own)
        instants = torch.arange(6, 14)
        tracks = from_prior(prior, 5, generator(0))[:, None].expand(-1, len(instants), -1)
        segment = pushed(reading, instants, path, felt, tracks, followed.model, followed.own)
        weights.append(torch.zeros(8, dtype=torch.float64).index_add_(0, segment.instant, segment.weight.double()))
    # steps of 30 / 7 mm count in full, standing still counts nothing
    torch.testing.assert_close(weights[1][:2], weights[0][:2])
    assert float(weights[0][2:].min()) > 0 and float(weights[1][2:].max()) == 0


@pytest.mark.parametrize("particles", [1, 30])
def test_odd_beliefs_and_readings_give_no_nan(box, prior, particles):
    followed = follow(box, prior, unseen_particles=particles, memory=6)
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[0]
    belief, memory = begin(followed, prior)
    only = torch.full((particles,), -torch.inf).index_fill(0, torch.tensor(0), 0.0)
    belief = replace(belief, every_log_weight=only.double())
    apart = felt_by(box, truth, towards(-0.3))
    nothing = replace(apart, observation=Observation.empty(), instant=torch.zeros(0, dtype=torch.long))
    touch = felt_by(box, truth, towards(-0.10, 0.03))
    assert bool(touch.in_contact.any())
    for reading in (nothing, apart, touch, nothing, felt_by(box, truth, towards(-0.10, 0.03, 1)), touch):
        belief, memory, _ = followed(belief, memory, reading, generator=generator(3))
        assert bool(torch.isfinite(belief.world_T_object).all())
        assert float(belief.log_weights.exp().sum()) == pytest.approx(1.0, abs=1e-4)


def test_what_leans_on_the_tool_moves_with_it_felt_or_not(box, prior):
    model = follow(box, prior).model
    poses = torch.tensor([[0.0, 0.0, 0.0, 1.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.2]], dtype=torch.float64)
    assert model.unsettled(poses).tolist() == [False, True]
    # the tool is gone: it stands as before
    away = torch.tensor([[[-0.18, 0.0, 0.0, 0.1], [-0.2, 0.0, 0.0, 0.1]]], dtype=torch.float64)
    assert model.tracks(OWN, poses, away)[1, -1].tolist() == [0.0, 0.0, 0.0, 1.0, -1.0, 0.0]


def test_a_jump_that_no_push_explains_makes_the_belief_wide_and_touches_find_it_again(box, prior):
    followed = follow(box, prior)
    pose = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    belief, memory = begin(followed, prior)
    for way in (towards(-0.055), towards(-0.054)):
        belief, memory, _ = followed(belief, memory, felt_by(box, pose, way), generator=generator(2))
    narrow = belief.trajectories.pose[:, :2].std(0).max()
    # the tool drags it along by its top, where pushes from above do nothing, and turns it
    dragged = se3.from_planar(torch.tensor([-0.02, 0.03, 0.5])) @ prior.ways[1]
    odd = felt_by(box, dragged, towards(-0.06, count=20))
    assert bool(odd.in_contact.any())
    again = followed.begun_again(belief, odd, generator=generator(3))
    now = again.trajectories
    assert again.every.apart and not len(now.history.moving())
    assert bool(torch.isfinite(again.world_T_object).all())
    assert float(now.pose[:, :2].std(0).max()) > float(narrow)
    # the tool touches to the end, so that some lean on it: not once it is gone
    assert bool((now.pose[:, 4] >= 0).any())
    gone, _, _ = followed(again, memory, felt_by(box, dragged, towards(-0.3)), generator=generator(3))
    assert bool((gone.trajectories.pose[:, 4] < 0).all())
    found, _, info = followed(again, memory, felt_by(box, dragged, towards(-0.075)), generator=generator(4))
    assert bool(info.moved) and not found.every.apart


def test_a_step_is_the_replay_of_its_segment(box, prior):
    followed = follow(box, prior)
    truth = se3.from_planar(torch.tensor([0.01, 0.005, 0.0])) @ prior.ways[1]
    belief, memory = begin(followed, prior)
    belief, memory, _ = followed(belief, memory, felt_by(box, truth, towards(-0.055)), generator=generator(2))
    now, random = belief.every, generator(3)
    segment = now.history.last()
    history = now.history.appended(
        Segment(
            segment.tool,
            True,
            segment.points,
            torch.zeros(len(segment.points), dtype=torch.long),
            segment.kind,
            segment.weight,
        ),
        opens=False,
    )
    noise = torch.randn(len(now), 1, now.noise.shape[-1], generator=random, dtype=torch.float64)
    stepped = now.stepped(followed.model, followed.own, noise, history)
    last = torch.full((len(now),), len(history) - 1)
    replayed = now.lengthened(noise, history).replayed(followed.model, followed.own, history, last)
    torch.testing.assert_close(stepped.poses, replayed.poses, atol=1e-12, rtol=0)
    torch.testing.assert_close(stepped.log_likelihood, replayed.log_likelihood, atol=1e-9, rtol=0)
    both = now.joined(now)
    assert len(both) == 2 * len(now) and torch.equal(both.pose[len(now) :], now.pose)


def test_a_belief_that_is_narrow_has_fewer_particles(box, prior):
    """By the cells that it takes up; a third where no sampling error is set."""
    followed = follow(box, prior, unseen_particles=2000, fewest_particles=50, sampling_error=0.05)
    belief, _ = begin(followed, prior)
    every, even = followed.particles_of(belief)
    random = generator(3)
    wide = (even + torch.linspace(0.0, -20.0, len(every), dtype=torch.float64)).log_softmax(-1)

    def thinned(scale, **changes):
        own = followed.supposing(own=replace(followed.own, **changes))
        close = every.pose.clone()
        close[:, :3] *= scale
        close[:, 3] = 1.0
        now = replace(every, poses=close[:, None], apart=False)
        return close, len(own._thinned(now, wide, random)[0])

    assert [thinned(scale, sampling_error=0.0)[1] for scale in (1.0, 0.01)] == [2000, 666]
    sizes = []
    for scale in (1.0, 0.1, 0.03, 1e-4):
        poses, many = thinned(scale)
        cells = occupied_cells(poses[systematic(wide, 0.5, 2000)])
        assert many == min(2000, max(50, kld_sample_size(cells, followed.own.sampling_error)))
        sizes.append(many)
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > sizes[1] > sizes[2] > sizes[3] == 50
    some = every.at(torch.arange(100))
    kept, weights = followed._thinned(replace(some, poses=thinned(1e-4)[0][:100, None]), even[:100], random)
    assert len(kept) == 50  # more than are needed, by more than a little
    kept, weights = followed._thinned(every, even, random)
    assert kept is every and weights is even  # nothing is resampled where all count
    grown, _ = followed._thinned(some, even[:100].log_softmax(-1), random)
    assert len(grown) > 100  # where they spread they become more again


def test_draws_made_again_leave_the_evidence_as_it_is(box, prior, monkeypatch):
    """Half as many each time: of draws of one kind twice as many tell the same likelihood of what was felt."""
    followed = follow(box, prior, unseen_particles=1500)
    every, even = followed.particles_of(begin(followed, prior)[0])
    close = every.pose.clone() * 0.02
    close[:, 3], close[:, 4] = 1.0, -1.0
    now = replace(every, poses=close[:, None], apart=False)
    heavy = (even + torch.linspace(0.0, -3.0, len(even), dtype=torch.float64)).log_softmax(-1)
    reading = felt_by(box, prior.ways[1], towards(-0.055))
    path, felt = path_of(reading, followed.model), felt_pads(reading, followed.model, followed.own)
    segment = pushed(
        reading, torch.arange(len(path)), path, felt, close[:50, None].expand(-1, len(path), -1), followed.model, OWN
    )
    assert bool((segment.kind == Kind.FELT).any())

    def weighed():
        return followed._weighed_pushes(now, heavy, segment, generator(5), opens=True, jumps=False)

    _, _, told = weighed()
    monkeypatch.setattr(bootstrap_filter, "_FIT", 0.5)  # never enough
    monkeypatch.setattr(bootstrap_filter, "_WIDER", 1.0)
    more, weights, again = weighed()
    assert len(more) == 2 * 1500 and float(weights.exp().sum()) == pytest.approx(1.0)
    assert again == pytest.approx(told, abs=0.3) and more.log_evidence == now.log_evidence + again


def test_heights_of_what_is_shown_are_as_uncertain_as_wear_and_size(box, prior):
    """Their model has them at one height; those of the particles that are moved stay there."""
    worn_m, share = 0.0006, 0.006
    sure, followed = (follow(box, prior, height_off=off) for off in (None, (worn_m, share)))
    exact, belief = (begin(own, prior)[0] for own in (sure, followed))
    assert torch.equal(exact.every.poses, belief.every.poses)
    off = (belief.world_T_object - exact.world_T_object)[:, :3, 3].double()
    assert not bool(off[:, :2].any())
    for rest in range(len(prior.ways)):
        rows = belief.trajectories.pose[:, 3] == rest
        wide = math.hypot(worn_m, share * float(followed.model.rests.height_m[rest]))
        assert float(off[rows, 2].mean()) == pytest.approx(0.0, abs=0.4 * wide)
        assert float(off[rows, 2].std()) == pytest.approx(wide, rel=0.2)
    assert torch.equal(begin(sure, prior)[0].world_T_object, exact.world_T_object)
