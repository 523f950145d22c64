"""Wrenches: where a tool was touched, against contacts that are known; what no contact can be is said to be so."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sdf import backend
from sdf.mesh.convex import hull
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.primitives import Box
from sensors.force.force_torque import (
    WrenchContact,
    WrenchNoise,
    WrenchSettings,
    WrenchStatus,
    wrench_contact,
)
from sensors.force.tool_surface import ConvexTool, SphereTool, ToolSurface

F64 = torch.float64
RADIUS = 0.0125


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def ball(lever: float = 0.05) -> SphereTool:
    return SphereTool(torch.tensor([0.0, 0.0, lever], dtype=F64), RADIUS)


def box_mesh(half: tuple[float, float, float] = (0.01, 0.015, 0.04), lever: float = 0.06) -> TriangleMesh:
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=F64)] * 3)
    corners = signs * torch.tensor(half, dtype=F64) + torch.tensor([0.0, 0.0, lever], dtype=F64)
    return hull(TriangleMesh(corners, torch.tensor([[0, 1, 2], [3, 4, 5], [4, 5, 6], [5, 6, 7]])))


def unit(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator, dtype=F64), dim=-1)


def pushes(normals: Tensor, friction: float, size: float, generator: torch.Generator) -> Tensor:
    """Forces on surfaces with these outward normals, anywhere within the friction cone."""
    side = unit(generator, *normals.shape[:-1])
    side = torch.nn.functional.normalize(side - (side * normals).sum(-1, keepdim=True) * normals, dim=-1)
    share = torch.rand(*normals.shape[:-1], 1, generator=generator, dtype=F64).sqrt() * friction
    return size * (-normals + share * side) / (1 + share.square()).sqrt()


def wrenches(points: Tensor, forces: Tensor) -> Tensor:
    return torch.cat((forces, torch.linalg.cross(points, forces)), -1)


def ball_touches(count: int, generator: torch.Generator, lever: float = 0.05) -> tuple[Tensor, Tensor, Tensor]:
    """Points, normals and noise-free wrenches."""
    normals = unit(generator, count)
    points = torch.tensor([0.0, 0.0, lever], dtype=F64) + RADIUS * normals
    return points, normals, wrenches(points, pushes(normals, 0.5, 5.0, generator))


def box_touches(count: int, generator: torch.Generator, within: float = 0.9) -> tuple[Tensor, Tensor, Tensor]:
    half, lever = torch.tensor([0.01, 0.015, 0.04], dtype=F64), torch.tensor([0.0, 0.0, 0.06], dtype=F64)
    axis = torch.randint(3, (count,), generator=generator)
    sign = torch.randint(2, (count,), generator=generator) * 2.0 - 1.0
    normals = torch.nn.functional.one_hot(axis, 3).to(F64) * sign[:, None]
    beside = within * half * (2.0 * torch.rand(count, 3, generator=generator, dtype=F64) - 1.0)
    points = torch.where(normals != 0, normals * half, beside) + lever
    return points, normals, wrenches(points, pushes(normals, 0.5, 5.0, generator))


def test_golden_wrenches(golden: Callable[[str], dict[str, Any]]) -> None:
    case = golden("wrench.sphere")
    given, expected = case["inputs"], case["expected"]
    tool = SphereTool(torch.tensor(given["center"], dtype=F64), given["radius"])
    covariance = WrenchNoise(given["force_n"], given["moment_nm"]).covariance()
    found = wrench_contact(torch.tensor(given["wrenches"], dtype=F64), tool, covariance)
    for name, value in (("point", found.point_s), ("normal", found.normal_s), ("covariance", found.covariance)):
        torch.testing.assert_close(value, torch.tensor(expected[name], dtype=F64), atol=case["atol"], rtol=0)
    assert found.status.tolist() == expected["status"]


def test_without_noise_the_point_is_exact(generator: torch.Generator) -> None:
    covariance = WrenchNoise(0.01, 0.0005).covariance()
    for tool, (points, normals, wrench) in (
        (ball(), ball_touches(200, generator)),
        (ConvexTool.of(box_mesh()), box_touches(200, generator)),
    ):
        found = wrench_contact(wrench, tool, covariance)
        torch.testing.assert_close(found.point_s, points, atol=1e-12, rtol=0)
        torch.testing.assert_close(found.normal_s, normals, atol=1e-9, rtol=0)
        assert bool((found.status == WrenchStatus.CONTACT).all())


def errors(tool: ToolSurface, points: Tensor, wrench: Tensor, noise: WrenchNoise, generator: torch.Generator) -> tuple:
    """Error against the propagated bound (root mean squares), and the share in which the 90 % ellipse has the truth."""
    deviations = noise.covariance().diagonal().sqrt()
    noisy = wrench + deviations * torch.randn(wrench.shape, generator=generator, dtype=F64)
    found = wrench_contact(noisy, tool, noise.covariance())
    good = found.status == WrenchStatus.CONTACT
    assert float(good.double().mean()) > 0.99
    off, spread = (found.point_s - points)[good], found.covariance[good]
    bound = spread.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()
    distance = (off * (torch.linalg.pinv(spread, rtol=1e-6) @ off[..., None])[..., 0]).sum(-1)
    # chi-square of two degrees of freedom
    return float(off.square().sum(-1).mean().sqrt() / bound), float((distance < -2.0 * math.log(0.1)).double().mean())


@pytest.mark.parametrize("lever", [0.05, 0.1])
def test_errors_are_as_large_as_the_covariance_says(lever: float, generator: torch.Generator) -> None:
    points, _, wrench = ball_touches(4000, generator, lever)
    ratio, share = errors(ball(lever), points, wrench, WrenchNoise(0.03, 0.001), generator)
    assert 0.85 < ratio < 1.2
    assert share == pytest.approx(0.9, abs=0.03)


def test_errors_on_flat_faces_are_as_large_as_the_covariance_says(generator: torch.Generator) -> None:
    points, _, wrench = box_touches(4000, generator, within=0.6)
    ratio, share = errors(ConvexTool.of(box_mesh()), points, wrench, WrenchNoise(0.02, 0.0005), generator)
    assert 0.9 < ratio < 1.1
    assert share == pytest.approx(0.9, abs=0.02)


def test_the_covariance_is_that_of_the_points_derivative(generator: torch.Generator) -> None:
    covariance = torch.randn(6, 6, generator=generator, dtype=F64)
    covariance = 1e-6 * covariance @ covariance.mT
    for tool, touches in ((ball(), ball_touches(8, generator)), (ConvexTool.of(box_mesh()), box_touches(8, generator))):
        wrench = touches[2].clone()
        # a moment about the force does not move the line; with it the derivative is still that of the line
        wrench[:, 3:] += 1e-4 * wrench[:, :3]
        found = wrench_contact(wrench, tool, covariance)
        with backend.force("torch"):
            for one, spread in zip(wrench, found.covariance, strict=True):
                jacobian = torch.autograd.functional.jacobian(
                    lambda w, tool=tool: wrench_contact(w, tool, covariance).point_s, one
                )
                torch.testing.assert_close(spread, jacobian @ covariance @ jacobian.mT, rtol=1e-8, atol=1e-15)


def test_normals_are_as_uncertain_as_it_says(generator: torch.Generator) -> None:
    noise = WrenchNoise(0.03, 0.001)
    # a ball of many faces: its normals jump from face to face, and by as much in all
    points = torch.tensor([0.0, 0.0, 0.05], dtype=F64) + RADIUS * unit(generator, 400)
    faceted = ConvexTool.of(hull(TriangleMesh(points, torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 0, 4]]))))
    _, normals, wrench = ball_touches(2000, generator)
    deviations = noise.covariance().diagonal().sqrt()
    noisy = wrench + deviations * torch.randn(wrench.shape, generator=generator, dtype=F64)
    for tool in (ball(), faceted):
        found = wrench_contact(noisy, tool, noise.covariance())
        good = found.status == WrenchStatus.CONTACT
        chord = (found.normal_s - normals)[good].square().sum(-1).mean().sqrt()
        said = float(found.normal_sd_rad[good].square().mean().sqrt())
        assert float(chord) / math.sqrt(2.0) == pytest.approx(said, rel=0.15)


def statuses(found: WrenchContact) -> list[WrenchStatus]:
    return [WrenchStatus(value) for value in found.status.tolist()]


@pytest.mark.parametrize("tool", [ball(), ConvexTool.of(box_mesh(lever=0.05))], ids=["ball", "box"])
def test_impossible_wrenches_are_reported(tool: ToolSurface) -> None:
    covariance = WrenchNoise(0.02, 0.0005).covariance()
    center, side = torch.tensor([0.0, 0.0, 0.05], dtype=F64), torch.tensor([-5.0, 0.0, 0.0], dtype=F64)
    touch = wrenches(center, side)
    weak, twisted, missing = touch * 0.01, touch.clone(), wrenches(center + torch.tensor([0.0, 0.04, 0.0]), side)
    twisted[3] += 0.05
    leaning = wrenches(center + torch.tensor([0.0, 0.0, 0.0121]), side)
    if isinstance(tool, ConvexTool):  # onto the wide face from aslant
        leaning = wrenches(center + torch.tensor([0.01, 0.0, 0.0]), torch.tensor([-2.0, 0.0, -5.0], dtype=F64))
    found = wrench_contact(torch.stack((touch, weak, twisted, missing, leaning)), tool, covariance)
    assert statuses(found) == [
        WrenchStatus.CONTACT,
        WrenchStatus.NONE,
        WrenchStatus.TWIST,
        WrenchStatus.MISS,
        WrenchStatus.FRICTION,
    ]
    assert all(bool(torch.isfinite(part).all()) for part in found)
    assert not bool(found.point_s[1].any())
    # what the settings allow is no longer impossible
    allowed = wrench_contact(torch.stack((touch, twisted)), tool, covariance, WrenchSettings(twist_m=0.02))
    assert statuses(allowed) == [WrenchStatus.CONTACT] * 2
    steep = wrench_contact(leaning, tool, covariance, WrenchSettings(friction=20.0))
    assert statuses(steep._replace(status=steep.status[None])) == [WrenchStatus.CONTACT]


def test_a_line_that_misses_within_the_noise_is_a_touch_next_to_it() -> None:
    center, side = torch.tensor([0.0, 0.0, 0.05], dtype=F64), torch.tensor([-5.0, 0.0, 0.0], dtype=F64)
    beyond = wrenches(center + torch.tensor([0.0, 0.0, RADIUS + 0.0002]), side)
    for tool in (ball(), ConvexTool.of(box_mesh((0.01, 0.015, RADIUS), 0.05))):
        loose = WrenchSettings(friction=50.0)
        found = wrench_contact(beyond, tool, WrenchNoise(0.02, 0.001).covariance(), loose)
        assert int(found.status) == WrenchStatus.CONTACT
        assert float(found.point_s[2]) == pytest.approx(0.05 + RADIUS, abs=1e-9)
        sharp = wrench_contact(beyond, tool, WrenchNoise(0.0002, 0.00001).covariance(), loose)
        assert int(sharp.status) == WrenchStatus.MISS


def test_how_far_a_line_passes_a_polyhedron_by(generator: torch.Generator) -> None:
    half = (0.01, 0.015, 0.04)
    tool = ConvexTool.of(box_mesh(half, 0.0))
    origins = 0.1 * unit(generator, 300)
    directions = unit(generator, 300)
    found = tool.strike(origins, directions)
    # the box that is so much larger is just met: the largest excess over the half edges has its least at the gap
    times = torch.linspace(-0.3, 0.3, 60001, dtype=F64)
    for origin, direction, gap in zip(origins[:40], directions[:40], found.gap[:40], strict=True):
        excess = ((origin + times[:, None] * direction).abs() - torch.tensor(half, dtype=F64)).amax(-1)
        if float(gap) > 0:
            assert float(gap) == pytest.approx(float(excess.min()), abs=1e-5)
        else:
            assert float(excess.min()) < 1e-5
    on = Box(half).double()(found.point).distance.abs()
    assert float(on[found.gap <= 0].max()) < 1e-12


def test_only_convex_shapes_are_tools() -> None:
    mesh = box_mesh()
    two = TriangleMesh(torch.cat((mesh.vertices, mesh.vertices + 0.02)), torch.cat((mesh.faces, mesh.faces + 8)))
    with pytest.raises(MeshError, match="convex"):
        ConvexTool.of(two)
    with pytest.raises(MeshError, match="outward"):
        ConvexTool.of(TriangleMesh(mesh.vertices, mesh.faces.flip(-1)))
    assert len(ConvexTool.of(mesh).planes) == 6
    for radius in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="radius above 0"):
            SphereTool(torch.zeros(3), radius)


def test_the_tool_may_stand_anywhere_in_the_sensors_frame(generator: torch.Generator) -> None:
    from sdf import se3

    sensor_T_tool = se3.exp(torch.tensor([0.02, -0.03, 0.1, 0.4, -0.7, 1.1], dtype=F64))
    tool = ConvexTool.of(box_mesh(), sensor_T_tool)
    points, normals, wrench = box_touches(50, generator)
    moved = se3.apply(sensor_T_tool, points)
    turned = wrench[:, :3] @ sensor_T_tool[:3, :3].mT
    found = wrench_contact(wrenches(moved, turned), tool, WrenchNoise().covariance())
    torch.testing.assert_close(found.point_s, moved, atol=1e-12, rtol=0)
    torch.testing.assert_close(found.normal_s, normals @ sensor_T_tool[:3, :3].mT, atol=1e-9, rtol=0)


def test_gradients_reach_the_wrench(generator: torch.Generator) -> None:
    for tool, touches in ((ball(), ball_touches(3, generator)), (ConvexTool.of(box_mesh()), box_touches(3, generator))):
        covariance = WrenchNoise().covariance()
        wrench = touches[2].requires_grad_()
        with backend.force("torch"):
            assert torch.autograd.gradcheck(lambda w, t=tool, c=covariance: wrench_contact(w, t, c)[:2], wrench)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(), (0,), (3, 5), (200,)])
def test_versions_agree(shape: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator) -> None:
    wrench = torch.randn(*shape, 6, generator=generator, dtype=dtype) * torch.tensor([5.0] * 3 + [0.2] * 3, dtype=dtype)
    if len(shape) == 1 and shape[0] > 2:
        wrench[0], wrench[1, :3] = 0.0, torch.tensor([0.0, 0.0, 3.0], dtype=dtype)
    covariance = WrenchNoise().covariance()
    for tool in (ball(), ConvexTool.of(box_mesh())):
        with backend.force("torch"):
            plain = wrench_contact(wrench, tool, covariance)
        with backend.force("numba"):
            fused = wrench_contact(wrench, tool, covariance)
        tight = dtype == torch.float64
        for a, b in zip(plain[:4], fused[:4], strict=True):
            assert a.shape == b.shape
            assert a.dtype == b.dtype == dtype
            torch.testing.assert_close(a, b, rtol=1e-7 if tight else 2e-2, atol=1e-10 if tight else 2e-3)
        assert int((plain.status != fused.status).sum()) <= (0 if tight else 2)


def test_what_is_no_wrench_is_refused(no_shape_check: None) -> None:
    covariance = WrenchNoise().covariance()
    with pytest.raises(ValueError, match="finite"):
        wrench_contact(torch.full((6,), torch.nan), ball(), covariance)
    with pytest.raises(ValueError, match="floating"):
        wrench_contact(torch.tensor([0, 0, -5, 0, 0, 0]), ball(), covariance)
    assert float(WrenchNoise(0.1, 0.01, tared_over=4).covariance()[0, 0]) == pytest.approx(0.0125)
