"""Depth images of scenes in closed form, and what they say of space."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sdf import se3
from sdf.primitives import Box, Sphere
from sensors.semantics import Semantics
from sensors.vision.camera import depth_observation, depth_shown, lattice_points, look_at, pinhole, pixel_rays

HEIGHT, WIDTH = 60, 80
EYE, TARGET = (-0.25, 0.05, 0.30), (0.40, 0.0, 0.04)


def camera(dtype=torch.float64, eye=EYE, target=TARGET):
    return (
        pinhole(HEIGHT, WIDTH, math.radians(45), dtype=dtype),
        look_at(torch.tensor(eye, dtype=dtype), torch.tensor(target, dtype=dtype)),
    )


def trace(shape, world_T_object, intrinsics, world_T_camera, floor=True):
    """Depth and mask by sphere tracing the exact distance; the floor in closed form."""
    rays = pixel_rays(HEIGHT, WIDTH, intrinsics).reshape(-1, 3)
    length = rays.norm(dim=-1, keepdim=True)
    direction = (rays / length) @ world_T_camera[:3, :3].T
    origin = world_T_camera[:3, 3]
    object_T_world = se3.inverse(world_T_object)
    travelled = torch.zeros(len(rays), dtype=rays.dtype)
    for _ in range(400):
        places = se3.apply(object_T_world, origin + travelled[:, None] * direction)
        travelled = travelled + shape.distance(places).clamp_max(1.0)
    hit = shape.distance(se3.apply(object_T_world, origin + travelled[:, None] * direction)).abs() < 1e-6
    along = torch.where(hit, travelled, torch.full_like(travelled, torch.inf))
    if floor:
        ground = torch.where(direction[:, 2] < 0, -origin[2] / direction[:, 2], torch.full_like(along, torch.inf))
        hit &= along < ground
        along = torch.minimum(along, ground)
    return (along / length[:, 0]).reshape(HEIGHT, WIDTH), hit.reshape(HEIGHT, WIDTH)


SCENES = {
    "sphere": (Sphere(0.05), torch.tensor([0.40, 0.0, 0.0])),
    "box": (Box((0.03, 0.05, 0.06)), torch.tensor([0.38, 0.02, 0.6])),
    "near box": (Box((0.04, 0.02, 0.05)), torch.tensor([0.15, 0.05, -0.3])),
}
BOUNDS = torch.tensor([[0.0, -0.25, 0.0], [0.6, 0.25, 0.2]], dtype=torch.float64)


def scene(name):
    shape, planar = SCENES[name]
    return shape.double(), se3.from_planar(planar.double(), 0.05)


def test_free_points_against_a_loop():
    """Free is what lies before the least depth of the four pixels about a point's image, less the margin."""
    shape, pose = scene("box")
    intrinsics, world_T_camera = camera()
    depth, mask = trace(shape, pose, intrinsics, world_T_camera)
    bounds = torch.tensor([[0.3, -0.05, 0.0], [0.5, 0.08, 0.12]], dtype=torch.float64)
    found = depth_observation(depth, intrinsics, world_T_camera, mask, bounds=bounds, free_spacing=0.02)
    free = {tuple(p) for p in found.points[found.of_class(Semantics.FREE)].mul(1000).round().long().tolist()}
    expected = set()
    for point in lattice_points(bounds, 0.02):
        x, y, z = se3.apply(se3.inverse(world_T_camera), point[None])[0].tolist()
        u = x / z * float(intrinsics[0, 0]) + float(intrinsics[0, 2])
        v = y / z * float(intrinsics[1, 1]) + float(intrinsics[1, 2])
        if not (0 <= u < WIDTH - 1 and 0 <= v < HEIGHT - 1):
            continue
        corner = depth[math.floor(v) : math.floor(v) + 2, math.floor(u) : math.floor(u) + 2]
        if z < float(corner.min()) - 0.010:
            expected.add(tuple(point.mul(1000).round().long().tolist()))
    assert free == expected and len(free) > 20


def test_margin_and_fraction_bound_the_depth_of_a_wall():
    """Facing a wall at 0.5 m: free up to 10 mm before it, or to 95 % of its depth."""
    intrinsics = pinhole(HEIGHT, WIDTH, math.radians(60), dtype=torch.float64)
    pose = look_at(torch.tensor([0.0, 0.0, 0.5]).double(), torch.tensor([1.0, 0.0, 0.5]).double())
    depth = torch.full((HEIGHT, WIDTH), 0.5, dtype=torch.float64)
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    bounds = torch.tensor([[0.0, -0.02, 0.48], [0.6, 0.02, 0.52]], dtype=torch.float64)
    for settings, end in (({"free_margin_m": 0.010}, 0.49), ({"free_fraction": 0.95}, 0.475)):
        seen = depth_observation(depth, intrinsics, pose, mask, bounds=bounds, free_spacing=0.002, **settings)
        assert not bool(seen.of_class(Semantics.SURFACE).any())
        assert end - 0.003 < float(seen.points[:, 0].max()) < end


def test_misses_are_free_and_unknown_pixels_are_not():
    intrinsics, world_T_camera = camera()
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    counts = {}
    for name, value in (("miss", torch.inf), ("zero", 0.0), ("negative", -1.0), ("nan", torch.nan)):
        depth = torch.full((HEIGHT, WIDTH), value, dtype=torch.float64)
        seen = depth_observation(depth, intrinsics, world_T_camera, mask, bounds=BOUNDS, free_spacing=0.02)
        assert not bool(seen.of_class(Semantics.SURFACE).any())
        counts[name] = len(seen)
    assert counts["miss"] > 1000
    assert counts["zero"] == counts["negative"] == counts["nan"] == 0
    # one unknown pixel takes away what lies about it and nothing else
    depth = torch.full((HEIGHT, WIDTH), torch.inf, dtype=torch.float64)
    depth[30, 40] = torch.nan
    holed = depth_observation(depth, intrinsics, world_T_camera, mask, bounds=BOUNDS, free_spacing=0.02)
    assert 0 < counts["miss"] - len(holed) < 60


def test_nothing_behind_the_camera_is_free():
    intrinsics, _ = camera()
    behind = look_at(torch.tensor([0.3, 0.0, 0.1]).double(), torch.tensor([0.0, 0.0, 0.1]).double())
    depth = torch.full((HEIGHT, WIDTH), torch.inf, dtype=torch.float64)
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    seen = depth_observation(depth, intrinsics, behind, mask, bounds=BOUNDS, free_spacing=0.02)
    assert len(seen) > 50 and float(seen.points[:, 0].max()) < 0.3


def test_what_hides_the_object_bounds_free_space():
    """A mask that is False leaves the pixel's depth in force: a robot before the object is not free."""
    shape, pose = scene("near box")
    intrinsics, world_T_camera = camera()
    depth, _ = trace(shape, pose, intrinsics, world_T_camera)
    hidden = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    seen = depth_observation(depth, intrinsics, world_T_camera, hidden, bounds=BOUNDS, free_spacing=0.01)
    assert not bool(seen.of_class(Semantics.SURFACE).any()) and len(seen) > 500
    assert float(shape.distance(se3.apply(se3.inverse(pose), seen.points)).min()) > 0


def test_no_bounds_no_free_points():
    shape, pose = scene("sphere")
    intrinsics, world_T_camera = camera()
    depth, mask = trace(shape, pose, intrinsics, world_T_camera)
    seen = depth_observation(depth, intrinsics, world_T_camera, mask)
    assert bool((seen.semantics == Semantics.SURFACE).all())


@given(
    u=st.floats(0.6, WIDTH - 1.6),
    v=st.floats(0.6, HEIGHT - 1.6),
    z=st.floats(0.1, 2.0),
    skew=st.floats(-5, 5),
)
def test_projection_is_the_inverse_of_the_rays(u, v, z, skew):
    """The depth shown at a back-projected pixel is that pixel's own, for any intrinsics."""
    intrinsics = torch.tensor([[90.0, skew, 37.0], [0.0, 80.0, 31.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    row, column = round(v), round(u)
    point = pixel_rays(HEIGHT, WIDTH, intrinsics)[row, column] * z
    image = intrinsics @ point / point[2]
    torch.testing.assert_close(image, image.new_tensor([column, row, 1.0]), atol=1e-9, rtol=0)
    depth = torch.full((HEIGHT, WIDTH), 5.0, dtype=torch.float64)
    depth[row, column] = 3.0
    nudged = point + point.new_tensor([0.01 * z / 90, 0.01 * z / 80, 0.0])
    assert float(depth_shown(depth, intrinsics, nudged[None])[0]) == 3.0


def test_lattice_is_the_worlds():
    points = lattice_points(torch.tensor([[0.012, -0.013, 0.0], [0.034, 0.011, 0.009]], dtype=torch.float64), 0.01)
    cells = (points / 0.01 - 0.5).round()
    torch.testing.assert_close(points, (cells + 0.5) * 0.01)
    assert {tuple(c) for c in cells.long().tolist()} == {(i, j, 0) for i in (1, 2) for j in (-1, 0)}
    assert len(lattice_points(torch.zeros(2, 3), 0.01)) == 0


def test_follows_the_dtype(dtype):
    shape, pose = scene("sphere")
    depth, mask = trace(shape, pose, *camera())
    intrinsics, world_T_camera = camera()
    single = depth_observation(depth.float(), intrinsics, world_T_camera, mask, bounds=BOUNDS, free_spacing=0.02)
    double = depth_observation(depth.to(dtype), intrinsics, world_T_camera, mask, bounds=BOUNDS, free_spacing=0.02)
    assert single.points.dtype == torch.float32 and double.points.dtype == dtype
    count = int(mask.sum())
    torch.testing.assert_close(single.points[:count].to(dtype), double.points[:count], atol=1e-6, rtol=0)


def test_look_at_is_a_rigid_level_camera():
    pose = look_at(torch.tensor(EYE).double(), torch.tensor(TARGET).double())
    torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1.0)
    assert float(pose[2, 0]) == pytest.approx(0.0)  # the image's rows are level
    assert float(pose[2, 1]) < 0  # its columns run down
    with pytest.raises(ValueError, match="above or below"):
        look_at(torch.zeros(3), torch.tensor([0.0, 0.0, -1.0]))


def test_bad_arguments(no_shape_check):
    intrinsics, world_T_camera = camera()
    depth, mask = torch.ones(HEIGHT, WIDTH).double(), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"object_mask.*\(60, 80\), got \(80, 60\)"):
        depth_observation(depth, intrinsics, world_T_camera, mask.T)
    with pytest.raises(ValueError, match="intrinsics"):
        depth_observation(depth, intrinsics[:2], world_T_camera, mask)
    with pytest.raises(ValueError, match=r"world_T_camera.*finite"):
        depth_observation(depth, intrinsics, world_T_camera * torch.nan, mask)
    with pytest.raises(ValueError, match="free_spacing"):
        depth_observation(depth, intrinsics, world_T_camera, mask, bounds=BOUNDS, free_spacing=0.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (4, 1)])
def test_an_image_without_four_pixels_says_nothing_of_free_space(shape):
    bounds = torch.tensor([[-0.05, -0.05, 0.1], [0.05, 0.05, 0.2]])
    depth = torch.full(shape, 0.5)
    seen = depth_observation(depth, pinhole(*shape, 1.0), torch.eye(4), depth > 0, bounds=bounds)
    assert len(seen) == depth.numel()
