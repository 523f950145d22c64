"""Readers and scores of real pushes: against the data's stated figures, and a rectangle's closed form."""

import math
import os

import pytest
import torch

from rumi.dynamics.outline import RectangleOutline
from scripts.bench.real_pushes import fixed, polygon_distance, predicted, push_set, repeated_bound, scores


def test_a_polygon_s_distance_is_a_rectangle_s():
    corners = torch.tensor([[-0.06, -0.03], [0.06, -0.03], [0.06, 0.03], [-0.06, 0.03]], dtype=torch.float64)
    points = 0.2 * torch.rand(500, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.1
    torch.testing.assert_close(polygon_distance(points, corners), RectangleOutline((0.06, 0.03))(points).distance)


def test_errors_are_along_and_across_the_way():
    path = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]]])
    end = torch.zeros(1, 3)
    found = scores(torch.tensor([[0.003, 0.004, math.radians(359)]]), end, path)
    assert [float(part) for part in found] == pytest.approx([5.0, 1.0, 4.0, -3.0], abs=1e-3)


@pytest.mark.data
@pytest.mark.skipif("RUMI_DATA" not in os.environ, reason="needs recorded data")
def test_what_the_data_says_of_itself():
    own = push_set("abs rect1")
    rows = torch.arange(len(own.start))
    errors = scores(predicted(fixed(0.2, 1.0), own, rows).mean(), own.end, own.path)
    assert float(errors.place_mm.mean()) == pytest.approx(2.95, abs=0.1)
    assert float(scores(own.zhou, own.end, own.path).place_mm.mean()) == pytest.approx(3.26, abs=0.01)
    assert all(0 < place < 1.2 and 0 < turn < 1.7 for _, place, turn in repeated_bound())
