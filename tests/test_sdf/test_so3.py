import math

import pytest
import torch

from sdf import so3

ANGLES = [0.0, 1e-30, 1e-12, 1e-8, 1e-4, 1e-2, 0.4999, 0.5001, 1.0, 2.0, 3.0, math.pi - 1e-2, math.pi - 1e-6]
TOLERANCE = {torch.float32: 3e-6, torch.float64: 1e-14}


def vectors(angle: float, dtype: torch.dtype, generator: torch.Generator) -> torch.Tensor:
    """Rotation vectors of one length about 20 axes, the coordinate axes among them."""
    axes = torch.cat((torch.eye(3, dtype=dtype), torch.randn(17, 3, dtype=dtype, generator=generator)))
    return angle * torch.nn.functional.normalize(axes, dim=-1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 4.0, 7.0])
def test_exp_is_the_matrix_exponential(angle, dtype, generator):
    omega = vectors(angle, dtype, generator)
    expected = torch.linalg.matrix_exp(so3.hat(omega.double()))
    assert (so3.exp(omega).double() - expected).abs().max() < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp(angle, dtype, generator):
    omega = vectors(angle, dtype, generator)
    # in float32 the rotation itself says no more near half a turn than that it is near
    error = (so3.log(so3.exp(omega)) - omega).abs().max()
    assert error < 2 * TOLERANCE[dtype]
    assert (so3.angle(so3.exp(omega)) - min(angle, math.pi)).abs().max() < 2 * TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_half_a_turn(dtype, generator):
    omega = vectors(math.pi, dtype, generator)
    found = so3.log(so3.exp(omega))
    assert (found.norm(dim=-1) - math.pi).abs().max() < 1e-5
    assert (so3.exp(found) - so3.exp(omega)).abs().max() < TOLERANCE[dtype]
    exact = torch.diag_embed(torch.tensor([[1.0, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=dtype))
    assert (so3.exp(so3.log(exact)) - exact).abs().max() < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("function", [so3.exp, lambda w: so3.log(so3.exp(w)), lambda w: so3.angle(so3.exp(w))])
def test_gradients_are_finite_everywhere(function, angle, dtype, generator):
    omega = vectors(angle, dtype, generator).requires_grad_()
    value = function(omega)
    weights = torch.randn(value.shape, dtype=dtype, generator=generator)
    (gradient,) = torch.autograd.grad((weights * value).sum(), omega)
    assert torch.isfinite(value).all()
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() < 10


@pytest.mark.parametrize("angle", ANGLES)
def test_log_of_exp_has_the_identity_as_jacobian(angle, generator):
    for omega in vectors(angle, torch.float64, generator):
        jacobian = torch.autograd.functional.jacobian(lambda w: so3.log(so3.exp(w)), omega)
        assert (jacobian - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.3, 0.5, 2.0, 3.1])
def test_gradcheck(angle, generator):
    omega = vectors(angle, torch.float64, generator)[:5].requires_grad_()
    assert torch.autograd.gradcheck(so3.exp, omega)
    assert torch.autograd.gradgradcheck(so3.exp, omega)
    # through exp: log is a function of rotations alone
    assert torch.autograd.gradcheck(lambda w: so3.log(so3.exp(w)), omega)


def test_hat_is_the_cross_product_and_vee_its_inverse(generator):
    a, b = torch.randn(2, 4, 5, 3, dtype=torch.float64, generator=generator)
    assert torch.allclose((so3.hat(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
    assert torch.equal(so3.vee(so3.hat(a)), a)


@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_reprojection_gives_the_nearest_rotation(batch, generator):
    noisy = torch.randn(*batch, 3, 3, dtype=torch.float64, generator=generator)
    nearest = so3.reproject(noisy)
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.allclose(nearest.mT @ nearest, eye.expand_as(nearest), atol=1e-12)
    assert torch.allclose(torch.linalg.det(nearest), torch.ones(batch, dtype=torch.float64))
    best = (nearest - noisy).square().sum((-1, -2))
    for scale in (1e-3, 0.1, 1.0):
        other = so3.exp(scale * torch.randn(*batch, 3, dtype=torch.float64, generator=generator)) @ nearest
        assert ((other - noisy).square().sum((-1, -2)) >= best - 1e-12).all()


def test_reprojection_keeps_rotations_and_has_gradients_there(generator):
    rotation = so3.exp(torch.randn(6, 3, dtype=torch.float64, generator=generator))
    rotation = torch.cat((rotation, torch.eye(3, dtype=torch.float64)[None]))
    assert torch.allclose(so3.reproject(rotation), rotation, atol=1e-14)
    # all singular values are equal here, where the gradient of the factors is not finite
    assert torch.autograd.gradcheck(so3.reproject, rotation.requires_grad_())
    mirrored = torch.diag(torch.tensor([3.0, 2.0, -1.0], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(so3.reproject, mirrored)


def test_reprojection_under_function_transforms(no_shape_check, generator):
    matrices = torch.randn(4, 3, 3, dtype=torch.float64, generator=generator)
    assert torch.allclose(torch.func.vmap(so3.reproject)(matrices), so3.reproject(matrices))
    jacobian = torch.func.vmap(torch.func.jacrev(so3.reproject))(matrices)
    expected = torch.stack([torch.autograd.functional.jacobian(so3.reproject, m) for m in matrices])
    assert torch.allclose(jacobian, expected)


def test_exp_under_function_transforms(no_shape_check, generator):
    omega = torch.randn(4, 3, dtype=torch.float64, generator=generator)
    assert torch.allclose(torch.func.vmap(so3.exp)(omega), so3.exp(omega))
    forward = torch.func.vmap(torch.func.jacfwd(lambda w: so3.log(so3.exp(w))))(omega)
    assert torch.allclose(forward, torch.eye(3, dtype=torch.float64).expand(4, 3, 3), atol=1e-9)


def test_of_a_quaternion_undoes_quaternion(generator):
    rotation = so3.exp(torch.cat([vectors(angle, torch.float64, generator) for angle in (*ANGLES, math.pi)]))
    found = so3.quaternion(rotation)[..., [3, 0, 1, 2]]
    for scale in (1.0, -1.0, 3.0):
        assert (so3.from_wxyz(scale * found) - rotation).abs().max() < 1e-14
    assert torch.equal(so3.from_wxyz(torch.zeros(4)), torch.eye(3))
