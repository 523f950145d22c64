"""The sensor model."""

import pytest
import torch

from sensors.semantics import Semantics, SemanticSensor, log_surface_probability, semantics_probability


def test_golden(golden):
    case = golden("rumi.sensor")
    v = torch.tensor(case["inputs"]["v"], dtype=torch.float64)
    p = semantics_probability(v, case["inputs"]["alpha"], case["inputs"]["zeta"])
    torch.testing.assert_close(p, torch.tensor(case["expected"]["p"], dtype=torch.float64), atol=1e-14, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_to_one_and_finite_far_away(dtype):
    v = torch.cat((torch.linspace(-0.1, 0.1, 401, dtype=dtype), torch.tensor([-1e3, -1.0, 1.0, 1e3], dtype=dtype)))
    p = semantics_probability(v)
    assert torch.isfinite(p).all()
    torch.testing.assert_close(p.sum(-1), torch.ones_like(v))
    assert (p >= 0).all()


def test_surface_falls_to_1_over_e_ten_millimetres_beyond_the_tolerance():
    log = log_surface_probability(torch.tensor([0.013, -0.013, 0.002]))
    torch.testing.assert_close(log, torch.tensor([-1.0, -1.0, 0.0]), atol=1e-6, rtol=0)


def test_module_trains_its_parameters():
    sensor = SemanticSensor(trainable=True).double()
    sensor(torch.tensor([0.01], dtype=torch.float64))[..., Semantics.SURFACE].sum().backward()
    # d/d sharpness of exp(-s (v - t)) at s=100, v-t=0.007
    expected = -0.007 * torch.exp(torch.tensor(-0.7, dtype=torch.float64))
    # of the logarithm, by which it is trained
    torch.testing.assert_close(sensor.raw_sharpness.grad, 100.0 * expected, rtol=1e-5, atol=0)
    assert set(sensor.state_dict()) == {"raw_sharpness", "raw_tolerance"}


def test_small_chances_of_surface_keep_their_digits_in_float32():
    v = torch.tensor([0.103, 0.143, 0.303])
    found = semantics_probability(v)[:, 2].log()
    torch.testing.assert_close(found, log_surface_probability(v), rtol=1e-6, atol=1e-5)
