"""What objects are made of: masses and inertias in closed form, rays on the true surface, rest, and pushes."""

import math

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.sim.bodies import body_of, pieces
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import World
from scripts.bench.mug_mesh import mug_mesh
from sdf import se3, so3
from sdf.grid_sdf import GridSDF
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Placed, Sphere, TorusArc, Union
from tests.fixtures.meshes import box, together

pytest.importorskip("scipy")
pytestmark = pytest.mark.sim

HEIGHT = 0.045
HULL = PhysicsSettings(collision="hull")
TILT = se3.make(so3.exp(torch.tensor([0.0, 0.0, 0.7])), torch.tensor([0.02, -0.01, 0.05]))


def world_of(shape, physics=HULL, table=None):
    return World(body_of(shape, physics, table=table), GripperShape(), HEIGHT, 0.004, physics)


def inertia_of(world):
    """Mass, middle and inertia of the object about it, all in the object's frame."""
    body = world.model.body("object").id
    w, x, y, z = world.model.body_iquat[body].tolist()
    axis = torch.tensor([x, y, z], dtype=torch.float64)
    length = float(axis.norm())
    turn = so3.exp(axis / max(length, 1e-12) * 2 * math.atan2(length, w))
    own = torch.diag(torch.tensor(world.model.body_inertia[body].tolist(), dtype=torch.float64))
    middle = torch.tensor(world.model.body_ipos[body].tolist(), dtype=torch.float64)
    return float(world.model.body_mass[body]), middle, turn @ own @ turn.mT


def pushed(world, start, at, motion, actions=1):
    start, at, motion = (torch.tensor(v, dtype=torch.float64) for v in (start, at, motion))
    world.reset(start, at)
    for _ in range(actions):
        track = world.move(start + torch.arange(1, 21)[:, None] / 20 * motion, 1.0, 0.1)
    return track.world_T_object[-1]


def test_a_meshed_box_weighs_as_a_box():
    half, mass = (0.03, 0.04, 0.05), 0.8
    physics = PhysicsSettings(mass_kg=mass, collision="hull")
    x, y, z = half
    moments = mass / 3 * torch.diag(torch.tensor([y * y + z * z, x * x + z * z, x * x + y * y], dtype=torch.float64))
    for shape in (Box(half), MeshSDF(box(half))):
        found, middle, inertia = inertia_of(world_of(shape, physics))
        assert found == pytest.approx(mass)
        assert float(middle.abs().max()) < 1e-6
        torch.testing.assert_close(inertia, moments, rtol=5e-3, atol=1e-8)


def test_inertia_is_the_shapes_not_its_hulls():
    """Two cubes far apart, joined by a thin bar; the hull is solid between them."""
    a, b = box((0.02, 0.02, 0.02), (-0.05, 0.0, 0.02)), box((0.02, 0.02, 0.02), (0.05, 0.0, 0.02))
    mass, middle, inertia = inertia_of(
        world_of(MeshSDF(together(a, b)), PhysicsSettings(mass_kg=1.0, collision="hull"))
    )
    assert mass == pytest.approx(1.0)
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.0, 0.02], dtype=torch.float64), atol=1e-4, rtol=0)
    assert float(inertia[2, 2]) == pytest.approx(0.05**2 + 2 / 3 * 0.02**2, rel=0.01)


def test_overlapping_members_weigh_once():
    """A cylinder in two halves that overlap."""
    low, high = (se3.make(torch.eye(3), torch.tensor([0.0, 0.0, z])) for z in (0.03, 0.05))
    shape = Union((Placed(Cylinder(0.03, 0.03), low), Placed(Cylinder(0.03, 0.03), high)))
    mass, middle, inertia = inertia_of(world_of(shape))
    assert mass == pytest.approx(0.35)
    assert float(middle[2]) == pytest.approx(0.04, abs=1e-4)
    assert float(inertia[0, 0]) == pytest.approx(0.35 * (3 * 0.03**2 + 0.08**2) / 12, rel=0.01)


SHAPES = {
    "sphere": Sphere(0.05),
    "box": Box((0.03, 0.04, 0.05)),
    "cylinder": Cylinder(0.04, 0.05),
    "capsule": Capsule((0.0, 0.0, 0.03), (0.03, 0.0, 0.08), 0.02),
    "ball": Capsule((0.01, 0.0, 0.03), (0.01, 0.0, 0.03), 0.02),
    "arc": TorusArc((0.0, 0.0, 0.06), 0.04, 0.01, 2.0),
    "cup": Cup(0.041, 0.095, 0.004, 0.004),
    "placed": Placed(Box((0.03, 0.04, 0.05)), TILT),
    "placed twice": Placed(Placed(Capsule((0, 0, 0), (0.05, 0, 0), 0.02), TILT), TILT),
    "mesh": MeshSDF(together(box((0.05, 0.02, 0.01), (0, 0, 0.01)), box((0.01, 0.02, 0.04), (0.04, 0, 0.06)))),
}


@pytest.mark.parametrize("name", SHAPES)
def test_rays_meet_the_shape(name):
    """What is hit lies on the exact shape, of a mesh on the mesh and not on what it collides as."""
    shape = SHAPES[name]
    world = world_of(shape)
    at = torch.tensor([0.4, 0.1, -0.8], dtype=torch.float64)
    world.data.qpos[world._object : world._object + 7] = (0.4, 0.1, 0.2, math.cos(-0.4), 0, 0, math.sin(-0.4))
    origin = torch.tensor([0.9, 0.4, 0.4], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    middle = se3.apply(se3.from_planar(at, 0.2), shape.bounds.double().mean(0, keepdim=True))[0]
    aim = middle + 0.05 * torch.randn(3000, 3, generator=generator, dtype=torch.float64)
    distance, is_object = world.cast(origin, aim - origin)
    hits = origin + distance[is_object][:, None] * (aim - origin)[is_object]
    assert len(hits) > 200
    local = se3.apply(se3.inverse(world.world_T_object()), hits)
    # rounded by MuJoCo to float32; round tubes and walls are of straight pieces
    assert float(shape.distance(local).abs().max()) < (0.001 if name in ("arc", "cup") else 2e-5)


def test_the_notch_of_a_mesh_is_free_to_rays():
    world = world_of(SHAPES["mesh"])
    world.reset(torch.tensor([0.0, -0.3, 0.0]), torch.tensor([0.4, 0.0, 0.0]))
    down = torch.tensor([[0.0, 0.0, -1.0]])
    distance, is_object = world.cast(torch.tensor([0.37, 0.0, 1.0]), down)
    assert bool(is_object[0]) and float(distance[0]) == pytest.approx(0.98, abs=5e-4)  # the hull is 40 mm higher here


@pytest.mark.parametrize("how", ["hull", "auto"])
def test_a_meshed_box_rests_and_is_pushed_as_a_box(how):
    if how == "auto":
        pytest.importorskip("coacd")
    half = (0.03, 0.04, 0.05)
    physics = PhysicsSettings(collision=how)
    ends = []
    for shape in (Box(half), MeshSDF(box(half))):
        world = world_of(shape, physics)
        still = pushed(world, (0.1, 0.0, 0.0), (0.42, 0.0, 0.3), (0.0, 0.0, 0.0), actions=3)
        assert float((se3.to_planar(still) - torch.tensor([0.42, 0.0, 0.3])).abs().max()) < 1e-4
        assert float(still[2, 3]) == pytest.approx(0.05, abs=5e-4)
        assert float(np.linalg.norm(world.data.joint("object").qvel[:3])) < 1e-4
        ends.append(pushed(world, (0.30, 0.02, 0.0), (0.42, 0.0, 0.3), (0.08, 0.0, 0.0)))
        assert float(ends[-1][2, 2]) > math.cos(math.radians(3))
    shift, turn = se3.distance(*ends)
    assert float(ends[0][0, 3]) > 0.44  # displaced
    assert float(shift) < 0.002 and math.degrees(float(turn)) < 3.0


def test_mass_and_friction_matter():
    """A heavier object stops a weak drive; a slippery one glides along a slanting push."""
    shape = MeshSDF(box((0.04, 0.04, 0.05)))
    ends = {}
    for mass in (0.3, 60.0):
        physics = PhysicsSettings(mass_kg=mass, collision="hull", max_force_n=50.0)
        ends[mass] = float(pushed(world_of(shape, physics), (0.30, 0.0, 0.0), (0.42, 0.0, 0.0), (0.10, 0.0, 0.0))[0, 3])
    assert ends[0.3] > 0.44 and ends[60.0] < 0.425


def test_what_tips_over_is_refused():
    """A slab balanced on its edge."""
    turn = se3.make(so3.exp(torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64))
    world = world_of(MeshSDF(box((0.05, 0.05, 0.02)).moved(turn)))
    with pytest.raises(UsageError, match=r"tipped by .* degrees.*--upright"):
        world.reset(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([0.4, 0.0, 0.0]))


def test_unknown_shape_is_named():
    with pytest.raises(UsageError, match=r"\(Box, .*MeshSDF, Mug, .*\), got GridSDF"):
        body_of(GridSDF.from_sdf(Sphere(0.05), 0.01), PhysicsSettings())


def test_a_mesh_stands_on_few_points():
    """A round base of many corners: a few feet, spread out."""
    parts = pieces(MeshSDF(mug_mesh(Mug(), 0.006)), HULL)
    feet = [part for part in parts if part.mesh is None]
    assert 6 <= len(feet) <= 12
    places = torch.tensor([[float(x) for x in part.xml.split('pos="')[1].rstrip('"').split()] for part in feet])
    assert float(places[:, :2].norm(dim=-1).max()) == pytest.approx(0.041, abs=1e-4)
    apart = torch.cdist(places, places) + torch.eye(len(places))
    assert float(apart.min()) > 0.010


@pytest.mark.slow
def test_a_meshed_mug_is_pushed_as_the_mug():
    pytest.importorskip("coacd")
    shape = Mug(tube_radius=0.008, ring_radius=0.035)
    mesh = MeshSDF(mug_mesh(shape, 0.006))
    mug, meshed = world_of(shape, PhysicsSettings()), world_of(mesh, PhysicsSettings(), GridSDF.from_sdf(shape, 0.002))
    for start, at, motion in (
        ((0.30, 0.03, 0.0), (0.40, 0.0, 0.3), (0.08, 0.0, 0.0)),
        ((0.45, -0.12, 1.2), (0.45, 0.0, 0.0), (0.02, 0.077, 0.3)),
        ((0.50, -0.10, 1.8), (0.45, 0.01, 0.0), (-0.04, 0.069, 0.0)),
    ):
        shift, turn = se3.distance(pushed(mug, start, at, motion), pushed(meshed, start, at, motion))
        assert float(shift) < 0.003 and math.degrees(float(turn)) < 6.0
