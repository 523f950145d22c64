"""The momentum observer: its filter in closed form, its noise, and recordings; with a robot see test_robot_dynamics."""

import math

import pytest
import torch
from torch import Tensor

from sensors.force.momentum_observer import (
    DynamicsTerms,
    MomentumObserver,
    RobotDynamics,
    TorqueThreshold,
    external_torque,
    residuals,
)

F64 = torch.float64
MASS = torch.tensor([[2.0, 0.3, 0.1], [0.3, 1.0, 0.05], [0.1, 0.05, 0.2]], dtype=F64)


class Block:
    """Constant mass, a bias that depends on position and velocity."""

    def __call__(self, position: Tensor, velocity: Tensor) -> DynamicsTerms:
        return DynamicsTerms(MASS, 3.0 * position.sin() + 0.5 * velocity)


def still(batch: tuple[int, ...] = ()) -> DynamicsTerms:
    return DynamicsTerms(MASS.expand(*batch, 3, 3), torch.zeros(*batch, 3, dtype=F64))


@pytest.mark.parametrize("gain", [5.0, 25.0, 400.0])
def test_a_step_shows_as_a_first_order_filter_says(gain: float) -> None:
    observer, step = MomentumObserver(gain), 0.004
    state = observer.start(still(), torch.zeros(3, dtype=F64))
    pushed = torch.tensor([1.0, -2.0, 0.5], dtype=F64)
    for index in range(1, 120):
        # the motors hold against what pushes: nothing moves
        state = observer.step(state, still(), torch.zeros(3, dtype=F64), -pushed, step)
        expected = pushed * -math.expm1(-gain * index * step)
        torch.testing.assert_close(state.residual, expected, rtol=1e-12, atol=1e-14)


def test_a_free_motion_shows_what_pushes_and_nothing_else(generator: torch.Generator) -> None:
    # a motion in closed form, with the torques that it takes of Block, less what the world gives
    step, pushed = 0.001, torch.tensor([0.7, -0.4, 0.2], dtype=F64)
    time = step * torch.arange(600, dtype=F64)[:, None]
    rate = torch.tensor([3.0, 5.0, 7.0], dtype=F64)
    position, velocity, acceleration = (rate * time).sin(), rate * (rate * time).cos(), -(rate**2) * (rate * time).sin()
    torque = acceleration @ MASS + 3.0 * position.sin() + 0.5 * velocity - pushed
    found = residuals(Block(), time[:, 0], position, velocity, torque, MomentumObserver(25.0))
    expected = pushed * -torch.expm1(-25.0 * time)
    # of second order in the step
    assert float((found - expected).abs().max()) < 2e-4
    half = residuals(Block(), time[::2, 0], position[::2], velocity[::2], torque[::2], MomentumObserver(25.0))
    coarse, fine = (half - expected[::2]).abs().max(), (found - expected).abs().max()
    assert float(coarse / fine) == pytest.approx(4.0, rel=0.1)
    assert isinstance(Block(), RobotDynamics)


def test_a_recording_is_what_the_steps_are(generator: torch.Generator) -> None:
    stamps = torch.rand(50, generator=generator, dtype=F64).mul(0.01).cumsum(0)
    position, velocity, torque = (torch.randn(50, 3, generator=generator, dtype=F64) for _ in range(3))
    observer, model = MomentumObserver(40.0), Block()
    state = observer.start(model(position[0], velocity[0]), velocity[0])
    found = [state.residual]
    for k in range(1, 50):
        mean = 0.5 * (torque[k] + torque[k - 1])
        state = observer.step(
            state, model(position[k], velocity[k]), velocity[k], mean, float(stamps[k] - stamps[k - 1])
        )
        found.append(state.residual)
    torch.testing.assert_close(residuals(model, stamps, position, velocity, torque, observer), torch.stack(found))
    assert residuals(model, stamps[:1], position[:1], velocity[:1], torque[:1]).tolist() == [[0.0] * 3]
    assert residuals(model, stamps[:0], position[:0], velocity[:0], torque[:0]).shape == (0, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_of_a_batch_are_robots_alone(dtype: torch.dtype, generator: torch.Generator) -> None:
    observer = MomentumObserver()
    velocity, torque, bias = (torch.randn(4, 3, generator=generator, dtype=dtype) for _ in range(3))
    terms = DynamicsTerms(MASS.to(dtype).expand(4, 3, 3), bias)
    start = observer.start(terms, torch.zeros(4, 3, dtype=dtype))
    steps = torch.tensor([0.001, 0.002, 0.004, 0.01], dtype=dtype)
    found = observer.step(start, terms, velocity, torque, steps).residual
    for row in range(4):
        own = DynamicsTerms(MASS.to(dtype), bias[row])
        alone = observer.step(
            observer.start(own, torch.zeros(3, dtype=dtype)), own, velocity[row], torque[row], float(steps[row])
        )
        torch.testing.assert_close(alone.residual, found[row])


def test_gradients_reach_torque_velocity_and_mass(generator: torch.Generator) -> None:
    values = [torch.randn(3, generator=generator, dtype=F64, requires_grad=True) for _ in range(3)]
    mass = MASS.clone().requires_grad_()

    def external(before: Tensor, after: Tensor, torque: Tensor, mass: Tensor) -> Tensor:
        terms = DynamicsTerms(mass, torch.zeros(3, dtype=F64))
        return external_torque(terms, before, terms, after, torque, 0.01)

    assert torch.autograd.gradcheck(external, (*values, mass))


def test_noise_comes_through_as_the_covariance_says(generator: torch.Generator) -> None:
    observer, step, count = MomentumObserver(25.0), 0.001, 30000
    velocity = 0.002 * torch.randn(count + 1, 3, generator=generator, dtype=F64)
    torque = 0.15 * torch.randn(count, 3, generator=generator, dtype=F64)
    raw = external_torque(still(), velocity[:-1], still(), velocity[1:], torque, step)
    share = -math.expm1(-25.0 * step)
    # the filter as a sum over what came before, which is the same
    kernel = share * (1.0 - share) ** torch.arange(600, dtype=F64)
    padded = torch.nn.functional.pad(raw.T[:, None], (len(kernel) - 1, 0))
    found = torch.nn.functional.conv1d(padded, kernel.flip(0)[None, None])[:, 0, 600:]
    torch.testing.assert_close(
        found[:, :200].T, observer.run(raw[:800], torch.full((800,), step))[600:], rtol=1e-4, atol=1e-6
    )
    expected = observer.covariance(MASS, 0.15, 0.002, step)
    torch.testing.assert_close(found @ found.T / found.shape[1], expected, rtol=0.2, atol=1e-4)


def test_signals_are_norms_above_the_threshold() -> None:
    residual = torch.tensor([[3.0, 4.0, 0, 0, 0, 9.0, 9.0], [0.0, 0, 0, 0, 4.9, 0, 0]], dtype=F64)
    threshold = TorqueThreshold(4.95)
    assert threshold.norm(residual).tolist() == pytest.approx([5.0, 4.9])
    assert threshold.contact(residual).tolist() == [True, False]
    assert TorqueThreshold(4.95, joints=7).contact(residual).tolist() == [True, False]
    assert TorqueThreshold(4.95, joints=2).contact(residual[:, :2]).tolist() == [True, False]
    rested = threshold.at_rest(residual[:1].expand(4, 7))
    assert rested.norm(residual)[0] == 0
    assert TorqueThreshold.above(residual, 2.0).threshold_nm == pytest.approx(10.0)
    assert TorqueThreshold.above(residual, 2.0, joints=7).threshold_nm == pytest.approx(2.0 * math.hypot(5.0, 9.0, 9.0))


def test_what_makes_no_sense_is_refused() -> None:
    rows = torch.zeros(3, 3, dtype=F64)
    with pytest.raises(ValueError, match="rise"):
        residuals(Block(), torch.tensor([0.0, 0.1, 0.1], dtype=F64), rows, rows, rows)
    with pytest.raises(ValueError, match="finite"):
        residuals(Block(), torch.tensor([0.0, 0.1, 0.2], dtype=F64), rows, rows, rows / 0)
    with pytest.raises(ValueError, match="gain above 0"):
        MomentumObserver(0.0)
    with pytest.raises(ValueError, match="threshold_nm"):
        TorqueThreshold(0.0)
    with pytest.raises(ValueError, match="joint"):
        TorqueThreshold(1.0, joints=0)
    with pytest.raises(ValueError, match="finite"):
        TorqueThreshold(1.0).contact(rows[:1] / 0)
    with pytest.raises(ValueError, match="got none"):
        TorqueThreshold.above(rows[:0])
    with pytest.raises(ValueError, match="got none"):
        TorqueThreshold(1.0).at_rest(rows[:0])
    assert TorqueThreshold(1.0).contact(rows[:0]).shape == (0,)


def test_a_row_a_stamp_is_asked_for(no_shape_check: None) -> None:
    rows = torch.zeros(3, 3, dtype=F64)
    with pytest.raises(ValueError, match="torque to have a row a stamp"):
        residuals(Block(), torch.tensor([0.0, 0.1, 0.2], dtype=F64), rows, rows, rows[:2])
