"""Particles drawn anew: a mode that the particles have lost comes back where no observation refutes it."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.belief.reinitialise import ReinitialiseSettings, prior_belief, redraw, verify
from rumi.metrics.pose_error import pose_error
from sdf import se3, so3
from sdf.object_model import box_model
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

UP = ("x", "y", "z")


@pytest.fixture(scope="module")
def box():
    return box_model()


@pytest.fixture(scope="module")
def prior(box):
    return PosePrior.of((0.4, 0.0), 0.05, box.sdf.bounds, UP)


@pytest.fixture(scope="module")
def pose_filter(box, prior):
    settings = FilterSettings()
    discrepancy = Discrepancy(box.sdf, box.radius, free_scale=settings.free_scale, tolerance=settings.tolerance_m)
    return PoseFilter(settings, [discrepancy], "SE(3)", prior)


def lying_at(prior, way, planar):
    return se3.from_planar(torch.tensor(planar)) @ prior.ways[way]


def felt(box, truth, normals):
    """The points of the surface whose outward normals are among some world directions, below 10 cm."""
    points, facing = se3.apply(truth, box.surface_points), se3.rotate(truth, box.surface_normals)
    chosen = (facing @ torch.tensor(normals).T).amax(-1) > 0.9
    return Observation.of(points[chosen & (points[:, 2] < 0.1)], Semantics.SURFACE)


def right(box, pose, truth):
    metres, radians = pose_error(pose, truth.expand_as(pose), box.symmetries)
    return (metres < 0.008) & (radians < math.radians(10))


def test_lying_flat_keeps_height_and_tilt(pose_filter):
    assert pose_filter.search == "SE(2)"
    free = PoseFilter(FilterSettings(lies_flat=False), [pose_filter.discrepancy], "SE(3)", pose_filter.prior)
    assert free.search == "SE(3)"
    assert PoseFilter(FilterSettings(), [pose_filter.discrepancy], "SE(3)").search == "SE(3)"


def test_belief_starts_as_the_prior(pose_filter, prior, generator):
    belief = prior_belief(pose_filter, Observation.empty(), 300, generator=generator)
    off = (belief.world_T_object[:, :2, 3] - prior.mean) / prior.spread_m
    weights = belief.weights
    # what is cut off beyond 2.5 standard deviations makes it a little narrower
    assert float((weights[:, None] * off.square()).sum() / 2) == pytest.approx(0.86, abs=0.06)
    shares = [float(weights[way::3].sum()) for way in range(3)]
    assert max(shares) - min(shares) < 0.03


def test_first_contact_leaves_every_way_that_explains_it(box, pose_filter, prior, generator):
    """One low face was felt: whichever face the box lies on, it has one."""
    truth = lying_at(prior, 0, [0.43, 0.02, 0.4])
    turn = se3.from_planar(torch.tensor([0.0, 0.0, 0.4]))[:3, 0]
    seen = felt(box, truth, [(-turn).tolist()])
    assert len(seen) > 3
    start = prior_belief(pose_filter, Observation.empty(), 100, generator=generator)
    belief = redraw(pose_filter, start, seen, ReinitialiseSettings(), generator=generator)
    assert belief.log_weights.shape == (100,)
    assert float(belief.weights.sum()) == pytest.approx(1.0)
    torch.testing.assert_close(belief.discrepancy, pose_filter.total(belief, seen))
    up = belief.world_T_object[:, 2, :3].abs().argmax(-1)
    assert len(up.unique()) == 3
    assert bool(right(box, belief.world_T_object, truth).any())
    assert (
        float(belief.discrepancy.max() - belief.discrepancy.min())
        < -math.log(ReinitialiseSettings().plausible) / 2 + 1e-5
    )


def test_challenge_brings_back_a_lost_truth(box, pose_filter, prior, generator):
    """Two long sides of a flat box were felt, nothing of its ends: lying the other way along fits as well."""
    truth = lying_at(prior, 0, [0.42, 0.0, 0.0])
    seen = felt(box, truth, [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    wrong = lying_at(prior, 0, [0.42, 0.035, 0.0])
    lost = PoseBelief.uniform(wrong.expand(100, 4, 4).clone())
    assert not bool(right(box, lost.world_T_object, truth).any())
    belief = verify(pose_filter, lost, seen, ReinitialiseSettings(), generator=generator)
    assert bool(right(box, belief.world_T_object, truth).any())
    # the particles' own mode stays, since nothing refutes it
    assert bool(right(box, belief.world_T_object, wrong).any())


def test_challenge_keeps_what_is_plausible_only(box, pose_filter, prior, generator):
    """Of particles and rivals, each cell's best pose stays where it weighs a share of the best one's, or goes."""
    truth = lying_at(prior, 0, [0.42, 0.0, 0.0])
    seen = felt(box, truth, [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    far = lying_at(prior, 0, [0.45, 0.0, 0.3])
    start = PoseBelief.uniform(torch.cat((truth.expand(99, 4, 4), far[None])))
    for plausible in (0.02, 0.5):
        settings = ReinitialiseSettings(plausible=plausible)
        belief = verify(pose_filter, start, seen, settings, generator=torch.Generator().manual_seed(0))
        weight = belief.log_weights - belief.log_weights.max()
        assert float(weight.exp().min()) >= plausible * (1 - 1e-4)
        assert not bool((belief.world_T_object == far).all(-1).all(-1).any())


def test_challenge_leaves_a_belief_that_is_right(box, pose_filter, prior, generator):
    truth = lying_at(prior, 1, [0.42, 0.03, 0.5])
    surface = Observation.of(se3.apply(truth, box.surface_points), Semantics.SURFACE)
    noise = 0.0005 * torch.randn(100, 2, generator=generator)
    poses = truth.expand(100, 4, 4).clone()
    poses[:, :2, 3] += noise
    belief = verify(pose_filter, PoseBelief.uniform(poses), surface, ReinitialiseSettings(), generator=generator)
    share = belief.weights[right(box, belief.world_T_object, truth)].sum()
    assert float(share) > 0.999


def test_follows_the_attached_frame(box, pose_filter, prior, generator):
    """The prior is that of the start: what was felt before the object moved stands where it stood then."""
    truth = lying_at(prior, 2, [0.40, 0.02, 0.3])
    seen = felt(box, truth, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    floor = Observation.of(torch.tensor([[0.4, 0.0, 0.0], [0.45, 0.05, 0.0]]), Semantics.FREE, attached=False)
    motion = se3.from_planar(torch.tensor([0.05, -0.3, 0.7]))
    start = prior_belief(pose_filter, Observation.empty(), 100, generator=generator).moved(motion)
    belief = redraw(pose_filter, start, concatenate([seen, floor]), ReinitialiseSettings(), generator=generator)
    assert bool(right(box, belief.world_T_object, motion @ truth).any())


def test_without_a_prior_there_is_nothing_to_draw_from(pose_filter, generator):
    bare = PoseFilter(FilterSettings(), [pose_filter.discrepancy], "SE(3)")
    belief = PoseBelief.uniform(se3.identity((3,), dtype=torch.float32))
    with pytest.raises(ValueError, match="prior to draw from"):
        redraw(bare, belief, Observation.empty(), ReinitialiseSettings(), generator=generator)


def tipped_belief(prior, angle, poses):
    belief = PoseBelief.uniform(poses)
    turn = so3.exp(torch.tensor([0.0, angle, 0.0]))
    return belief.moved(se3.make(turn, torch.tensor([0.1, 0.0, 0.05])))


@pytest.mark.parametrize(("angle", "follows"), [(0.05, False), (1.5, True)])
def test_poses_follow_level_errors_once_the_object_has_tipped(box, pose_filter, prior, angle, follows, generator):
    """What is felt after a tip is off by the errors of the measured motion, which are level in the world alone."""
    truth = lying_at(prior, 2, [0.40, 0.02, 0.3])
    belief = tipped_belief(prior, angle, truth.expand(5, 4, 4).clone())
    error = se3.from_planar(torch.tensor([0.004, -0.003, 0.05]))
    there = belief.world_T_object[0]
    about = se3.make(torch.eye(3), there[:3, 3])
    off = se3.inverse(belief.world_T_attached) @ about @ error @ se3.inverse(about) @ there
    seen = Observation.of(se3.apply(off, box.surface_points), Semantics.SURFACE)
    assert bool(pose_filter.tipped(belief)) == follows
    found = pose_filter.descend(belief, seen, replace(pose_filter.settings.descent, iterations=12))
    metres, radians = se3.distance(found, off.expand(5, 4, 4))
    if follows:
        assert float(metres.max()) < 5e-4 and float(radians.max()) < 5e-3
    else:
        # level in the frame: what is left is by how much the two are tilted
        assert float((found[:, 2] - truth[2]).abs().max()) < 1e-6
    assert not bool(PoseFilter(FilterSettings(), [pose_filter.discrepancy], "SE(2)").tipped(belief))


def test_noise_is_level_in_the_world(pose_filter, prior, generator):
    poses = lying_at(prior, 0, [0.40, 0.0, 0.0]).expand(2000, 4, 4).clone()
    belief = tipped_belief(prior, 1.5, poses)
    noisy = belief.world_T_attached @ pose_filter.perturb(belief, generator=generator, rows=torch.tensor(True))
    change = noisy @ se3.inverse(belief.world_T_object)
    assert float((change[:, 2] - torch.tensor([0.0, 0.0, 1.0, 0.0])).abs().max()) < 1e-5
    shift = (noisy - belief.world_T_object)[:, :2, 3]
    assert shift.std(0).tolist() == pytest.approx([pose_filter.settings.translation_noise_m] * 2, rel=0.1)
    yaw = torch.atan2(change[:, 1, 0], change[:, 0, 0])
    assert float(yaw.std()) == pytest.approx(pose_filter.settings.rotation_noise_rad, rel=0.1)
