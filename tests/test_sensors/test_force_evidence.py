"""Forces as evidence: a belief finds the object that the tool touched."""

import math

import pytest
import torch

from sdf import se3
from sdf.mesh.convex import hull
from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.triangles import Triangles
from sdf.primitives import Sphere
from sensors.evidence import Evidence
from sensors.force.force_torque import WrenchContact, WrenchNoise, WrenchStatus, wrench_contact
from sensors.force.tool_surface import SphereTool
from sensors.force_evidence import signal_weight, torque_readings, wrench_observation, wrench_touches
from sensors.semantics import Semantics
from sensors.touch.contact_model import ContactModel

F64 = torch.float64
HALF = torch.tensor([0.03, 0.08, 0.05], dtype=F64)
TOOL = SphereTool(torch.tensor([0.0, 0.0, 0.1], dtype=F64), 0.0125)


def box() -> Triangles:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=F64)] * 3) * HALF
    return Triangles(hull(TriangleMesh(corners, torch.tensor([[0, 1, 2], [3, 4, 5], [4, 5, 6], [5, 6, 7]]))).corners)


def touches(
    generator: torch.Generator, noise: WrenchNoise
) -> tuple[WrenchContact, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A box felt on three sides by a ball on a sensor that points anywhere; the last reading is none."""
    world_T_object = se3.from_planar(torch.tensor([0.4, 0.1, 0.3], dtype=F64), 0.05)
    points_o = torch.tensor(
        [[0.03, 0.02, 0.0], [0.01, 0.08, 0.01], [-0.03, -0.05, -0.01], [0.0, -0.08, 0.0]], dtype=F64
    )
    normals_o = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]], dtype=F64)
    points, normals = se3.apply(world_T_object, points_o), se3.rotate(world_T_object, normals_o)
    turn = se3.exp(torch.cat((torch.zeros(4, 3), torch.randn(4, 3, generator=generator)), -1).to(F64))
    center = points + 0.0125 * normals
    place = center - (turn[:, :3, :3] @ torch.tensor([0.0, 0.0, 0.1], dtype=F64))
    world_T_sensor = se3.make(turn[:, :3, :3], place)
    # the object pushes the tool outward
    force = se3.rotate(se3.inverse(world_T_sensor), 5.0 * normals[:, None])[:, 0]
    arm = se3.apply(se3.inverse(world_T_sensor), points[:, None])[:, 0]
    wrench = torch.cat((force, torch.linalg.cross(arm, force)), -1)
    wrench = wrench + noise.covariance().diagonal().sqrt() * torch.randn(4, 6, generator=generator, dtype=F64)
    wrench[3] *= 0.01
    return wrench_contact(wrench, TOOL, noise.covariance()), world_T_sensor, world_T_object, points


def test_points_and_normals_are_the_objects(generator: torch.Generator) -> None:
    contact, world_T_sensor, world_T_object, points = touches(generator, WrenchNoise(1e-6, 1e-7))
    found = wrench_touches(contact, world_T_sensor, box())
    torch.testing.assert_close(found.points_w, points[:3], atol=1e-6, rtol=0)
    own = se3.rotate(se3.inverse(world_T_object), found.normals_w)
    torch.testing.assert_close(
        own, torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]], dtype=F64), atol=1e-4, rtol=0
    )
    observation, instant = wrench_observation(contact, world_T_sensor)
    assert instant.tolist() == [0, 1, 2]
    torch.testing.assert_close(observation.points, points[:3], atol=1e-6, rtol=0)
    assert bool(observation.of_class(Semantics.SURFACE).all())
    assert bool(observation.attached.all())


def test_the_true_pose_is_the_likeliest(generator: torch.Generator) -> None:
    contact, world_T_sensor, world_T_object, _ = touches(generator, WrenchNoise(0.02, 0.0005))
    evidence = wrench_touches(contact, world_T_sensor, box())
    assert isinstance(evidence, Evidence)
    off = torch.zeros(6, 6, dtype=F64)
    off[:, :2] = 0.02 * torch.tensor([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [0, 0]], dtype=F64)
    off[5, 5] = 0.2
    poses = torch.cat((world_T_object[None], se3.perturb(world_T_object, off)))
    assert int(evidence.log_likelihood(poses).argmax()) == 0
    spread = contact.covariance[:3].diagonal(dim1=-2, dim2=-1).sum(-1).mean() / 2
    assert evidence.noise.point_m == pytest.approx(math.hypot(0.001, float(spread.sqrt())))


def test_without_touches_nothing_is_said(generator: torch.Generator) -> None:
    contact, world_T_sensor, world_T_object, _ = touches(generator, WrenchNoise(0.02, 0.0005))
    none = contact._replace(status=torch.full_like(contact.status, int(WrenchStatus.MISS)))
    evidence = wrench_touches(none, world_T_sensor, box())
    assert evidence.log_likelihood(world_T_object[None]).tolist() == [0.0]
    assert len(wrench_observation(none, world_T_sensor)[0]) == 0


def test_signals_that_err_together_count_for_less(generator: torch.Generator) -> None:
    # the mean of n readings of a first-order process has the variance of n times the weight
    gain, interval, count = 25.0, 0.01, 400
    rho = math.exp(-gain * interval)
    apart = (torch.arange(count)[:, None] - torch.arange(count)).abs()
    variance = float((rho ** apart.to(F64)).mean())
    assert 1.0 / variance == pytest.approx(count * signal_weight(interval, gain), rel=0.03)
    points = 0.3 * torch.randn(5, 7, 3, generator=generator, dtype=F64)
    signals = torch.tensor([True, False, False, True, False])
    poses = se3.identity((2,), dtype=F64)
    poses[1, 0, 3] = 0.2
    model = ContactModel(0.6, 0.02)
    full = torque_readings(signals, points, Sphere(0.1).double(), model).log_likelihood(poses)
    part = torque_readings(signals, points, Sphere(0.1).double(), model, 0.25).log_likelihood(poses)
    torch.testing.assert_close(part, 0.25 * full)
    with pytest.raises(ValueError, match="above 0"):
        signal_weight(0.0, 25.0)
