"""Where a moving ball first touches an object."""

import math

import pytest
import torch

from sdf import se3
from sdf.mesh.triangles import Triangles
from sdf.sweep import nearest_on_rectangle, sweep_mesh, sweep_rectangle, turned

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05], dtype=F64)
RADIUS = 0.0125
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


# every test of this file holds for the plain and for the fused version
pytestmark = pytest.mark.usefixtures("version")


def box(half):
    corners = torch.cartesian_prod(*[torch.tensor([-x, x], dtype=F64) for x in half])
    faces = [(q[0], q[k], q[k + 1]) for q in QUADS for k in (1, 2)]
    return Triangles(corners[torch.tensor(faces)])


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


def test_a_box_as_mesh_is_the_rectangle():
    poses, start, end = scene(150)
    mesh = box((0.1, 0.05, 0.2))
    pad = torch.zeros(150, 1, dtype=F64)
    flat = sweep_rectangle(poses, HALF, start, end, RADIUS)
    solid = sweep_mesh(se3.from_planar(poses), mesh, torch.cat((start, pad), -1), torch.cat((end, pad), -1), RADIUS)
    differ = flat.hit != solid.hit
    # those that pass by within the tolerance touch
    near = marched(poses, start, end)[2]
    assert bool((near[differ].abs() < 2e-4).all())
    outside = flat.hit & solid.hit & (flat.distance > 0)
    assert int(outside.sum()) > 40
    # a ball that touches a side aslant is within the tolerance that much sooner
    slope = -(flat.normal * torch.nn.functional.normalize(end - start, dim=-1)).sum(-1)
    early = flat.distance - solid.distance
    steep = outside & (slope > 0.2)
    assert bool((early[steep] <= 1e-3).all()) and bool((early[outside] >= -1e-9).all())
    assert torch.allclose(solid.normal[steep][:, :2], flat.normal[steep], atol=0.1)
    assert torch.allclose(solid.distance[~solid.hit], (end - start).norm(dim=-1)[~solid.hit])


def test_a_rigid_change_of_world_moves_what_is_found():
    mesh = box((0.03, 0.05, 0.08))
    generator = torch.Generator().manual_seed(1)
    pose = se3.exp(0.2 * torch.randn(20, 6, generator=generator, dtype=F64))
    start, end = torch.randn(2, 20, 3, generator=generator, dtype=F64) * 0.3
    world = se3.exp(torch.tensor([1.0, -2.0, 0.5, 0.4, 2.0, -1.0], dtype=F64))
    before = sweep_mesh(pose, mesh, start, end, 0.01)
    moved = [se3.apply(world, part[:, None])[:, 0] for part in (start, end, before.point)]
    after = sweep_mesh(world @ pose, mesh, moved[0], moved[1], 0.01)
    assert torch.equal(before.hit, after.hit)
    assert torch.allclose(before.distance, after.distance, atol=1e-9)
    assert torch.allclose(after.point, moved[2], atol=1e-8)


def test_a_point_a_start_inside_and_nothing():
    mesh = box((0.1, 0.05, 0.2))
    pose = torch.eye(4, dtype=F64)
    start, end = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]], dtype=F64)
    found = sweep_mesh(pose, mesh, start, end, 0.0)
    assert bool(found.hit) and float(found.distance) == pytest.approx(0.4, abs=2e-4)
    assert torch.allclose(found.normal, torch.tensor([1.0, 0.0, 0.0], dtype=F64))
    inside = sweep_mesh(pose, mesh, torch.zeros(3, dtype=F64), end, 0.01)
    assert bool(inside.hit) and float(inside.distance) == 0.0
    assert sweep_mesh(pose.expand(0, 4, 4), mesh, start, end, 0.01).hit.shape == (0,)
    with pytest.raises(ValueError, match="radius of 0 or more"):
        sweep_mesh(pose, mesh, start, end, -1.0)


def ledge():
    """A plate with a step at x = 0.25 that a ball meets that comes along over it."""
    blocks = (((-0.1, -0.05, -0.02), (0.3, 0.05, 0.0)), ((0.25, -0.05, 0.0), (0.3, 0.05, 0.05)))
    corners = [
        torch.cartesian_prod(*[torch.tensor(pair, dtype=F64) for pair in zip(low, high, strict=True)])
        for low, high in blocks
    ]
    faces = torch.tensor([(q[0], q[k], q[k + 1]) for q in QUADS for k in (1, 2)])
    return Triangles(torch.cat([part[faces] for part in corners]))


def test_a_ball_that_slides_along_a_face_for_long_gets_there():
    heights = RADIUS + torch.tensor([3e-4, 5e-4, 1e-3, 2e-3, 5e-3], dtype=F64)
    start = torch.stack((torch.zeros(5, dtype=F64), torch.zeros(5, dtype=F64), heights), -1)
    end = start + torch.tensor([0.28, 0.0, 0.0], dtype=F64)
    found = sweep_mesh(torch.eye(4, dtype=F64), ledge(), start, end, RADIUS)
    assert bool(found.hit.all())
    assert torch.allclose(found.distance, torch.tensor(0.25 - RADIUS, dtype=F64), atol=2e-4)
    assert torch.allclose(found.normal, torch.tensor([-1.0, 0.0, 0.0], dtype=F64), atol=0.05)
    # without the step in its way it gets to the end, free
    short = sweep_mesh(torch.eye(4, dtype=F64), ledge(), start, start + 0.8 * (end - start), RADIUS)
    assert not bool(short.hit.any()) and torch.allclose(short.distance, torch.tensor(0.224, dtype=F64))


def test_a_way_that_does_not_end_is_refused():
    pose, mesh = torch.eye(4, dtype=F64), box((0.1, 0.05, 0.2))
    start = torch.tensor([0.5, 0.0, 0.0], dtype=F64)
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="finite poses and ways"):
            sweep_mesh(pose, mesh, start, torch.tensor([bad, 0.0, 0.0], dtype=F64), RADIUS)
    # a nanometre is nothing to a float32 that has gone half a metre
    generator = torch.Generator().manual_seed(0)
    starts = 0.5 + torch.rand(50, 3, generator=generator)
    with pytest.raises(ValueError, match="greater tolerance"):
        sweep_mesh(torch.eye(4), Triangles(mesh.corners.float()), starts, torch.zeros(50, 3), 0.0, tolerance=1e-9)
