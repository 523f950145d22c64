"""Beliefs about a mug, and points about it."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sdf import se3
from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.primitives import Mug

Beliefs = Callable[..., tuple[Tensor, Tensor]]


@pytest.fixture
def beliefs(generator: torch.Generator) -> Beliefs:
    def make(*batch: int, count: int = 6, spread: float = 0.02) -> tuple[Tensor, Tensor]:
        tangent = torch.randn(*batch, count, 6, generator=generator, dtype=torch.float64)
        poses = se3.exp(tangent * torch.tensor([spread] * 3 + [0.4] * 3, dtype=torch.float64))
        weights = torch.randn(*batch, count, generator=generator, dtype=torch.float64)
        return poses, weights.log_softmax(-1)

    return make


@pytest.fixture(scope="module")
def mug() -> SDF:
    return GridSDF.from_sdf(Mug(), spacing=0.004).double()


@pytest.fixture
def points(generator: torch.Generator) -> Tensor:
    return 0.3 * torch.rand(80, 3, generator=generator, dtype=torch.float64) - 0.1
