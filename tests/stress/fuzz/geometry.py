"""Transforms, distances and lattices under tensors of any value."""

from collections.abc import Iterable

import torch
from torch import Tensor

from rumi.fields.workspace import Workspace
from sdf import se3, so3
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Sphere, TorusArc
from sdf.voxel_grid import VoxelGrid, lattice_keys
from tests.stress.fuzz.draw import Draw, choice, number, poses, sizes, tensor
from tests.stress.fuzz.entered import finite, out, table, target


@target
def _transforms(draw: Draw) -> Iterable[Tensor]:
    wild = draw.integer(0, 1) == 1
    twist = tensor(draw, sizes(draw), 6, wild=wild)
    pose = se3.exp(twist)
    log = se3.log(pose)
    distance = se3.distance(pose, se3.identity(dtype=pose.dtype))
    others = (se3.inverse(pose), se3.compose(pose, pose), se3.from_planar(twist[:, :3]), se3.to_planar(pose))
    if finite(twist):
        se3.reproject(pose)
    return out((twist,), pose, log, *distance, *others, so3.angle(pose[..., :3, :3]))


@target
def _mean_of_poses(draw: Draw) -> Iterable[Tensor]:
    count = draw.integer(1, 5)
    group, weights = poses(draw, count), tensor(draw, count, wild=draw.integer(0, 1) == 1).abs()
    if not finite(weights) or float(weights.sum()) < 1e-20:
        weights = weights * 0.0
    return out((group, weights), se3.mean(group, weights))


@target
def _gradients(draw: Draw) -> Iterable[Tensor]:
    twist = tensor(draw, 4, 6).requires_grad_()
    with torch.enable_grad():
        pose = se3.exp(twist)
        total = se3.log(pose).square().sum() + so3.angle(pose[..., :3, :3]).sum()
        (gradient,) = torch.autograd.grad(total, twist)
    return out((twist.detach(),), gradient)


@target
def _primitives(draw: Draw) -> Iterable[Tensor]:
    def size() -> float:
        return number(draw, wild=draw.integer(0, 3) == 0)

    shape = choice(
        draw,
        (
            lambda: Sphere(size()),
            lambda: Box((size(), size(), size())),
            lambda: Cylinder(size(), size()),
            lambda: Capsule((size(), size(), size()), (0.0, 0.0, 0.1), size()),
            lambda: TorusArc((0.0, 0.0, 0.0), size(), size(), size()),
            lambda: Cup(size(), size(), size(), size()),
            lambda: Mug(abs(size()) + 0.03, abs(size()) + 0.09),
        ),
    )()
    points = tensor(draw, sizes(draw), 3, wild=True)
    query = shape(points)
    if not bool(torch.isfinite(shape.bounds).all()):
        raise AssertionError("a shape of infinite size was taken")
    return query.distance, query.gradient


@target
def _tables(draw: Draw) -> Iterable[Tensor]:
    points = tensor(draw, sizes(draw), 3, wild=True)
    query = table(points)(points)
    return query.distance, query.gradient


@target
def _look_ups(draw: Draw) -> Iterable[Tensor]:
    values = tensor(draw, *(draw.integer(1, 4) for _ in range(3)))
    points = tensor(draw, sizes(draw), 3, wild=True).to(values)
    grid = VoxelGrid(values, tensor(draw, 3).to(values), choice(draw, (1e-3, 0.1, 1.0)))
    return (grid.interpolate(points, None),)


@target
def _lattices(draw: Draw) -> Iterable[Tensor]:
    bounds = tensor(draw, 2, 3, wild=draw.integer(0, 2) == 0)
    if draw.integer(0, 2):
        bounds = bounds.sort(0).values
    spacing = choice(draw, (0.05, 0.2, 1.0, number(draw, wild=True)))
    if 1e5 < float(((bounds[1] - bounds[0]).double() / spacing).abs().clamp_min(1.0).prod()) < 2**29:
        return ()  # takes long
    grid = VoxelGrid.from_bounds(bounds, spacing)
    points = tensor(draw, sizes(draw), 3, wild=True).to(bounds)
    index, _ = grid.nearest_index(points)
    if index.numel() and (bool((index < 0).any()) or bool((index >= torch.tensor(grid.shape)).any())):
        raise AssertionError("an index beyond the lattice")
    return grid.interpolate(points), grid.interpolate(points, None)


@target
def _keys(draw: Draw) -> Iterable[Tensor]:
    return (lattice_keys(tensor(draw, sizes(draw), 3, wild=True), choice(draw, (0.001, 0.005, 1.0))).double(),)


@target
def _workspaces(draw: Draw) -> Iterable[Tensor]:
    bounds = tensor(draw, 2, 3, wild=draw.integer(0, 2) == 0)
    if draw.integer(0, 2):
        bounds = bounds.sort(0).values
    made = Workspace.from_bounds(bounds, choice(draw, (0.05, 0.2, 1.0, number(draw, wild=True))))
    return (made.bounds,) if len(made) > 10**6 else (made.bounds, made.points)


@target
def _posed(draw: Draw) -> Iterable[Tensor]:
    at = poses(draw, sizes(draw), wild=draw.integer(0, 2) == 0)
    points = tensor(draw, sizes(draw, 20), 3, wild=True).to(at)
    query = posed_query(table(at), at, points)
    distance = posed_distance(table(at), at, points)
    # a pose that is none moves points to nowhere, which is far: never NaN
    return (distance, query.distance, *out((at,), query.gradient))
