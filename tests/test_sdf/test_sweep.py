"""Where a moving ball first touches an object."""

import math

import torch

from sdf.sweep import nearest_on_rectangle, sweep_rectangle, turned

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05], dtype=F64)
RADIUS = 0.0125


def scene(count):
    generator = torch.Generator().manual_seed(3)
    poses = torch.rand(count, 3, generator=generator, dtype=F64) * torch.tensor([0.2, 0.2, 2 * math.pi])
    start, end = 0.6 * torch.rand(2, count, 2, generator=generator, dtype=F64) - 0.2
    return poses, start, end


def marched(poses, start, end, steps=4000):
    """The first of many points of the way that is within the radius."""
    share = torch.linspace(0.0, 1.0, steps, dtype=F64)[:, None, None]
    at = start + share * (end - start)
    own = (turned(-poses[:, 2]) @ (at - poses[:, :2])[..., None])[..., 0]
    gap = nearest_on_rectangle(own, HALF)[2] - RADIUS
    touching = gap <= 0
    first = touching.to(torch.uint8).argmax(0)
    way = (end - start).norm(dim=-1)
    return touching.any(0), torch.where(touching.any(0), first * way / (steps - 1), way), gap.amin(0), way / (steps - 1)


def test_a_rectangle_is_met_where_marching_meets_it():
    poses, start, end = scene(400)
    found = sweep_rectangle(poses, HALF, start, end, RADIUS)
    hit, distance, least, step = marched(poses, start, end)
    sure = least.abs() > 1e-5
    assert torch.equal(found.hit[sure], hit[sure])
    both = found.hit & hit
    assert 100 < int(both.sum()) < 390
    assert bool((found.distance[both] <= distance[both] + 1e-9).all())
    assert bool((found.distance[both] >= distance[both] - step[both] - 1e-9).all())
    # the point is on the border, the normal leads from it to the disc's centre
    moving = both & (found.distance > 0)
    centre = start + found.distance[:, None] * torch.nn.functional.normalize(end - start, dim=-1)
    assert torch.allclose((found.point + RADIUS * found.normal)[moving], centre[moving], atol=1e-12)
    own = (turned(-poses[:, 2]) @ (found.point - poses[:, :2])[..., None])[..., 0]
    assert bool((nearest_on_rectangle(own, HALF)[2][both].abs() < 1e-12).all())
    assert torch.equal(found.distance[~found.hit], (end - start).norm(dim=-1)[~found.hit])


def test_a_corner_has_the_normals_between():
    pose = torch.zeros(3, dtype=F64)
    start = torch.tensor([0.3, 0.05 + 0.6 * RADIUS], dtype=F64)
    found = sweep_rectangle(pose, HALF, start, start - torch.tensor([0.4, 0.0], dtype=F64), RADIUS)
    assert bool(found.hit)
    assert torch.allclose(found.point, HALF)
    assert torch.allclose(found.normal, torch.tensor([0.8, 0.6], dtype=F64))
    above = start + torch.tensor([0.0, RADIUS], dtype=F64)
    assert not bool(sweep_rectangle(pose, HALF, above, above - torch.tensor([0.4, 0.0], dtype=F64), RADIUS).hit)


def test_it_overlaps_from_the_start_or_does_not_move():
    pose = torch.zeros(3, dtype=F64)
    start = torch.tensor([0.09, 0.0], dtype=F64)
    found = sweep_rectangle(pose, HALF, start, start + torch.tensor([0.3, 0.0], dtype=F64), RADIUS)
    assert bool(found.hit) and float(found.distance) == 0.0
    assert torch.allclose(found.normal, torch.tensor([1.0, 0.0], dtype=F64))
    assert torch.allclose(found.point, torch.tensor([0.1, 0.0], dtype=F64))
    far = torch.tensor([0.5, 0.5], dtype=F64)
    assert not bool(sweep_rectangle(pose, HALF, far, far, RADIUS).hit)
