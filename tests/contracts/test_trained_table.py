"""A table of distances that is trained: every operation that looks it up keeps the graph to its values."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.information import information_field
from rumi.fields.normal import expected_normal
from rumi.metrics.likelihood import self_agreement
from sdf import se3
from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Box
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation


def seen(points: Tensor) -> Observation:
    return Observation.of(points, 2)


def even(poses: Tensor) -> Tensor:
    return poses.new_zeros(len(poses)).log_softmax(-1)


OPERATIONS: dict[str, Callable[[SDF, Tensor, Tensor], Tensor]] = {
    "posed_distance": posed_distance,
    "posed_query": lambda sdf, poses, points: posed_query(sdf, poses, points).gradient,
    "discrepancy": lambda sdf, poses, points: Discrepancy(sdf, 0.1)(poses, seen(points)),
    "information_field": lambda sdf, poses, points: information_field(sdf, poses, even(poses), points).information,
    "expected_normal": lambda sdf, poses, points: expected_normal(sdf, poses, even(poses), points),
    "self_agreement": lambda sdf, poses, points: self_agreement(PoseBelief.uniform(poses), points, sdf).expected_nll,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_keeps_the_graph(name: str, generator: torch.Generator) -> None:
    grid = GridSDF.from_sdf(Box((0.03, 0.05, 0.07)).double(), 0.01)
    values = grid.values
    del grid.values
    grid.values = torch.nn.Parameter(values)
    poses = se3.from_planar(0.02 * torch.randn(3, 3, generator=generator, dtype=torch.float64))
    points = 0.04 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    found = OPERATIONS[name](grid, poses, points)
    (slope,) = torch.autograd.grad(found.sum(), grid.values)
    assert float(slope.abs().max()) > 0
    with torch.no_grad():
        torch.testing.assert_close(OPERATIONS[name](grid, poses, points), found.detach(), atol=1e-6, rtol=1e-6)
