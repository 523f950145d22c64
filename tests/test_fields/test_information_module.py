"""Information as a module, whose numbers can be trained; and the expected normal."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.fields.information import (
    InformationField,
    InformationSettings,
    information_field,
)
from rumi.fields.normal import expected_normal
from sdf import se3
from sdf.base import SDF
from sdf.primitives import Sphere

# every test of this file holds for the plain and for the compiled version, but where a graph is kept
pytestmark = pytest.mark.usefixtures("version")
Beliefs = Callable[..., tuple[Tensor, Tensor]]
only_plain = pytest.mark.parametrize("version", ["torch"], indirect=True)


def test_expected_normal_is_the_gradient_of_the_expected_distance(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs()
    at = points.clone().requires_grad_()
    inverse = se3.inverse(poses)
    expected = (log_weights.exp()[:, None] * mug.distance(se3.apply(inverse, at.expand(6, 80, 3)))).sum()
    (gradient,) = torch.autograd.grad(expected, at)
    torch.testing.assert_close(expected_normal(mug, poses, log_weights, points), gradient)
    assert bool((gradient.norm(dim=-1) <= 1 + 1e-9).all())


def test_expected_normal_where_asked_and_in_batches(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs(2)
    where = torch.zeros(2, 80, dtype=torch.bool)
    where[0, :5], where[1, 3:9] = True, True
    normal = expected_normal(mug, poses, log_weights, points, where)
    for i in range(2):
        alone = expected_normal(mug, poses[i], log_weights[i], points)
        torch.testing.assert_close(normal[i], alone * where[i][:, None])


@only_plain
def test_module_has_its_numbers_in_its_state_and_trains_them(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs()
    fixed = InformationField(mug, InformationSettings(tail=0.0)).double()
    plain = information_field(mug, poses, log_weights, points, fixed.settings)
    torch.testing.assert_close(fixed(poses, log_weights, points), plain, atol=1e-12, rtol=1e-9)
    assert {"sharpness", "surface_tolerance", "peakiness", "free_scale", "tolerance"} <= set(fixed.state_dict())
    assert not list(fixed.parameters())
    trained = InformationField(Sphere(0.06).double(), InformationSettings("surrogate"), trainable=True).double()
    poses = poses.requires_grad_()
    trained(poses, log_weights, points).information.sum().backward()
    gradients = {name: p.grad for name, p in trained.named_parameters()}
    assert len(gradients) == 4
    assert all(g is not None and bool(g.isfinite()) and float(g) != 0 for g in gradients.values()), gradients
    assert bool(poses.grad.isfinite().all())
    assert float(poses.grad.abs().max()) > 0


def test_module_without_a_graph_is_the_function(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs()
    settings = InformationSettings("reverse_kl", peakiness=1.5, free_scale=8.0, tolerance=0.25, tail=0.0)
    module = InformationField(mug, settings, trainable=True).double()
    with torch.no_grad():
        found = module(poses, log_weights, points)
    names = ("sharpness", "surface_tolerance", "peakiness", "free_scale")
    settings = replace(settings, **{name: getattr(module, name).item() for name in names})  # as float32 has them
    exact = {"atol": 1e-12, "rtol": 1e-9}
    torch.testing.assert_close(found, information_field(mug, poses, log_weights, points, settings), **exact)
    # a number of its own for every point is nothing that one pass can take
    each = torch.full((80,), settings.peakiness, dtype=torch.float64)
    plain = information_field(mug, poses, log_weights, points, settings, peakiness=each)
    torch.testing.assert_close(plain, found, **exact)


def test_the_modules_numbers_are_the_settings_to_the_last_digit() -> None:
    module = InformationField(Sphere(0.06), InformationSettings(surface_tolerance=0.003))
    assert module.surface_tolerance.item() == 0.003
