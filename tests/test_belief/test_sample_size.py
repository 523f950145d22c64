"""Sample size by the Kullback-Leibler distance: the bound holds for draws, and cells are counted whatever they are."""

import math

import pytest
import torch

from rumi.belief.sample_size import kld_sample_size, occupied_cells


@pytest.mark.parametrize("cells", [2, 5, 30, 200])
@pytest.mark.parametrize("error", [0.02, 0.1])
def test_so_many_draws_come_as_near_as_asked_with_99_percent(cells, error):
    """Of even and of uneven distributions: the share of draws farther off is about one in a hundred."""
    random = torch.Generator().manual_seed(cells)
    many, trials = kld_sample_size(cells, error), 500
    for weights in (torch.ones(cells), torch.linspace(1.0, 3.0, cells)):
        share = (weights / weights.sum()).double()
        drawn = torch.multinomial(share.float(), trials * many, replacement=True, generator=random).view(trials, many)
        counts = torch.zeros(trials, cells, dtype=torch.float64).scatter_add_(1, drawn, torch.ones_like(drawn).double())
        found = counts / many
        distance = torch.xlogy(found, found / share).sum(-1)
        assert 0.0 < float((distance > error).double().mean()) < 0.035  # the bound is asymptotic


def test_one_cell_needs_one_draw_and_more_need_more():
    sizes = [kld_sample_size(cells, 0.05) for cells in range(1, 400)]
    assert sizes[0] == 1 and sizes == sorted(sizes)
    assert kld_sample_size(100, 0.025) == pytest.approx(2 * kld_sample_size(100, 0.05), abs=2)


def poses(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def test_cells_are_counted_by_place_yaw_way_of_resting_edge_and_tilt():
    one = (0.1, 0.2, 0.3, 1.0, -1.0, 0.0)
    others = [[*one[:k], one[k] + step, *one[k + 1 :]] for k, step in enumerate((0.005, 0.005, 0.1, 1.0, 1.0, 0.1))]
    assert occupied_cells(poses(one)) == occupied_cells(poses(one, one)) == 1
    assert occupied_cells(poses(one, *others)) == 7


def test_cells_far_apart_are_told_apart():
    """Numbers whose product no integer holds are counted row by row."""
    far = poses((1e6, -1e6, 0.0, 0, -1, 0.0), (-1e6, 1e6, 3.0, 9, 5, 1.5), (1e6, 1e6, -3.0, 0, -1, 0.0))
    assert occupied_cells(far) == 3
    assert math.isfinite(kld_sample_size(10**9, 0.05))
