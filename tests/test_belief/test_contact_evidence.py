"""Closed forms of the likelihoods of contact points and of contact signals."""

import math

import pytest
import torch

from rumi.belief.contact_evidence import ContactPointEvidence, ContactSignalEvidence
from sdf import se3
from sdf.primitives import Sphere
from sensors.touch.contact_model import ContactModel

RADIUS = 0.04


def ball():
    return Sphere(RADIUS)


def at(*places):
    return se3.from_planar(torch.tensor([[x, y, 0.0] for x, y in places]))


def touched(points, outlier=0.1, point_sd=0.004, normal_sd=0.3):
    points = torch.tensor(points)
    normals = torch.nn.functional.normalize(points, dim=-1)
    count = len(points)
    return ContactPointEvidence(
        ball(), points, normals, torch.full((count,), point_sd), torch.full((count,), normal_sd), outlier
    )


def test_a_touch_has_the_likelihood_of_its_distance_and_angle():
    """Against the closed form for a ball moved along the normal, and aside."""
    evidence = touched([[RADIUS, 0.0, 0.0]], outlier=0.0)
    off = torch.tensor([0.0, 0.003, -0.006])
    found = evidence.log_likelihood(at(*[(float(x), 0.0) for x in off]))
    torch.testing.assert_close(found, -0.5 * (off / 0.004).square(), atol=1e-4, rtol=0.0)
    aside = 0.01
    distance = math.hypot(RADIUS, aside) - RADIUS
    expected = -0.5 * (distance / 0.004) ** 2 - 0.5 * (math.atan2(aside, RADIUS) / 0.3) ** 2
    assert float(evidence.log_likelihood(at((0.0, aside)))) == pytest.approx(expected, abs=1e-3)


def test_an_outlier_costs_no_more_than_its_share_says():
    evidence = touched([[RADIUS, 0.0, 0.0]])
    fit, near, far = evidence.log_likelihood(at((0.0, 0.0), (0.5, 0.0), (3.0, 0.0))).tolist()
    density = math.log(2.0 * math.pi * 0.004 * 0.3 / (2.0 * 0.1 * math.pi))
    assert near == pytest.approx(math.log(0.1) + density, abs=1e-3) and far == pytest.approx(near, abs=1e-4)
    assert math.log(0.9) - 1e-6 <= fit <= 0.01


def test_a_signal_is_as_likely_as_the_nearest_point_is_near():
    model = ContactModel(0.95, 0.02, 150.0)
    surface = torch.tensor([[[RADIUS, 0.0, 0.0], [0.2, 0.0, 0.0]]])
    poses = at((0.0, 0.0), (-0.01, 0.0), (-0.5, 0.0))
    found = ContactSignalEvidence(ball(), surface, model).log_likelihood(poses).exp()
    expected = [0.95, 0.02 + 0.93 * math.exp(-1.5), 0.02]
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-4, rtol=0.0)
