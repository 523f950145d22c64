import math

import pytest
import torch

import sdf.posed
from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Mug
from sdf.threads import using

# every test of this file holds for the plain and for the compiled version, but where a graph is kept
pytestmark = pytest.mark.usefixtures("version")


only_plain = pytest.mark.parametrize("version", ["torch"], indirect=True)


@pytest.fixture(scope="module")
def grid() -> GridSDF:
    return GridSDF.from_sdf(Mug(), spacing=0.004).double()


@pytest.fixture(params=["mug", "grid"])
def shape(request, grid):
    return Mug() if request.param == "mug" else grid


def scene(generator, batch=(), poses=5, points=7, upright=False) -> tuple[torch.Tensor, torch.Tensor]:
    tangent = 0.1 * torch.randn(*batch, poses, 6, dtype=torch.float64, generator=generator)
    cloud = 0.15 * torch.randn(*batch, points, 3, dtype=torch.float64, generator=generator)
    if upright:
        cloud[..., 2] = 0.045
        return se3.from_planar(tangent[..., :3], 0.013), cloud
    return se3.exp(tangent), cloud


def one_by_one(shape, poses, points):
    """The definition: each pose alone, by autograd."""
    distance, gradient = [], []
    for pose in poses:
        local = se3.apply(se3.inverse(pose), points).requires_grad_()
        value = shape.distance(local)
        distance.append(value.detach())
        gradient.append(torch.autograd.grad(value.sum(), local)[0])
    return torch.stack(distance), torch.stack(gradient)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("block", [1, 10, 1 << 17])
def test_equals_one_pose_at_a_time(shape, upright, block, generator, monkeypatch):
    monkeypatch.setattr(sdf.posed, "_BLOCK", block)
    poses, points = scene(generator, upright=upright)
    distance, gradient = one_by_one(shape, poses, points)
    query = posed_query(shape, poses, points)
    assert torch.allclose(posed_distance(shape, poses, points), distance, atol=1e-13)
    assert torch.allclose(query.distance, distance, atol=1e-13)
    assert torch.allclose(query.gradient, gradient, atol=1e-11)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("block", [4, 1 << 17])
def test_each_scene_of_a_batch_stands_alone(shape, upright, block, generator, monkeypatch):
    monkeypatch.setattr(sdf.posed, "_BLOCK", block)
    poses, points = scene(generator, (2, 3), upright=upright)
    distance = posed_distance(shape, poses, points)
    query = posed_query(shape, poses, points)
    assert distance.shape == query.distance.shape == (2, 3, 5, 7)
    for i in range(2):
        for j in range(3):
            assert torch.allclose(distance[i, j], posed_distance(shape, poses[i, j], points[i, j]), atol=1e-14)
            alone = posed_query(shape, poses[i, j], points[i, j])
            assert torch.allclose(query.gradient[i, j], alone.gradient, atol=1e-11)
    shared = posed_distance(shape, poses, points[0, 0])
    assert torch.allclose(shared[1, 2], posed_distance(shape, poses[1, 2], points[0, 0]), atol=1e-14)


@only_plain
def test_one_layer_is_looked_up_only_where_all_pairs_share_it(grid, generator, monkeypatch):
    poses, points = scene(generator, upright=True)
    calls = []
    real = GridSDF.distance_at_height
    monkeypatch.setattr(GridSDF, "distance_at_height", lambda *args: calls.append(1) or real(*args))
    posed_distance(grid, poses, points)
    assert len(calls) == 1
    lifted, tilted, apart = poses.clone(), poses.clone(), points.clone()
    lifted[0, 2, 3] += 1e-3
    tilted[0] = tilted[0] @ se3.exp(torch.tensor((0, 0, 0, 1e-4, 0, 0), dtype=torch.float64))
    apart[0, 2] += 1e-3
    for pair in ((lifted, points), (tilted, points), (poses, apart), (poses.requires_grad_(), points)):
        posed_distance(grid, *pair)
    assert len(calls) == 1


@only_plain
@pytest.mark.parametrize("upright", [False, True])
def test_autograd_to_poses_and_points(shape, upright, generator):
    poses, points = scene(generator, poses=2, points=3, upright=upright)
    points[..., :2] += 0.02  # away from symmetric places, which are kinks
    tangent = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)

    def distance(x, p):
        return posed_distance(shape, se3.perturb(poses, x), p)

    def query(x, p):
        return tuple(posed_query(shape, se3.perturb(poses, x), p))

    inputs = (tangent, points.clone().requires_grad_())
    assert torch.autograd.gradcheck(distance, inputs, eps=1e-7, atol=1e-5)
    assert torch.autograd.gradcheck(query, inputs, eps=1e-7, atol=1e-4)


def test_moving_world_and_all_changes_nothing(shape, generator):
    poses, points = scene(generator)
    motion = se3.exp(torch.randn(6, dtype=torch.float64, generator=generator))
    moved = posed_distance(shape, motion @ poses, se3.apply(motion, points))
    assert torch.allclose(moved, posed_distance(shape, poses, points), atol=1e-12)


@pytest.mark.parametrize(("poses", "points"), [(0, 7), (5, 0), (0, 0)])
@pytest.mark.parametrize("batch", [(), (2,), (0,)])
def test_nothing_to_look_up(shape, poses, points, batch, generator):
    transforms, cloud = scene(generator, batch, poses, points)
    assert posed_distance(shape, transforms, cloud).shape == (*batch, poses, points)
    query = posed_query(shape, transforms, cloud)
    assert query.distance.shape == (*batch, poses, points)
    assert query.gradient.shape == (*batch, poses, points, 3)


def test_padding_that_is_not_finite_is_far(grid, generator):
    poses, points = scene(generator, upright=True)
    points[2] = math.nan
    distance = posed_distance(grid, poses, points)
    assert torch.isfinite(distance).all()
    assert (distance[:, 2] > 1e5).all()
    good = [0, 1, 3, 4, 5, 6]
    assert torch.allclose(distance[:, good], posed_distance(grid, poses, points[good]), atol=1e-14)


def test_float32(grid, generator):
    poses, points = scene(generator)
    single = GridSDF.from_sdf(Mug(), spacing=0.004)
    found = posed_distance(single, poses.float(), points.float())
    assert found.dtype == torch.float32
    assert (found.double() - posed_distance(grid, poses, points)).abs().max() < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("outer", [0.0, 0.25])
@pytest.mark.parametrize(("batch", "shared"), [((), False), ((2, 1), False), ((2, 3), True)])
@only_plain
def test_versions_agree(dtype, upright, outer, batch, shared, generator):
    table = GridSDF.from_sdf(Mug().to(dtype), spacing=0.004, outer=outer)
    # more points than one task takes; some beyond the table, one of them not finite
    poses, points = scene(generator, batch, 3, 5000, upright)
    points[..., ::3, :2] *= 6.0
    points[..., 7, 0] = math.nan
    points = points[0, 0] if shared else points
    # planes apart in memory, as slices and transposes leave them
    points, poses = points.to(dtype).mT.contiguous().mT, poses.to(dtype).mT.contiguous().mT
    plain, plain_query = posed_distance(table, poses, points), posed_query(table, poses, points)
    with backend.force("numba"):
        found, found_query = posed_distance(table, poses, points), posed_query(table, poses, points)
    assert found.shape == (*batch, 3, 5000)
    assert found.dtype == found_query.gradient.dtype == dtype
    close = {"atol": 2e-6, "rtol": 1e-6} if dtype == torch.float32 else {"atol": 1e-14, "rtol": 1e-13}
    torch.testing.assert_close(found, plain, **close)
    torch.testing.assert_close(found_query.distance, plain, **close)
    apart = (found_query.gradient - plain_query.gradient).abs().amax(-1)
    if dtype == torch.float64:
        assert float(apart.max()) < 1e-11
    else:  # a point rounded to the other side of a node takes the slope of the cell there
        assert float((apart > 1e-3).double().mean()) < 1e-3


@pytest.mark.parametrize("threads", [2, 3])
def test_the_same_for_any_number_of_threads(grid, threads, generator, monkeypatch):
    monkeypatch.setattr("sdf.threads.team", lambda threads, work_s: threads)  # however little work it is
    poses, points = scene(generator, (8,), 3, 5000)
    with using(1):
        expected = posed_query(grid, poses, points)
    with using(threads):
        found = posed_query(grid, poses, points)
    assert torch.equal(found.distance, expected.distance)
    assert torch.equal(found.gradient, expected.gradient)


def test_another_shape_or_a_graph_is_left_to_the_plain_version(grid, generator):
    poses, points = scene(generator)
    with backend.force("numba"):
        assert torch.allclose(posed_distance(Mug(), poses, points), posed_distance(grid, poses, points), atol=1e-2)
        with pytest.raises(ValueError, match="with graph"):
            posed_distance(grid, poses.clone().requires_grad_(), points)


def test_shape_errors(no_shape_check, grid):
    with pytest.raises(ValueError, match=r"Expected world_T_object to have shape \(\*b, N, 4, 4\), got \(4, 4\)"):
        posed_distance(grid, torch.eye(4), torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"Expected points_w to have shape \(\*b, M, 3\), got \(3,\)"):
        posed_query(grid, torch.eye(4)[None], torch.zeros(3))


@pytest.mark.parametrize("upright", [False, True])
def test_rounding_counts_from_the_first_pose_not_from_the_origin(grid, upright, generator):
    table = GridSDF.from_sdf(Mug(), spacing=0.004)
    poses, points = scene(generator, upright=upright)
    away = torch.tensor([700.0, -900.0, 0.0], dtype=torch.float64)
    poses[..., :3, 3] += away
    poses, points = poses.float(), (points + away).float()
    found = posed_distance(table, poses, points)
    with backend.force("torch"):
        wanted = posed_distance(table.double(), poses.double(), points.double())
    # what float32 holds of so far a world is 0.06 mm; of that nothing more is lost
    assert float((found.double() - wanted).abs().max()) < 1e-6


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e5])
def test_a_first_pose_that_is_nowhere_leaves_the_others_right(shape, bad, generator):
    poses, points = scene(generator)
    wanted = posed_distance(shape, poses[1:], points)
    poses[0, :3, 3] = bad
    torch.testing.assert_close(posed_distance(shape, poses, points)[1:], wanted)


@only_plain
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_padding_that_is_not_finite_has_no_slope(shape, bad, generator):
    poses, points = scene(generator)
    points[2, 1] = bad
    good = [0, 1, 3, 4, 5, 6]
    slopes = []
    for cloud in (points, points[good]):
        moved, seen = poses.clone().requires_grad_(), cloud.clone().requires_grad_()
        distance = posed_distance(shape, moved, seen)
        slopes.append(torch.autograd.grad(distance.sum(), (moved, seen)))
    assert (posed_distance(shape, poses.clone().requires_grad_(), points)[:, 2] > 1e5).all()
    torch.testing.assert_close(slopes[0][0], slopes[1][0], atol=1e-12, rtol=0)
    torch.testing.assert_close(slopes[0][1][good], slopes[1][1], atol=1e-12, rtol=0)
    assert not slopes[0][1][2].any()


def test_inference_mode(shape, generator):
    poses, points = scene(generator)
    expected = posed_query(shape, poses, points)
    with torch.inference_mode():
        found = posed_query(shape, poses, points)
    torch.testing.assert_close(found.distance, expected.distance, atol=0, rtol=0)
    torch.testing.assert_close(found.gradient, expected.gradient, atol=0, rtol=0)


@pytest.mark.parametrize("look_up", [posed_distance, posed_query])
def test_points_of_another_float_type_are_refused(shape, look_up):
    message = r"Expected points of torch.float32 as the poses are, got torch.float64: use .to\(dtype=torch.float32\)"
    with pytest.raises(ValueError, match=message):
        look_up(shape, torch.eye(4)[None], torch.zeros(3, 3, dtype=torch.float64))


def test_no_points_may_be_of_any_float_type(shape):
    assert posed_distance(shape, torch.eye(4)[None], torch.zeros(0, 3, dtype=torch.float64)).shape == (1, 0)
