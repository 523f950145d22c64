import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sdf import se3, so3

BATCHES = [(), (1,), (0,), (2, 3)]


def transforms(batch: tuple[int, ...], seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    tangent = torch.randn(*batch, 6, dtype=dtype, generator=generator)
    return se3.exp(tangent)


def close(a: torch.Tensor, b: torch.Tensor, atol: float = 1e-12) -> bool:
    return torch.allclose(a, b.expand_as(a), rtol=0, atol=atol)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("seed", range(3))
def test_group_axioms(batch, seed):
    a, b, c = (transforms(batch, 10 * seed + k) for k in range(3))
    one = se3.identity(batch, dtype=torch.float64)
    assert close(a @ one, a) and close(one @ a, a)
    assert close(a @ se3.inverse(a), one) and close(se3.inverse(a) @ a, one)
    assert close((a @ b) @ c, a @ (b @ c))
    assert close(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a))
    assert close(se3.inverse(se3.inverse(a)), a)


@pytest.mark.parametrize("batch", BATCHES)
def test_compose_is_the_product(batch):
    a, b = transforms(batch, 1), transforms(batch, 2)
    assert close(se3.compose(a, b), a @ b)


def test_compose_brings_a_product_back_to_a_rotation():
    a, b = transforms((50,), 1), transforms((50,), 2)
    off = a.clone()
    off[..., :3, :3] *= 1.0 + 1e-5
    rotation = se3.compose(off, b)[..., :3, :3]
    assert close(rotation.mT @ rotation, torch.eye(3, dtype=torch.float64), 1e-9)
    assert close(rotation, (a @ b)[..., :3, :3], 1e-9)


def test_renormalised_is_a_rotation_to_the_last_digit():
    off = transforms((50,), 1, torch.float32) * (1.0 + 3e-6)
    rotation = se3.renormalised(off)[..., :3, :3].double()
    assert close(rotation.mT @ rotation, torch.eye(3, dtype=torch.float64), 3e-7)
    assert torch.equal(se3.renormalised(off)[..., :3, 3], off[..., :3, 3])


def test_compose_keeps_gradients_and_dtype():
    a, b = transforms((3,), 1), transforms((3,), 2)
    assert torch.autograd.gradcheck(se3.compose, (a.requires_grad_(), b))
    assert se3.compose(a.float(), b.float()).dtype == torch.float32


@pytest.mark.parametrize("batch", BATCHES)
def test_action_on_points(batch, generator):
    a, b = transforms(batch, 1), transforms(batch, 2)
    points = torch.randn(*batch, 7, 3, dtype=torch.float64, generator=generator)
    assert close(se3.apply(a @ b, points), se3.apply(a, se3.apply(b, points)))
    homogeneous = torch.cat((points, torch.ones_like(points[..., :1])), dim=-1)
    assert close(se3.apply(a, points), (homogeneous @ a.mT)[..., :3])
    differences = points[..., 1:, :] - points[..., :-1, :]
    moved = se3.apply(a, points)
    assert close(se3.rotate(a, differences), moved[..., 1:, :] - moved[..., :-1, :])
    # one transform serves a batch of clouds
    assert close(se3.apply(transforms((), 1), points), se3.apply(transforms((), 1).expand(*batch, 4, 4), points))


@given(
    st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    st.sampled_from([0.0, 1e-30, 1e-9, 1e-4, 0.49, 0.51, 1.0, 3.0, 3.14159]),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_log_undoes_exp(v, axis, angle, dtype):
    axis = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    tangent = torch.cat((torch.tensor(v, dtype=torch.float64), angle * axis)).to(dtype).requires_grad_()
    transform = se3.exp(tangent)
    found = se3.log(transform)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    assert close(found, tangent.detach(), tolerance)
    expected = torch.linalg.matrix_exp(matrix(tangent.detach().double()))
    assert close(transform.double(), expected, 1e-13 if dtype == torch.float64 else 3e-6)
    for output in (transform, found):
        (gradient,) = torch.autograd.grad(output.sum(), tangent, retain_graph=True)
        assert torch.isfinite(gradient).all()


def matrix(tangent: torch.Tensor) -> torch.Tensor:
    """The twist as a 4 x 4 matrix."""
    top = torch.cat((so3.hat(tangent[3:]), tangent[:3, None]), dim=-1)
    return torch.cat((top, top.new_zeros(1, 4)))


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.5, 2.0, 3.1, math.pi - 1e-6])
def test_jacobians(angle, generator):
    axes = torch.nn.functional.normalize(torch.randn(2, 3, dtype=torch.float64, generator=generator), dim=-1)
    v = torch.randn(2, 3, dtype=torch.float64, generator=generator)
    tangent = torch.cat((v, angle * axes), dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, tangent)
    for single in tangent.detach():
        jacobian = torch.autograd.functional.jacobian(lambda x: se3.log(se3.exp(x)), single)
        assert (jacobian - torch.eye(6, dtype=torch.float64)).abs().max() < 1e-8
    if angle < 3:
        assert torch.autograd.gradgradcheck(se3.exp, tangent[:1])


def test_published_numbers():
    """Independent values: parallel axes, a quarter turn, a small turn."""
    half = math.pi / 2
    tangents = [(1, 2, 3, 0.1, 0.2, 0.3), (1, 0, 0, 0, 0, half), (0.5, -0.25, 0.125, 1e-6, -2e-6, 3e-6)]
    first, quarter, small = se3.exp(torch.tensor(tangents, dtype=torch.float64))
    row = torch.tensor((0.935754803277919, -0.283164960565074, 0.210191705950743), dtype=torch.float64)
    assert close(first[0, :3], row, 1e-14)
    assert close(first[:3, 3], torch.tensor((1.0, 2.0, 3.0), dtype=torch.float64), 1e-14)
    assert close(quarter[:3, 3], torch.tensor((2 / math.pi, 2 / math.pi, 0), dtype=torch.float64), 1e-15)
    expected = torch.tensor((0.5000002499990625, -0.249999312499875, 0.1250003750003958), dtype=torch.float64)
    assert close(small[:3, 3], expected, 1e-15)


def tensor(value: object) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def test_golden_transform(golden):
    case = golden("rumi.transform")
    world_T_object = tensor(case["inputs"]["W_T_O"])
    inverse = se3.inverse(world_T_object)
    assert close(inverse, tensor(case["expected"]["T"]), case["atol"])
    point = se3.apply(inverse, tensor(case["inputs"]["x_world"])[None])[0]
    assert close(point, tensor(case["expected"]["x_obj"]), case["atol"])


def test_golden_sticking(golden):
    case = golden("rumi.sticking")
    inputs, expected, atol = case["inputs"], case["expected"], case["atol"]
    before, after, object_T_world = (tensor(inputs[name]) for name in ("E0", "E1", "T"))
    motion = after @ se3.inverse(before)
    assert close(motion, tensor(expected["M"]), atol)
    moved = object_T_world @ se3.inverse(motion)
    assert close(moved, tensor(expected["T_new"]), atol)
    # the same in our convention: the pose of the object moves on the left
    assert close(motion @ se3.inverse(object_T_world), se3.inverse(tensor(expected["T_new"])), atol)
    change = moved @ se3.inverse(object_T_world)
    assert close(change, tensor(expected["dT"]), atol)
    world_change = se3.inverse(object_T_world) @ se3.inverse(change) @ object_T_world
    assert close(world_change, tensor(expected["dT_w"]), atol)
    point = se3.apply(motion, tensor(inputs["x_world"])[None])[0]
    assert close(point, tensor(expected["x_new"]), atol)
    assert close(se3.inverse(before) @ after, tensor(expected["ee_body_motion"]), atol)


def test_golden_perturb(golden):
    case = golden("rumi.perturb")
    inputs, expected, atol = case["inputs"], case["expected"], case["atol"]
    noise = se3.make(so3.exp(inputs["theta"] * tensor(inputs["e"])), tensor(inputs["dt"]))
    assert close(noise, tensor(expected["dT_sigma"]), atol)
    assert close(noise @ tensor(inputs["T"]), tensor(expected["T_new"]), atol)
    assert close(se3.perturb(tensor(inputs["T"]), se3.log(noise)), tensor(expected["T_new"]), atol)
    world = se3.inverse(tensor(inputs["T"])) @ se3.inverse(noise)
    assert close(world, tensor(expected["W_new"]), atol)


@pytest.mark.parametrize("batch", BATCHES)
def test_planar(batch, generator):
    xyyaw = torch.rand(*batch, 3, dtype=torch.float64, generator=generator) * 6 - 3
    transform = se3.from_planar(xyyaw, 0.25)
    assert close(se3.to_planar(transform), xyyaw, 1e-14)
    assert (transform[..., 2, :] == tensor((0, 0, 1, 0.25))).all()
    heights = torch.rand(batch, dtype=torch.float64, generator=generator)
    assert close(se3.from_planar(xyyaw, heights)[..., 2, 3], heights, 0)
    zero = torch.zeros_like(xyyaw[..., :1])
    twist = torch.cat((zero, zero, zero, zero, zero, xyyaw[..., 2:]), dim=-1)
    assert close(transform[..., :3, :3], se3.exp(twist)[..., :3, :3])
    turned = se3.rotate(transform, torch.eye(3, dtype=torch.float64))
    assert close(turned[..., 2, :], torch.eye(3, dtype=torch.float64)[2])


def test_mean_of_equal_and_of_opposed(generator):
    pose = transforms(())
    weights = torch.rand(5, dtype=torch.float64, generator=generator)
    assert close(se3.mean(pose.expand(5, 4, 4), weights), pose)
    # two yaws weigh against each other like two vectors
    planar = tensor([[0.0, 0, 0.4], [1.0, 0, -0.2]])
    mean = se3.to_planar(se3.mean(se3.from_planar(planar), tensor([1.0, 3.0])))
    yaw = math.atan2(math.sin(0.4) - 3 * math.sin(0.2), math.cos(0.4) + 3 * math.cos(0.2))
    assert close(mean, tensor([0.75, 0.0, yaw]))
    # opposite headings have no mean: some rotation, never NaN
    opposed = se3.mean(se3.from_planar(tensor([[0.0, 0, 0], [0.0, 0, math.pi]])), tensor([0.5, 0.5]))
    assert close(torch.linalg.det(opposed), tensor(1.0)) and torch.isfinite(opposed).all()


def test_mean_follows_a_change_of_frame_and_each_row_stands_alone(generator):
    poses = transforms((3, 6))
    weights = torch.rand(3, 6, dtype=torch.float64, generator=generator)
    mean = se3.mean(poses, weights)
    frame = transforms((), 9)
    assert close(se3.mean(frame @ poses, weights), frame @ mean)
    for row in range(3):
        assert close(se3.mean(poses[row], weights[row]), mean[row], 1e-14)
    with pytest.raises(ValueError, match="weights to sum to a positive number, got 0"):
        se3.mean(poses, torch.zeros(3, 6, dtype=torch.float64))


def test_distance(generator):
    a = transforms((4,))
    tangent = torch.randn(4, 6, dtype=torch.float64, generator=generator)
    metres, radians = se3.distance(a, a @ se3.exp(tangent))
    assert close(radians, tangent[:, 3:].norm(dim=-1))
    assert close(metres, se3.exp(tangent)[:, :3, 3].norm(dim=-1))
    metres, radians = se3.distance(a[:, None], a)
    assert metres.shape == radians.shape == (4, 4)
    assert close(metres.diagonal(), tensor(0.0)) and close(radians.diagonal(), tensor(0.0), 1e-7)
    assert close(metres, metres.T) and close(radians, radians.T)


def test_products_drift_and_reprojection_mends_them():
    step = transforms((), dtype=torch.float32)
    pose = torch.linalg.matrix_power(step, 4096)
    mended = se3.reproject(pose)
    eye = torch.eye(3)
    drift = (pose[:3, :3].T @ pose[:3, :3] - eye).abs().max()
    left = (mended[:3, :3].T @ mended[:3, :3] - eye).abs().max()
    assert left < 1e-6 < drift
    assert torch.equal(mended[:3, 3], pose[:3, 3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(dtype):
    pose = transforms((2,), dtype=dtype)
    tangent = torch.zeros(2, 6, dtype=dtype)
    results = [
        se3.exp(tangent),
        se3.log(pose),
        se3.inverse(pose),
        se3.perturb(pose, tangent),
        se3.mean(pose, torch.ones(2, dtype=dtype)),
        se3.reproject(pose),
        se3.from_planar(tangent[:, :3], 0.1),
        se3.to_planar(pose),
        *se3.distance(pose, pose),
        se3.identity((2,), dtype=dtype),
    ]
    assert all(result.dtype == dtype for result in results)
