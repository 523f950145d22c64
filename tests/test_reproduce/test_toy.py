"""Figure 8's toy: its map, and what it is there to show."""

import statistics

import pytest
import torch

from scripts.reproduce import toy


def test_the_map_and_the_step():
    hill, goal = (torch.tensor(place, dtype=torch.float64) for place in (toy.HILL, toy.GOAL))
    assert toy.cost_map(goal).item() < 1.0
    # 200 on top of the squared distance to the goal, 2.5^2 + 3^2
    assert toy.cost_map(hill).item() == pytest.approx(200.0 + 15.25)
    # 0.25 (x^2 + x y + y^2) at (1, 1): 0.75
    beside = hill + 1.0
    assert toy.cost_map(beside).item() == pytest.approx(
        (beside - goal).square().sum().item() + 200.0 * torch.tensor(-0.75).exp().item(), rel=1e-6
    )
    moved = toy.step(hill, torch.tensor([1.0, 1.0], dtype=torch.float64))
    assert (moved - hill).tolist() == [0.5, -0.5]
    control = torch.tensor([[1.0, -2.0]], dtype=torch.float64)
    assert (toy.running_cost(hill[None], control) - toy.cost_map(hill[None])).item() == pytest.approx(0.5)


@pytest.mark.slow
def test_knots_are_smoothest_and_cost_no_more():
    """What the figure shows, over some seeds."""
    runs = {name: [toy.carry_out(name, seed)["figures"] for seed in range(1000, 1007)] for name in toy.SETTINGS}

    def middle(name, figure):
        return statistics.median(run[figure] for run in runs[name])

    for figure in ("change", "jerk", "plan_jerk"):
        assert middle("KMPPI", figure) < middle("SMPPI", figure) < middle("MPPI", figure)
    assert middle("KMPPI", "cost") < 1.05 * min(middle("SMPPI", "cost"), middle("MPPI", "cost"))
