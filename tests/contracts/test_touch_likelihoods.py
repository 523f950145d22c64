"""What holds for every likelihood of touched points, whatever the shape: of a mesh, a box, a rectangle, a circle."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sdf import se3
from sdf.mesh.triangles import Triangles
from sdf.sweep import turned
from sensors.touch.circle_touch import CircleTouches
from sensors.touch.rectangle_touch import RectangleTouches
from sensors.touch.touch_likelihood import TouchNoise, box_log_likelihoods, touch_log_likelihoods
from tests.fixtures import meshes

F64 = torch.float64
HALF = torch.tensor([0.1, 0.05, 0.07], dtype=F64)
NOISE = TouchNoise(0.005, 0.1, 0.01)

# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def mesh(poses: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    return touch_log_likelihoods(poses, points, normals, Triangles(meshes.box(HALF.tolist()).corners), NOISE).sum(-1)


def box(poses: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    inverse = se3.inverse(poses)
    return box_log_likelihoods(se3.apply(inverse, points), se3.rotate(inverse, normals), HALF, NOISE).sum(-1)


def rectangle_touches(poses: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    touches = RectangleTouches.none(HALF[:2], NOISE, 0.01)
    for point, normal in zip(points, normals, strict=True):
        # with the free way to the touch, and another touch from above
        free = touches.with_touch(point, normal).with_way(point + 0.1 * normal, point + 0.06 * normal)
        touches = free.with_top(point - 0.01 * normal)
    return touches.log_likelihood(poses)


def circle_touches(poses: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    touches = CircleTouches.none(HALF[:2], 0.01, 0.005)
    for point, normal in zip(points, normals, strict=True):
        touches = touches.with_touch(point, normal)
    return touches.log_likelihood(poses[..., :2])


@dataclass(frozen=True)
class Member:
    """A likelihood (N) of all touches together at poses (N, 4, 4) or (N, 3), and whether it takes what is no number."""

    log_likelihood: Callable[[Tensor, Tensor, Tensor], Tensor]
    dims: int
    refuses: bool = True


MEMBERS = {
    "mesh": Member(mesh, 3),
    "box": Member(box, 3, refuses=False),  # works in the object's frame
    "rectangle touches": Member(rectangle_touches, 2),
    "circle touches": Member(circle_touches, 2),
}


@pytest.fixture(params=MEMBERS)
def member(request: pytest.FixtureRequest) -> Member:
    return MEMBERS[request.param]


def on_sides(dims: int, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points on the sides of the object and the normals there, in its own frame."""
    axis, half = torch.arange(count) % dims, HALF[:dims]
    side = torch.where(torch.arange(count) % 4 < 2, 1.0, -1.0).double()
    normals = torch.nn.functional.one_hot(axis, dims).double() * side[:, None]
    points = half * (1.6 * torch.rand(count, dims, generator=generator, dtype=F64) - 0.8)
    return torch.where(normals != 0, normals * half, points), normals


def posed(pose: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Points and normals of an object's frame in the world."""
    if pose.shape[-1] == 4:
        return se3.apply(pose, points), se3.rotate(pose, normals)
    turn = turned(pose[2])
    return points @ turn.mT + pose[:2], normals @ turn.mT


def moved(world: Tensor, poses: Tensor) -> Tensor:
    """Poses after a rigid change of the world."""
    if world.shape[-1] == 4:
        return world @ poses
    return torch.cat((posed(world, poses[:, :2], poses[:, :2])[0], poses[:, 2:] + world[2]), -1)


def poses_of(dims: int, count: int, generator: torch.Generator) -> Tensor:
    if dims == 3:
        return se3.exp(0.2 * torch.randn(count, 6, generator=generator, dtype=F64))
    return 0.2 * torch.randn(count, 3, generator=generator, dtype=F64)


def test_no_pose_explains_touches_better_than_the_true_one(member: Member, generator: torch.Generator) -> None:
    poses = poses_of(member.dims, 30, generator)
    found = member.log_likelihood(poses, *posed(poses[0], *on_sides(member.dims, 9, generator)))
    assert found.shape == (30,)
    assert float(found[0]) >= float(found.max()) - 1e-9 and float(found[0] - found.min()) > 1.0


def test_a_rigid_change_of_world_changes_nothing(member: Member, generator: torch.Generator) -> None:
    poses, world = poses_of(member.dims, 8, generator), poses_of(member.dims, 1, generator)[0]
    touches = posed(poses[0], *on_sides(member.dims, 6, generator))
    before = member.log_likelihood(poses, *touches)
    torch.testing.assert_close(
        member.log_likelihood(moved(world, poses), *posed(world, *touches)), before, atol=1e-7, rtol=1e-7
    )


def test_touches_add_up_and_none_says_nothing(member: Member, generator: torch.Generator) -> None:
    poses = poses_of(member.dims, 8, generator)
    points, normals = posed(poses[0], *on_sides(member.dims, 6, generator))
    parts = [member.log_likelihood(poses, points[rows], normals[rows]) for rows in (slice(0, 2), slice(2, 6))]
    torch.testing.assert_close(sum(parts), member.log_likelihood(poses, points, normals), atol=1e-9, rtol=1e-9)
    assert member.log_likelihood(poses, points[:0], normals[:0]).tolist() == [0.0] * 8
    assert member.log_likelihood(poses[:0], points, normals).shape == (0,)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_touches_that_are_no_numbers_are_refused(member: Member, bad: float, generator: torch.Generator) -> None:
    if not member.refuses:
        pytest.skip("its caller checks")
    poses, (points, normals) = poses_of(member.dims, 2, generator), on_sides(member.dims, 4, generator)
    broken = points.clone()
    broken[1, 0] = bad
    with pytest.raises(ValueError, match=r"Expected points?_w to be finite"):
        member.log_likelihood(poses, broken, normals)
    with pytest.raises(ValueError, match=r"Expected normals?_w to be finite"):
        member.log_likelihood(poses, points, broken)
