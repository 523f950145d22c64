"""Contract of evidence: what holds for every kind, also for one that another package adds by an entry point."""

import math
from dataclasses import fields, replace

import pytest
import torch

from rumi.belief.evidence import make_evidence
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.errors import UsageError
from rumi.registration.descent import DescentSettings
from sdf import se3
from sdf.primitives import Sphere
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.discrepancy import Discrepancy
from sensors.evidence import Evidence, EvidenceSet, SemanticPoints, gather
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

F64 = torch.float64
RADIUS = 0.04
KINDS = ["contact-points", "contact-signals", "near-contact"]

pytestmark = pytest.mark.usefixtures("outside")


def model_of(kind: str):
    surface = torch.tensor([[0.0, 0.01, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.01]], dtype=F64)
    return make_evidence([kind], Sphere(RADIUS).double(), surface)[0]


def reading_of(seed: int, dtype=F64, contact: bool = True) -> ContactReading:
    """Three instants in which every kind of sensor has something to tell, or none has."""
    random = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(2, 3, generator=random, dtype=F64), dim=-1)
    sd = torch.full((2,), 0.002, dtype=F64)
    touch = WrenchTouch(RADIUS * normals, normals, sd, 50.0 * sd, torch.tensor([0, 2]))
    return make_reading(
        tool=se3.exp(0.05 * torch.randn(3, 6, generator=random, dtype=F64)),
        contact=torch.tensor([False, contact, contact]),
        dtype=F64,
        kind=ContactReading,
        wrench=touch if contact else touch.at(torch.zeros(0).long()),
        signals=torch.tensor([False, contact, contact]),
    ).to(dtype=dtype)


def frames(dtype=F64):
    return se3.identity((3,), dtype=dtype, device="cpu")


def semantic_points() -> SemanticPoints:
    random = torch.Generator().manual_seed(0)
    parts = [Observation.of(0.06 * torch.randn(30, 3, generator=random, dtype=F64), kind) for kind in Semantics]
    return SemanticPoints(concatenate(parts), Discrepancy(Sphere(RADIUS), 0.04, free_scale=20.0).double())


def evidence_of(kind: str) -> Evidence:
    if kind == "semantic points":
        return semantic_points()
    if kind == "set":
        return EvidenceSet((semantic_points(), None, *(evidence_of(name) for name in KINDS)))
    return model_of(kind).update(None, reading_of(1), frames())


@pytest.fixture(params=["semantic points", *KINDS, "set"])
def evidence(request) -> Evidence:
    return evidence_of(request.param)


@pytest.fixture(params=KINDS)
def model(request):
    return model_of(request.param)


def poses(*shape: int):
    random = torch.Generator().manual_seed(1)
    return se3.exp(0.05 * torch.randn(*shape, 6, generator=random, dtype=F64))


def test_it_tells_poses_apart(evidence):
    found = evidence.log_likelihood(poses(7))
    assert isinstance(evidence, Evidence) and found.shape == (7,)
    assert float(found.max() - found.min()) > 0.1


def test_a_pose_of_many_is_the_pose_alone(evidence):
    many = poses(7)
    alone = torch.cat([evidence.log_likelihood(pose[None]) for pose in many])
    torch.testing.assert_close(evidence.log_likelihood(many), alone, atol=1e-9, rtol=0)


def test_a_scene_of_a_batch_is_the_scene_alone():
    """Of points, the one kind that is batched."""
    points = semantic_points()
    scenes = [points.observation[torch.arange(k, k + 40)] for k in (0, 20, 50)]
    stacked = Observation(*(torch.stack([getattr(one, part.name) for one in scenes]) for part in fields(Observation)))
    alone = torch.stack([replace(points, observation=one).log_likelihood(poses(7)) for one in scenes])
    together = replace(points, observation=stacked).log_likelihood(poses(7).expand(3, 7, 4, 4))
    torch.testing.assert_close(together, alone, atol=1e-9, rtol=0)


def test_poses_far_away_and_at_the_measurements_have_no_nan(evidence):
    place = se3.identity((4,), dtype=F64, device="cpu").clone()
    place[:, 0, 3] = torch.tensor([0.0, RADIUS, 1e3, 1e7])
    assert bool(torch.isfinite(evidence.log_likelihood(place)).all())


def test_the_gradient_is_finite(evidence):
    inputs = poses(7).requires_grad_()
    found = evidence.log_likelihood(inputs)
    if found.requires_grad:  # of what is binned or looked up there is none
        (slope,) = torch.autograd.grad(found.sum(), inputs)
        assert bool(torch.isfinite(slope).all())


def test_a_set_moves_its_tensors_to_another_dtype(evidence):
    single = EvidenceSet((evidence,)).to(dtype=torch.float32).members[0]
    for part in fields(single):
        value = getattr(single, part.name)
        assert not isinstance(value, torch.Tensor) or value.dtype == torch.float32
    double = EvidenceSet((single,)).to(dtype=F64)
    torch.testing.assert_close(double.log_likelihood(poses(7)), evidence.log_likelihood(poses(7)), atol=1e-3, rtol=1e-4)


def test_float32_readings_say_the_same(model):
    single = model.update(None, reading_of(1, torch.float32), frames(torch.float32))
    double = EvidenceSet((single,)).to(dtype=F64)
    expected = model.update(None, reading_of(1), frames()).log_likelihood(poses(7))
    torch.testing.assert_close(double.log_likelihood(poses(7)), expected, atol=1e-3, rtol=1e-3)


def test_readings_without_measurement_add_nothing(model):
    silent = reading_of(2, contact=False)
    plain = Reading(**{part.name: getattr(silent, part.name) for part in fields(Reading)})
    some = model.update(None, reading_of(1), frames())
    for reading in (silent, plain):
        assert model.update(None, reading, frames()) is None
        assert model.update(some, reading, frames()) is some


def test_log_likelihoods_of_readings_add_up_in_any_order(model):
    first, second = reading_of(1), reading_of(2)
    expected = sum(model.update(None, one, frames()).log_likelihood(poses(7)) for one in (first, second))
    for one, other in ((first, second), (second, first)):
        both = model.update(model.update(None, one, frames()), other, frames())
        torch.testing.assert_close(both.log_likelihood(poses(7)), expected)


def test_evidence_rides_with_the_object(model):
    """The whole scene moved, far away as well, between and after readings: nothing changes in the attached frame."""
    expected = model.update(None, reading_of(1), frames()).log_likelihood(poses(7))
    for shift in (0.3, 1000.0):
        motion = se3.exp(torch.tensor([shift, -0.3, 0.2, 0.4, -0.5, 0.9], dtype=F64))
        reading = reading_of(1)
        touch = reading.wrench
        moved = replace(
            reading,
            tool_pose=motion @ reading.tool_pose,
            wrench=replace(touch, points=se3.apply(motion, touch.points), normals=se3.rotate(motion, touch.normals)),
        )
        found = model.update(None, moved, motion.expand(3, 4, 4)).log_likelihood(poses(7))
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)


def filter_of(**changes) -> PoseFilter:
    """A filter that counts all kinds by the names in its settings."""
    ball = Sphere(RADIUS).double()
    settings = FilterSettings(motion="sticking", evidence=tuple(KINDS), **changes)
    models = make_evidence(settings.evidence, ball, torch.zeros(1, 3, dtype=F64))
    return PoseFilter(settings, [Discrepancy(ball, 0.04).double(), *models], "SE(2)").double()


def follow(pose_filter: PoseFilter, *readings: Reading) -> tuple[PoseBelief, Observation]:
    start, memory = PoseBelief.uniform(se3.from_planar(0.02 * torch.eye(3, dtype=F64))), Observation.empty(dtype=F64)
    generator = torch.Generator().manual_seed(0)
    for reading in readings:
        start, memory, _ = pose_filter(start, memory, reading, generator=generator)
    return start, memory


def view() -> Reading:
    """Points, and sensors of contact that are silent."""
    return replace(
        reading_of(1, contact=False), observation=semantic_points().observation, instant=torch.zeros(90).long()
    )


def test_silent_sensors_leave_the_belief_as_it_was_to_the_bit():
    pose_filter = filter_of(trigger=0.5)
    silent, plain = follow(pose_filter, view(), view())[0], follow(pose_filter.with_evidence(), view(), view())[0]
    assert silent.evidence is None and silent.log_weights.exp().max() < 1.0
    for part in fields(PoseBelief):
        if part.name != "evidence":
            assert torch.equal(getattr(silent, part.name), getattr(plain, part.name)), part.name


def test_the_filter_sums_every_kind_without_an_edit():
    quiet = {"translation_noise_m": 0.0, "rotation_noise_rad": 0.0, "descent": DescentSettings(iterations=0)}
    pose_filter = filter_of(trigger=math.inf, **quiet)
    belief, memory = follow(pose_filter, view(), reading_of(1))
    assert [member is not None for member in belief.evidence.members] == [True] * 3
    log = -2.0 * pose_filter.discrepancy(belief.attached_T_object, memory)
    for member in belief.evidence.members:
        log = log + member.log_likelihood(belief.attached_T_object)
    torch.testing.assert_close(belief.log_weights, log.log_softmax(-1))


def test_refusals(no_shape_check):
    with pytest.raises(UsageError, match="no evidence 'smell'; there are contact-points, contact-signals, near"):
        make_evidence(["smell"], Sphere(RADIUS), torch.zeros(1, 3))
    with pytest.raises(TypeError, match="as a dataclass"):
        EvidenceSet((object(),))
    with pytest.raises(ValueError, match="at most 0 kinds, got 1"):
        gather((), EvidenceSet((semantic_points(),)), reading_of(1), frames())
    with pytest.raises(TypeError, match="as the first evidence"):
        PoseFilter(FilterSettings(), [], "SE(2)")
