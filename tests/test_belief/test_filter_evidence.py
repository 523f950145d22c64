"""The filter counts further evidence wherever it weighs, resamples and draws anew, at every later step."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from rumi.belief.contact_evidence import ContactPointModel
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.belief.reinitialise import ReinitialiseSettings, redraw, refine_poses, verify
from rumi.registration.descent import DescentSettings
from sdf import se3
from sdf.primitives import Box
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.discrepancy import Discrepancy
from sensors.evidence import EvidenceSet, in_attached_frame
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

SIDES = (0.04, 0.06, 0.1)
QUIET = {"translation_noise_m": 0.0, "rotation_noise_rad": 0.0, "descent": DescentSettings(iterations=0)}
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["single", "double"])


@dataclass(frozen=True)
class Leaning:
    """Evidence that likes poses to the left, by so many nats a metre along an axis of the attached frame."""

    slope: float = 300.0
    axis: int = 0

    def log_likelihood(self, world_T_object):
        return -self.slope * world_T_object[..., self.axis, 3]


class LeaningModel:
    """Leaning from the first contact on."""

    def update(self, evidence, reading, world_T_attached, /):
        return Leaning() if evidence is None and bool(reading.in_contact.any()) else evidence


TOUCHED = (LeaningModel(),)


def make(dtype=torch.float64, evidence=TOUCHED, search="SE(2)", prior=None, **changes):
    sdf = Box(SIDES).to(dtype)
    discrepancy = Discrepancy(sdf, 0.125, free_scale=10.0, tolerance=0.001).to(dtype)
    settings = FilterSettings(**({"trigger": math.inf} | QUIET | changes))
    return PoseFilter(settings, [discrepancy, *evidence], search, prior).to(dtype)


def truth(dtype=torch.float64):
    return se3.from_planar(torch.tensor([0.4, 0.0, 0.2], dtype=dtype), 0.1)


def particles(dtype=torch.float64, count=40):
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(1000), dtype=torch.float64)
    spread = noise * torch.tensor([0.005, 0.005, 0.1], dtype=torch.float64)
    return PoseBelief.uniform((truth() @ se3.from_planar(spread)).to(dtype))


def seen(seed, dtype=torch.float64, count=60):
    """Points of one side."""
    random = torch.Generator().manual_seed(seed)
    points = (2 * torch.rand(count, 3, generator=random, dtype=torch.float64) - 1) * torch.tensor(SIDES).double()
    points[:, 0] = -SIDES[0]
    return Observation.of(se3.apply(truth(), points).to(dtype), Semantics.SURFACE)


def reading(observation=None, motion=None, *, dtype=torch.float64, **given):
    identity = se3.identity((1,), dtype=dtype, device="cpu")
    kind = ContactReading if "wrench" in given else Reading
    motion = identity if motion is None else motion[None].to(dtype)
    return make_reading(observation, motion=motion, dtype=dtype, kind=kind, **given)


def follow(pose_filter, belief, *readings, dtype=torch.float64, seed=1000):
    memory, generator = Observation.empty(dtype=dtype), torch.Generator().manual_seed(seed)
    beliefs = []
    for one in readings:
        belief, memory, _ = pose_filter(belief, memory, one, generator=generator)
        beliefs.append(belief)
    return beliefs, memory


@DTYPES
@pytest.mark.parametrize("weighing", ["scratch", "incremental"])
def test_what_was_felt_once_counts_at_every_later_step(weighing, dtype):
    """Eq 10 times the likelihood: after the touch, after points that came later, after nothing, after a motion."""
    pose_filter = make(dtype, weighing=weighing)
    push = se3.from_planar(torch.tensor([0.03, -0.02, 0.4], dtype=torch.float64))
    steps = [
        reading(seen(1, dtype), dtype=dtype),
        reading(contact=True, dtype=dtype),
        reading(seen(2, dtype), dtype=dtype),
        reading(dtype=dtype),
        reading(motion=push, dtype=dtype),
    ]
    beliefs, memory = follow(pose_filter, particles(dtype), *steps, dtype=dtype)
    poses = particles(dtype).attached_T_object
    parts = [follow(pose_filter, particles(dtype), *steps[:n], dtype=dtype)[1] for n in range(1, 6)]
    for number, (belief, so_far) in enumerate(zip(beliefs, parts, strict=True)):
        log = -2.0 * pose_filter.discrepancy(poses, so_far)
        if number >= 1:
            log = log + Leaning().log_likelihood(poses)
        torch.testing.assert_close(belief.log_weights, log.log_softmax(-1), atol=1e-3, rtol=1e-4)
    assert len(memory) > 60
    assert float((beliefs[1].weights - beliefs[0].weights).abs().max()) > 0.01
    torch.testing.assert_close(beliefs[-1].world_T_object, push.to(dtype) @ beliefs[0].world_T_object)


def test_resampling_keeps_particles_by_what_was_felt():
    """As often as the posterior with it says, to within one: systematic resampling."""
    pose_filter = make(trigger=0.0, trigger_percentile=1.0)
    (belief,), memory = follow(pose_filter, particles(), reading(seen(1), contact=True))
    poses = particles().attached_T_object
    expected = (-2.0 * pose_filter.discrepancy(poses, memory) + Leaning().log_likelihood(poses)).softmax(-1)
    same = (belief.attached_T_object[:, None] - poses[None]).abs().amax((-1, -2)) < 1e-9
    assert bool((same.sum(-1) == 1).all())
    assert float((same.sum(0) - 40 * expected).abs().max()) <= 1.0
    assert float((belief.log_weights - belief.log_weights[0]).abs().max()) > 1.0, "weighed by it again"
    log = -2.0 * pose_filter.discrepancy(belief.attached_T_object, memory)
    log = log + Leaning().log_likelihood(belief.attached_T_object)
    torch.testing.assert_close(belief.log_weights, log.log_softmax(-1))
    plain, _ = follow(make(trigger=0.0, trigger_percentile=1.0, evidence=()), particles(), reading(seen(1)))
    assert not torch.equal(plain[0].attached_T_object, belief.attached_T_object)


RENEWAL = ReinitialiseSettings(
    starts=300, polished=80, coarse=DescentSettings(iterations=5), fine=DescentSettings(iterations=5)
)


def facing(belief, normal):
    """Weight of the poses one of whose two wide sides faces along a normal; the narrow ones have the rest."""
    turn = belief.world_T_object[..., :3, :3].mT @ normal
    return float(belief.weights[turn[..., 0].abs() > 0.9].sum()), float(belief.weights[turn[..., 1].abs() > 0.9].sum())


@DTYPES
def test_a_normal_decides_between_sides_that_points_leave_open(dtype):
    """A point on a box's side: poses drawn anew, and rivals beside a belief, have the side that the normal says."""
    prior = PosePrior.of((0.45, 0.0), 0.03, torch.tensor([[-side for side in SIDES], SIDES], dtype=dtype))
    point = torch.tensor([[0.4, 0.0, 0.1]], dtype=dtype)
    # where the box cannot be: it is beyond the point along x
    places = torch.cartesian_prod(torch.linspace(0.3, 0.395, 12), torch.linspace(-0.15, 0.15, 30), torch.tensor([0.1]))
    free = Observation.of(places.to(dtype), Semantics.FREE)
    normal = torch.tensor([-1.0, 0.0, 0.0], dtype=dtype)
    pose_filter = make(dtype, prior=prior)
    memory = concatenate([free, Observation.of(point, Semantics.SURFACE)])
    start = PoseBelief.uniform(prior.spread_poses(60, generator=torch.Generator().manual_seed(1000)))
    model = ContactPointModel(pose_filter.discrepancy.sdf, point_m=0.002, normal_rad=0.1, outlier=0.05)
    touch = WrenchTouch(point, normal[None], point.new_tensor([0.001]), point.new_tensor([0.05]), torch.zeros(1).long())
    touched = EvidenceSet((model.update(None, reading(dtype=dtype, wrench=touch), se3.identity((1,), dtype=dtype)),))
    found = {}
    for name, kept in (("points", None), ("normal", touched)):
        generator = torch.Generator().manual_seed(1000)
        belief = replace(start, evidence=kept)
        belief = redraw(pose_filter, belief, memory, RENEWAL, generator=generator)
        again = verify(pose_filter, belief, memory, RENEWAL, generator=generator)
        assert again.evidence is kept
        found[name] = again
        torch.testing.assert_close(
            again.log_weights, (-2.0 * pose_filter.total(again, memory)).log_softmax(-1), atol=1e-3, rtol=1e-3
        )
    # the free space says that some side faces the tool; of a wide and a narrow one the normal is the same: a corner
    # that points at the tool is what it rules out
    corners = {name: 1.0 - sum(facing(one, normal)) for name, one in found.items()}
    assert corners["points"] > 0.3 and corners["normal"] < 0.05, corners


def test_poses_drawn_anew_settle_as_freely_as_the_search():
    """Down where height is searched, not where it is not; none comes to cost more, and without evidence none moves."""
    here = in_attached_frame(seen(1), se3.identity(dtype=torch.float64))
    poses = particles().attached_T_object
    for search, least, most in (("SE(2)", 0.0, 1e-9), ("SE(3)", 0.005, 0.1)):
        pose_filter, evidence = make(search=search), Leaning(3000.0, axis=2)
        generator = torch.Generator().manual_seed(1000)
        moved = refine_poses(pose_filter, poses, here, evidence, generator=generator)
        assert bool((pose_filter.cost(moved, here, evidence) <= pose_filter.cost(poses, here, evidence)).all())
        down = float((poses[:, 2, 3] - moved[:, 2, 3]).mean())
        assert least <= down <= most, (search, down)
        assert refine_poses(pose_filter, poses, here, None, generator=generator) is poses


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normals": torch.full((1, 3), math.nan)}, r"wrench\.normals"),
        ({"instant": torch.ones(1).long()}, r"wrench\.instant to be 0 to 0"),
    ],
)
def test_touches_that_are_none_are_refused(changes, message):
    touch = WrenchTouch(torch.zeros(1, 3), torch.eye(3)[:1], torch.ones(1), torch.ones(1), torch.zeros(1).long())
    with pytest.raises(ValueError, match=message):
        reading(wrench=replace(touch, **changes))
