"""Plans of a batch of scenes: a row is what the scene gives alone."""

from dataclasses import replace

import pytest
import torch

from kmppi import MPPI, MPPISettings, NonFiniteCostsError, perturbation_cost, sample_weights

SETTINGS = MPPISettings(horizon=7, knots=4, samples=40, noise_variance=0.3, temperature=0.1)
TARGETS = torch.tensor([[0.5, -0.5], [0.1, 0.9], [-0.8, 0.0]], dtype=torch.float64)
KINDS = {
    "KMPPI": SETTINGS,
    "MPPI": replace(SETTINGS, knots=None),
    "SMPPI": replace(SETTINGS, knots=None, changes=True, change_cost=0.5),
    "by deviations": replace(SETTINGS, cost_scale="std", temperature=0.03),
}


def seeded(count: int = 3) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


def toward(targets: torch.Tensor):
    """Squared way from a target of each scene, not finite on one side of it."""

    def objective(controls: torch.Tensor) -> torch.Tensor:
        off = controls - targets[..., None, None, :]
        return torch.where(off[..., 0, 0] > 0.9, torch.inf, off.square().sum((-2, -1)))

    return objective


def same(batch, single, row: int) -> None:
    torch.testing.assert_close(batch[row], single, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_is_the_scene_alone(kind: str) -> None:
    mppi, random = MPPI(KINDS[kind], 2, torch.float64), seeded()
    count = mppi.parameterization.knots
    proposals = 0.5 * torch.ones(3, 2, count, 2, dtype=torch.float64) * torch.tensor([1.0, -1.0])[:, None, None]
    start = mppi.initial(generator=random)
    plan, found = mppi.plan(start, toward(TARGETS), proposals=proposals, iterations=3, generator=random)
    later = mppi.shift(plan, 2)
    assert plan.knots.shape == (3, count, 2) and found.costs.shape == (3, 40) and found.ess.shape == (3,)
    for row, own in enumerate(seeded()):
        first = mppi.initial(generator=own)
        single, alone = mppi.plan(first, toward(TARGETS[row]), proposals=proposals[row], iterations=3, generator=own)
        assert torch.equal(start.knots[row], first.knots)
        for name in ("controls", "costs", "weights", "ess", "best"):
            same(getattr(found, name), getattr(alone, name), row)
        same(plan.knots, single.knots, row)
        same(later.controls, mppi.shift(single, 2).controls, row)


def test_a_scene_without_a_finite_cost_is_told() -> None:
    costs = torch.tensor([[1.0, 2.0], [torch.inf, torch.nan]])
    with pytest.raises(NonFiniteCostsError):
        sample_weights(costs, 0.1)


def test_generators_as_many_as_scenes() -> None:
    mppi = MPPI(SETTINGS, 2)
    start = mppi.initial(generator=seeded())
    with pytest.raises(ValueError, match="one for each scene"):
        mppi.plan(start, toward(TARGETS.float()), generator=seeded(2))
    one, _ = mppi.plan(start, toward(TARGETS.float()), generator=seeded()[0])
    assert one.knots.shape == start.knots.shape


def test_the_perturbation_cost_of_a_nominal_each(generator: torch.Generator) -> None:
    nominal = torch.randn(3, 4, 2, generator=generator, dtype=torch.float64)
    noise = torch.randn(3, 5, 4, 2, generator=generator, dtype=torch.float64)
    variance = torch.tensor([0.5, 2.0], dtype=torch.float64)
    found = perturbation_cost(nominal, noise, variance, 0.3)
    for row in range(3):
        same(found, perturbation_cost(nominal[row], noise[row], variance, 0.3), row)
