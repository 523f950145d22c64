"""Splines through via-points, and pokes into a belief."""

import math

import pytest
import torch

from rumi.dynamics.along_path import distance_to
from rumi.dynamics.sliding import rotated
from rumi.tasks.touch_box.candidates import clamped_spline, evenly, pokes
from rumi.tasks.touch_box.scene import TouchTask


def drawn(generator, count=20, **changes):
    task = TouchTask()
    poses = task.prior.sample(200, generator=generator)
    options = {"length_m": 0.2, "readings": 40, "bend": 0.1} | changes
    found = pokes(
        poses,
        torch.zeros(200, dtype=torch.float64),
        task.outline,
        task.half,
        task.fingers,
        count,
        generator=generator,
        **options,
    )
    return task, poses, found


@pytest.mark.parametrize("count", [2, 3, 6])
def test_a_spline_meets_its_via_points_and_rests_at_its_ends(count, generator):
    via = torch.randn(4, count, 2, generator=generator, dtype=torch.float64)
    phase = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
    torch.testing.assert_close(clamped_spline(via, phase), via, atol=1e-12, rtol=0)
    step = 1e-5
    for end, inner in ((0.0, step), (1.0, 1.0 - step)):
        ends = clamped_spline(via, torch.tensor([end, inner], dtype=torch.float64))
        assert float((ends[:, 1] - ends[:, 0]).abs().max()) / step < 1e-2


def test_a_spline_is_twice_smooth_at_its_via_points(generator):
    via = torch.randn(5, 2, generator=generator, dtype=torch.float64)
    step = 1e-4
    for knot in (0.25, 0.5, 0.75):
        phase = knot + step * torch.tensor([-2.0, -1.0, 0.0, 1.0, 2.0], dtype=torch.float64)
        a, b, c, d, e = clamped_spline(via, phase)
        left, right = (a - 2 * b + c) / step**2, (c - 2 * d + e) / step**2
        torch.testing.assert_close(left, right, atol=0.2, rtol=1e-2)


def test_points_are_even_along_a_line():
    turn = torch.linspace(0.0, math.pi, 2001, dtype=torch.float64) ** 2 / math.pi
    arc = torch.stack((turn.cos(), turn.sin()), -1)
    points = evenly(arc, 9)
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    torch.testing.assert_close(steps, torch.full_like(steps, 2 * math.sin(math.pi / 16)), atol=1e-5, rtol=0)
    torch.testing.assert_close(points[[0, -1]], arc[[0, -1]])


def test_pokes_end_in_a_particle_and_begin_where_none_is(generator):
    task, poses, found = drawn(generator)
    assert found.shape == (20, 41, 3)
    ends = rotated(found[:, None, -1, :2] - poses[:, :2], -poses[:, 2])
    assert bool((ends.abs() <= torch.tensor(task.half) + 1e-9).all(-1).any(1).all())
    torch.testing.assert_close((found[:, -1] - found[:, 0])[:, :2].norm(dim=-1), torch.full((20,), 0.2).double())
    one = poses[:1]
    start = found[:, 0]
    apart = torch.stack([distance_to(poses, s.expand(len(poses), 3), task.fingers, task.outline) for s in start])
    # of the whole prior, few boxes are in the way of coming down
    assert float((apart < 0).double().mean()) < 0.05
    assert one.shape == (1, 3)


def test_straight_pokes_look_where_they_go(generator):
    _, _, found = drawn(generator, bend=0.0)
    way = found[:, -1, :2] - found[:, 0, :2]
    torch.testing.assert_close(torch.atan2(way[:, 1], way[:, 0]).cos(), found[:, 0, 2].cos(), atol=1e-9, rtol=0)
    middle = 0.5 * (found[:, 0, :2] + found[:, -1, :2])
    torch.testing.assert_close(found[:, 20, :2], middle, atol=1e-9, rtol=0)


def test_bent_pokes_leave_the_straight_line(generator):
    _, _, found = drawn(generator, bend=0.3)
    middle = 0.5 * (found[:, 0, :2] + found[:, -1, :2])
    assert float((found[:, 20, :2] - middle).norm(dim=-1).median()) > 0.01
