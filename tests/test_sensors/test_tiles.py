"""Boxes of points hold what they should, and the slope that lets them be skipped is an upper bound."""

import math

import pytest
import torch

from sdf.grid_sdf import GridSDF
from sdf.primitives import Mug
from sensors.semantics import Semantics
from sensors.tiles import steepness, tiles


def scattered(
    count: int, generator: torch.Generator, scale: float = 0.2
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    points = scale * torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    semantics = torch.randint(0, 3, (2, count), generator=generator)
    return points, semantics, torch.rand(2, count, generator=generator) < 0.8


@pytest.mark.parametrize(("count", "scale"), [(2000, 0.2), (7, 0.2), (300, 0.0), (300, 1e4), (1, 1.0)])
def test_boxes_hold_every_point_once(generator, count, scale):
    points, semantics, valid = scattered(count, generator, scale)
    found = tiles(points, semantics, valid, 0.1)
    for b in range(2):
        surface, hinged, smalls, larges = found.counts[b].tolist()
        seen = valid[b] & (semantics[b] == Semantics.SURFACE)
        assert surface == int(seen.sum())
        assert torch.equal(torch.from_numpy(found.surface[b, :, :surface]).mT, points[b][seen])
        rest = valid[b] & (semantics[b] != Semantics.SURFACE)
        assert hinged == int(rest.sum())
        signs = 1.0 - 2.0 * (semantics[b][rest] == Semantics.OCCUPIED)
        expected = torch.cat((points[b][rest], signs[:, None]), -1)
        boxed = torch.cat(
            (torch.from_numpy(found.hinged[b, :, :hinged]).mT, torch.from_numpy(found.signs[b, :hinged])[:, None]), -1
        )
        assert sorted(map(tuple, boxed.tolist())) == sorted(map(tuple, expected.tolist()))
        small, large = found.small_first[b, : smalls + 1], found.large_first[b, : larges + 1]
        assert small[-1] == hinged and large[-1] == smalls
        for n in range(smalls):
            inside = boxed[small[n] : small[n + 1]]
            ball = torch.from_numpy(found.small_balls[b, :, n])
            assert float(((inside[:, :3] - ball[:3]).norm(dim=-1) - ball[3]).max()) < 1e-9 * (1 + scale)
            assert (inside[:, 3] == ball[4]).all()
        for n in range(larges):
            inside = boxed[small[large[n]] : small[large[n + 1]]]
            ball = torch.from_numpy(found.large_balls[b, :, n])
            assert float(((inside[:, :3] - ball[:3]).norm(dim=-1) - ball[3]).max()) < 1e-9 * (1 + scale)
            assert (inside[:, 3] == ball[4]).all()


def test_the_last_points_are_kept_and_followed(generator):
    points, semantics, valid = scattered(50, generator)
    first = tiles(points, semantics, valid, 0.1)
    assert tiles(points, semantics, valid, 0.1) is first
    assert tiles(points, semantics, valid, 0.2) is not first
    first = tiles(points, semantics, valid, 0.1)
    points += 1.0
    again = tiles(points, semantics, valid, 0.1)
    assert again is not first
    assert float(abs(again.surface[0, :, 0] - first.surface[0, :, 0]).min()) > 0.9


@pytest.mark.parametrize("outer", [0.25, 0.0])
def test_no_two_distances_differ_by_more_than_the_slope_allows(generator, outer):
    table = GridSDF.from_sdf(Mug().double(), 0.004, outer=outer)
    slope = steepness(table)
    assert 1.0 <= slope < 2.0
    start = torch.cat(
        [scale * torch.randn(4000, 3, generator=generator, dtype=torch.float64) for scale in (0.05, 0.3, 2.0)]
    )
    end = start + 0.05 * torch.randn(len(start), 3, generator=generator, dtype=torch.float64)
    rise = (table.distance(end) - table.distance(start)).abs() / (end - start).norm(dim=-1)
    assert float(rise.max()) <= slope


def test_a_table_that_is_no_distance_has_no_known_slope():
    table = GridSDF.from_sdf(Mug().double(), 0.01)
    assert math.isfinite(steepness(table))
    table.values[0] = 0.0
    assert math.isinf(steepness(table))
    table.values[0] = 1.0
    table.values[10, 10, 10] += 1.0
    assert steepness(table) > 50.0
