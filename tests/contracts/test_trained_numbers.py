"""Trained numbers of modules: float32, used by the mode that has them, physical after any step; settings as tensors."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rumi.belief.contact_evidence import ContactPointModel, SignalSettings
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.static_filter import ResampleMoveSettings
from rumi.belief.trajectory_filter import TrajectorySettings
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.fields.information import InformationField, InformationSettings
from rumi.information.entropy import NeighbourEntropy, SharedSupport
from rumi.information.neighbours import StateMetric
from rumi.registration.descent import DescentSettings
from rumi.resampling import systematic
from rumi.robot.tool import Tool
from rumi.weights import resampled_weights
from sdf import se3
from sdf.primitives import Box
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.semantics import SemanticSensor
from sensors.touch.contact_model import ContactModel
from tests.fixtures.readings import make_reading

F64 = torch.float64
BOX = Box((0.03, 0.04, 0.05)).double()
POSES = se3.from_planar(0.02 * torch.randn(4, 3, generator=torch.Generator().manual_seed(0), dtype=F64))
POINTS = 0.05 * torch.randn(30, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
DISTANCE = torch.linspace(-0.02, 0.03, 12, dtype=F64)
SEEN = Observation.of(POINTS, 0)


def field(mode: Any) -> Callable[[], nn.Module]:
    return lambda: InformationField(BOX, InformationSettings(mode, tail=0.0), trainable=True)


def information(module: Any) -> Tensor:
    return module(POSES, torch.zeros(4, dtype=F64).log_softmax(-1), POINTS).information.sum()


MODULES: dict[str, tuple[Callable[[], Any], Callable[[Any], Tensor], set[str]]] = {
    "semantics": (
        lambda: SemanticSensor(trainable=True),
        lambda m: m(DISTANCE)[..., 2].sum(),
        {"sharpness", "tolerance"},
    ),
    "proximity": (
        lambda: ContactModel(trainable=True),
        lambda m: m.log_likelihood(DISTANCE, DISTANCE > 0).sum(),
        {"true_positive", "false_positive", "decay"},
    ),
    "binary": (
        lambda: ContactModel(decay=None, trainable=True),
        lambda m: m.log_likelihood(DISTANCE, DISTANCE > 0.01).sum(),
        {"true_positive", "false_positive"},
    ),
    "discrepancy": (
        lambda: Discrepancy(BOX, 0.08, tolerance=0.001, trainable=True),
        lambda m: m(POSES, SEEN).sum(),
        {"free_scale", "tolerance"},
    ),
    "a tolerance of 0": (
        lambda: Discrepancy(BOX, 0.08, trainable=True),
        lambda m: m(POSES, SEEN).sum(),
        {"free_scale"},
    ),
    "field, sensor_mi": (field("sensor_mi"), information, {"sharpness", "surface_tolerance"}),
    "field, reverse_kl": (
        field("reverse_kl"),
        information,
        {"sharpness", "surface_tolerance", "peakiness", "free_scale"},
    ),
}


@pytest.fixture(params=MODULES)
def made(request: pytest.FixtureRequest) -> tuple[Any, Callable[[Any], Tensor], set[str]]:
    make, loss, names = MODULES[request.param]
    return make(), loss, names


def test_numbers_that_the_mode_uses_are_trained_in_float32(made: Any) -> None:
    module, loss, names = made
    parameters = dict(module.named_parameters())
    assert set(parameters) == {f"raw_{name}" for name in names}
    assert {value.dtype for value in parameters.values()} == {torch.float32}
    loss(module).backward()
    assert all(value.grad is not None and float(value.grad.abs()) > 0 for value in parameters.values())


@pytest.mark.parametrize("rate", [1.0, 1e9])
@pytest.mark.parametrize("maximize", [False, True])
def test_any_step_leaves_physical_numbers(made: Any, rate: float, maximize: bool) -> None:
    module, loss, names = made
    optimiser = torch.optim.SGD(module.parameters(), lr=rate, maximize=maximize)
    loss(module).backward()
    optimiser.step()
    for name in names:
        value = getattr(module, name).item()
        assert 0 < value < (1.0 if name.endswith("positive") else 1e12), (name, value)
    assert bool(loss(module).isfinite())


def test_copies_and_states_are_the_module(made: Any) -> None:
    module, loss, names = made
    with torch.no_grad():
        for value in module.parameters():
            value += 0.3
    loaded = copy.deepcopy(made[0])
    loaded.load_state_dict(module.state_dict())
    for other in (pickle.loads(pickle.dumps(module)), copy.deepcopy(module), loaded):
        assert torch.equal(loss(other), loss(module))
        assert all(torch.equal(getattr(other, name), getattr(module, name)) for name in names)


def test_fixed_numbers_are_had_and_replaced_by_name() -> None:
    module = SemanticSensor()
    assert not list(module.parameters()) and {"sharpness", "tolerance"} <= set(module.state_dict())
    sharp = torch.func.functional_call(module, {"sharpness": torch.tensor(50.0)}, (DISTANCE,))
    torch.testing.assert_close(sharp, SemanticSensor(50.0)(DISTANCE))
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing


def wanting(value: float) -> Tensor:
    return torch.tensor(value, dtype=F64, requires_grad=True)


REFUSED: dict[str, Callable[[Tensor], Any]] = {
    "sharpness": lambda x: SemanticSensor(x),
    "decay": lambda x: ContactModel(decay=x),
    "free_scale": lambda x: Discrepancy(BOX, 0.08, free_scale=x),
    "peakiness": lambda x: InformationField(BOX, InformationSettings(peakiness=x)),
    "tolerance_m": lambda x: FilterSettings(tolerance_m=x),
    "trigger": lambda x: FilterSettings(trigger=x),
    "step_limit_m": lambda x: DescentSettings(step_limit_m=x),
    "true_positive": lambda x: SignalSettings(true_positive=0.5 * x),
    "scales": lambda x: StateMetric((1.0, x), (False, False)),
    "floor": lambda x: SharedSupport(StateMetric.euclidean(2), floor=(x, 1.0)),
    "floor ": lambda x: NeighbourEntropy(StateMetric.euclidean(2), floor=x),
    "crossed": lambda x: ResampleMoveSettings(crossed=0.5 * x),
    "from_prior": lambda x: TrajectorySettings(from_prior=0.5 * x),
}


@pytest.mark.usefixtures("no_shape_check")
@pytest.mark.parametrize("name", REFUSED)
def test_a_tensor_whose_gradient_would_be_dropped_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"Expected {name.strip()}.*wants a gradient"):
        REFUSED[name](wanting(1.0))


def filter_of(**changes: Any) -> PoseFilter:
    settings = replace(FilterSettings(motion="measured", trigger=1e9), **changes)
    return PoseFilter(settings, [Discrepancy(BOX, 0.08).double()], "SE(2)").double()


def step(pose_filter: PoseFilter) -> PoseBelief:
    """After a reading with a measured motion, so that there is process noise."""
    motion = se3.exp(torch.tensor([0.01, 0.0, 0.0, 0.0, 0.0, 0.1], dtype=F64)).expand(1, 4, 4)
    reading = make_reading(Observation.of(POINTS[:10], 2), motion=motion, dtype=F64)
    memory = Observation.empty(dtype=F64)
    generator = torch.Generator().manual_seed(3)
    return pose_filter(PoseBelief.uniform(POSES), memory, reading, generator=generator)[0]


@pytest.mark.parametrize("name", ["peakiness", "translation_noise_m", "rotation_noise_rad"])
def test_gradients_reach_the_filters_settings(name: str) -> None:
    start = {"peakiness": 3.0, "translation_noise_m": 0.002, "rotation_noise_rad": 0.03}[name]

    def loss(value: Tensor | float) -> Tensor:
        belief = step(filter_of(**{name: value}))
        return (belief.weights * belief.world_T_object[:, 0, 3]).sum()

    value = wanting(start)
    (slope,) = torch.autograd.grad(loss(value), value)
    h = 1e-6 * start
    numeric = (loss(start + h) - loss(start - h)).detach() / (2 * h)
    torch.testing.assert_close(slope, numeric, rtol=1e-5, atol=1e-9)
    assert float(slope.abs()) > 0


def test_weights_keep_their_slope_through_a_resampling() -> None:
    """Averaged over all offsets of the comb, the gradient of an expectation is that of the weighted particles."""
    random = torch.Generator().manual_seed(0)
    raw, values = (
        torch.randn(5, generator=random, dtype=F64).requires_grad_(),
        torch.randn(5, generator=random, dtype=F64),
    )
    log = raw.log_softmax(-1)
    (expected,) = torch.autograd.grad((log.exp() * values).sum(), raw)
    log, total = raw.log_softmax(-1), torch.zeros((), dtype=F64)
    offsets = (torch.arange(2000, dtype=F64) + 0.5) / 2000
    for offset in offsets:
        index = systematic(log.detach(), offset)
        total = total + (resampled_weights(log, index).exp() * values[index]).sum() / len(offsets)
    (found,) = torch.autograd.grad(total, raw)
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)
    with torch.no_grad():
        assert torch.equal(resampled_weights(log, index), torch.zeros(5, dtype=F64).log_softmax(-1))


def test_the_filter_has_a_slope_through_a_resampling_and_none_through_the_descent() -> None:
    peakiness = wanting(3.0)
    belief = step(filter_of(peakiness=peakiness, trigger=0.0))
    (slope,) = torch.autograd.grad((belief.log_weights * torch.arange(4)).sum(), peakiness)
    assert float(slope.abs()) > 0
    noise = wanting(0.002)
    moved = step(filter_of(translation_noise_m=noise, trigger=0.0)).attached_T_object
    assert not moved.requires_grad or float(torch.autograd.grad(moved.sum(), noise)[0]) == 0


def test_contact_points_noise_may_be_tensors() -> None:
    touch = WrenchTouch(
        POINTS[:2], torch.eye(3, dtype=F64)[:2], 0 * POINTS[:2, 0], 0 * POINTS[:2, 0], torch.zeros(2).long()
    )
    reading = make_reading(tool=se3.identity((1,), dtype=F64), dtype=F64, kind=ContactReading, wrench=touch)

    def likelihood(point_m: Any, normal_rad: Any, outlier: Any) -> Tensor:
        model = ContactPointModel(BOX, point_m, normal_rad, outlier)
        return model.update(None, reading, se3.identity((1,), dtype=F64)).log_likelihood(POSES)

    assert torch.autograd.gradcheck(likelihood, (wanting(0.02), wanting(0.8), wanting(0.2)), eps=1e-7, atol=1e-4)
    torch.testing.assert_close(likelihood(wanting(0.02), 0.8, 0.2), likelihood(0.02, 0.8, 0.2))


@pytest.mark.usefixtures("no_shape_check")
def test_push_models_are_of_one_scene() -> None:
    with pytest.raises(ValueError, match=r"world_T_object to have shape \(N, 4, 4\)"):
        PushModels(PushSettings()).chosen(POSES[None].expand(2, 4, 4, 4), Tool(torch.tensor([[0.0, 0.0], [1.0, 1.0]])))
