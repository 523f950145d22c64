"""The built-in drill: its size, and that turned round it is far from itself."""

import math

import torch

from rumi.metrics.likelihood import negative_log_likelihood
from sdf import se3
from sdf.drill import Drill, drill_model


def nll(model, x, yaw):
    pose = se3.from_planar(torch.tensor([[x, 0.0, yaw]]))
    return float(negative_log_likelihood(pose, torch.zeros(1), torch.eye(4), model.surface_points, model.exact))


def test_is_about_as_large_as_the_ycb_drill():
    low, high = Drill().bounds
    assert 0.15 < float((high - low)[0]) < 0.20
    assert 0.05 < float((high - low)[1]) < 0.07
    assert float(low[2]) == 0.0 and 0.18 < float(high[2]) < 0.19


def test_half_a_turn_is_refuted_wherever_it_stands():
    """The paper's threshold is 100: a drill turned round must cost far more, also where it fits best."""
    model = drill_model()
    turned = [nll(model, x, math.pi) for x in torch.arange(-0.06, 0.10, 0.01).tolist()]
    assert min(turned) > 400
    assert nll(model, 0.0, 0.0) == 0.0
    # and what is nearly right is within it
    assert nll(model, 0.005, math.radians(5)) < 100 < nll(model, 0.0, math.radians(20))


def test_stands_on_its_base():
    model = drill_model()
    assert -1e-6 <= float(model.surface_points[:, 2].min()) < 0.001
    base = model.surface_points[:, 2] < 0.039
    assert float(model.surface_points[base, 0].abs().max()) < 0.038
    # the body is ahead of it
    assert float(model.surface_points[~base, 0].mean()) > 0.02
    assert model.symmetries.trivial
