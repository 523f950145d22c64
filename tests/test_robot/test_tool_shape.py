"""Tools of any solids: their points, and that planner, free space and contacts take them."""

import math

import pytest
import torch

from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape, gripper_links, gripper_of
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import SolidTool, ToolShape
from sdf import se3
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Capsule, Cylinder, Placed, Sphere
from tests.fixtures.meshes import box


def at(member, *place):
    return Placed(member, se3.make(torch.eye(3), torch.tensor([float(x) for x in place])))


TOOLS = {
    "ball": SolidTool([Sphere(0.01)]),
    "stick": SolidTool([at(Cylinder(0.006, 0.1), 0, 0, 0.08)]),
    "hand": SolidTool(
        [
            at(Box([0.03, 0.04, 0.02]), -0.06, 0, 0),
            *(Capsule((-0.03, y, 0.0), (0.03, y, 0.0), 0.008) for y in (-0.03, 0.0, 0.03)),
        ],
        feels=at(Box([0.03, 0.06, 0.06]), 0.0, 0, 0),
    ),
    "mesh": SolidTool([MeshSDF(box((0.02, 0.01, 0.03), (0, 0, 0)))]),
}


@pytest.fixture(params=TOOLS)
def tool(request):
    return TOOLS[request.param]


def test_points_cover_the_tool_and_lie_in_it(tool, generator):
    """Everywhere inside is a point near; on the surface are the surface's; the pads' are those where it feels."""
    spacing = 0.004
    assert isinstance(tool, ToolShape)
    low, high = tool.body.bounds.double()
    probes = low + (high - low) * torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    inside = probes[tool.body.distance(probes) < 0]
    for points, axes, border in (
        (tool.solid(spacing), 3, False),
        (tool.surface(spacing), 3, True),
        (tool.section(spacing), 2, False),
        (tool.outline(spacing), 2, True),
    ):
        assert points.shape[-1] == axes
        raised = torch.nn.functional.pad(points, (0, 3 - axes))
        off = tool.body.distance(raised)
        assert float(off.max()) < 1.1e-5 and (not border or float(off.abs().max()) < 1.1e-5)
    assert float(torch.cdist(inside, tool.solid(spacing)).amin(-1).max()) < spacing
    flat = probes * torch.tensor([1.0, 1.0, 0.0])
    flat = flat[tool.body.distance(flat) < 0][:, :2]
    assert float(torch.cdist(flat, tool.section(spacing)).amin(-1).max()) < spacing
    for felt, all_of in (
        (tool.pad_shell(spacing), tool.surface(spacing)),
        (tool.pad_section(0.004), tool.section(0.004)),
    ):
        assert 0 < len(felt) <= len(all_of)
        if tool.feels is not None:
            assert float(tool.feels.distance(torch.nn.functional.pad(felt, (0, 3 - felt.shape[-1]))).max()) < 1.1e-5


def test_the_gripper_of_solids_is_the_gripper():
    """The same shape told in two ways has the same borders."""
    shape = GripperShape()
    solid = SolidTool(gripper_links(shape))
    for ours, theirs in ((solid.outline(0.004), shape.outline(0.004)), (solid.section(0.006), shape.section(0.006))):
        for a, b in ((ours, theirs), (theirs, ours)):
            assert float(torch.cdist(a, b).amin(-1).max()) < 0.006
    covered = torch.cdist(shape.solid(0.008), solid.solid(0.008)).amin(-1)
    assert float(covered.max()) < 0.008


@pytest.mark.parametrize("spatial", [False, True])
def test_a_planner_takes_it(tool, spatial):
    bounds = torch.tensor([[0.0, -0.4, 0.02], [0.8, 0.4, 0.2]])
    made = Tool(bounds if spatial else bounds[:, :2], shape=tool)
    centers, radius = made.covering_discs(4)
    assert len(made.info) > 0 and radius < 0.2 and len(centers) == 4
    q = torch.tensor([0.3, 0.0, 0.1, 0.5] if spatial else [0.3, 0.0, 0.5])
    assert made.points(q).shape[-1] == 3


def test_a_push_by_a_stick_moves_the_object_along():
    """The quasi-static model with a round stick: a box met in its middle goes straight on."""
    from rumi.dynamics.along_path import Pusher, push_along_path
    from rumi.dynamics.outline import RectangleOutline
    from rumi.dynamics.sliding import Sliding

    like = torch.zeros(1)
    sliding = Sliding(torch.zeros(2), like + 0.04, like + 0.5)
    path = torch.stack((torch.linspace(-0.10, 0.0, 40), torch.zeros(40), torch.zeros(40)), -1)[None]
    pusher = Pusher(TOOLS["stick"].outline(0.002).float())
    track = push_along_path(torch.zeros(1, 3), path, pusher, RectangleOutline((0.05, 0.03)), sliding).track
    x, y, yaw = track[0, -1].tolist()
    assert x == pytest.approx(0.056, abs=0.001) and abs(y) < 1e-3 and abs(yaw) < 0.05


def test_what_is_no_tool_is_refused():
    with pytest.raises(UsageError, match="crosses z = 0"):
        SolidTool([at(Sphere(0.01), 0, 0, 0.5)])
    with pytest.raises(UsageError, match="feel somewhere"):
        SolidTool([Sphere(0.01)], feels=at(Sphere(0.01), 1.0, 0, 0))
    with pytest.raises(UsageError, match="at least one solid"):
        SolidTool([])
    with pytest.raises(UsageError, match="'quasi-static' or 'displacement'"):
        gripper_of(TOOLS["ball"])
    assert math.isclose(TOOLS["ball"].surface(0.002).norm(dim=-1).mean(), 0.01, abs_tol=1e-5)


def test_a_mesh_in_millimetres_is_refused_with_its_scale(tmp_path):
    pytest.importorskip("trimesh")
    file = tmp_path / "hand.obj"
    file.write_text("v -40 -40 -40\nv 90 0 -20\nv 0 90 -20\nv 0 0 90\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    with pytest.raises(UsageError, match=r"Expected a mesh in metres between .* millimet"):
        SolidTool.of_mesh(file)
    assert len(SolidTool.of_mesh(file, scale=0.001).section(0.01))
