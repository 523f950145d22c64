"""Long chains: they visit what they should, and say when they do not."""

import math

import pytest
import torch

from scripts.bench.chains import (
    ChainSettings,
    coordinates,
    effective_size,
    folded,
    split_r_hat,
    tempered_chains,
)
from sdf import se3, so3

F64 = torch.float64
LOW, HIGH = torch.tensor([-0.1, -0.1, 0.0], dtype=F64), torch.tensor([0.1, 0.1, 0.0], dtype=F64)


def random(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.slow
def test_chains_weigh_two_modes_that_lie_apart():
    def log_density(poses):
        planar = se3.to_planar(poses)

        def mode(x, yaw):
            turn = torch.remainder(planar[:, 2] - yaw + math.pi, 2 * math.pi) - math.pi
            off = torch.stack((planar[:, 0] - x, planar[:, 1], 0.02 * turn), -1)
            return -0.5 * (off / 0.004).square().sum(-1)

        return torch.logaddexp(mode(0.05, 2.0), mode(-0.05, -1.0) + math.log(3.0))

    settings = ChainSettings(burn_in=1000, steps=3000, thin=3, inverse_temperatures=(1.0, 0.3, 0.1, 0.02))
    chains = tempered_chains(log_density, LOW, HIGH, "SE(2)", settings, generator=random())
    values = coordinates(chains.poses, "SE(2)")
    assert float(split_r_hat(values).max()) < 1.05
    assert 0.15 < chains.accepted < 0.6
    left = chains.poses[..., 0, 3] < 0
    assert float(left.double().mean()) == pytest.approx(0.75, abs=0.08)
    own = chains.poses[left]
    assert float(own[:, 0, 3].mean()) == pytest.approx(-0.05, abs=5e-4)
    assert float(own[:, 0, 3].std()) == pytest.approx(0.004, rel=0.15)
    assert float(own[:, 1, 3].std()) == pytest.approx(0.004, rel=0.15)


def test_r_hat_tells_chains_apart():
    draws = torch.randn(4, 1000, 2, generator=random(), dtype=F64)
    torch.testing.assert_close(split_r_hat(draws), torch.ones(2, dtype=F64), atol=0.01, rtol=0)
    draws[2, :, 1] += 3.0
    assert float(split_r_hat(draws)[1]) > 1.3
    drift = draws[..., :1] + torch.linspace(0.0, 4.0, 1000, dtype=F64)[None, :, None]
    assert float(split_r_hat(drift)) > 1.3


@pytest.mark.parametrize("memory", [0.0, 0.6, 0.9])
def test_the_effective_size_of_a_known_process(memory):
    count = 20000
    noise = torch.randn(4, count, 1, generator=random(1), dtype=F64)
    values = torch.zeros_like(noise)
    for step in range(1, count):
        values[:, step] = memory * values[:, step - 1] + noise[:, step]
    expected = 4 * count * (1 - memory) / (1 + memory)
    assert float(effective_size(values)) == pytest.approx(expected, rel=0.1)


def test_equal_poses_of_a_symmetric_object_are_folded_on_one():
    symmetries = torch.diag_embed(torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=F64))
    pose = se3.make(so3.exp(torch.tensor([0.1, 0.2, -0.3], dtype=F64)), torch.tensor([1.0, 2.0, 3.0], dtype=F64))
    same = pose @ se3.make(symmetries, torch.zeros(4, 3, dtype=F64))
    torch.testing.assert_close(folded(same, symmetries, torch.eye(3, dtype=F64)), pose.expand(4, 4, 4))
