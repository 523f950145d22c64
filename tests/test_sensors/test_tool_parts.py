"""Tools of several convex parts: which one a wrench is on, and where."""

import pytest
import torch

from sensors.force.force_torque import WrenchNoise, WrenchStatus
from sensors.force.tool_parts import box_tool, ellipsoid_tool, parts_contact, rod_tool

NOISE = WrenchNoise(0.01, 0.0002).covariance()
AXES = (0.035, 0.018, 0.022)
CENTERS = ((0.1, 0.024, 0.0), (0.1, -0.024, 0.0))


def parts():
    return [
        *(ellipsoid_tool(torch.tensor(center), AXES) for center in CENTERS),
        box_tool(torch.tensor([0.03, 0.0, 0.0]), (0.09, 0.1, 0.04)),
    ]


def pushed(points, forces):
    points, forces = torch.tensor(points, dtype=torch.float64), torch.tensor(forces, dtype=torch.float64)
    return torch.cat((forces, torch.linalg.cross(points, forces)), -1)


def test_a_push_is_found_on_the_part_that_it_is_on():
    tips = [[0.135, 0.024, 0.0], [0.135, -0.024, 0.0], [0.1, 0.042, 0.0]]
    forces = [[-3.0, 0.3, 0.0], [-3.0, 0.0, 0.2], [0.2, -3.0, 0.0]]
    contact, which = parts_contact(pushed(tips, forces), parts(), NOISE)
    assert contact.status.tolist() == [int(WrenchStatus.CONTACT)] * 3
    assert which.tolist() == [0, 1, 0]
    torch.testing.assert_close(contact.point_s, torch.tensor(tips).double(), atol=8e-4, rtol=0.0)
    normals = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
    assert float((contact.normal_s * normals).sum(-1).min()) > 0.99


def test_the_part_in_front_is_the_one_that_is_touched():
    """Behind a pad stands the palm."""
    contact, which = parts_contact(pushed([[0.135, 0.024, 0.0]], [[-2.0, 0.0, 0.0]]), parts(), NOISE)
    assert which.tolist() == [0] and float(contact.point_s[0, 0]) > 0.13


def test_between_the_pads_the_palm_is_met_and_beside_all_nothing_is():
    wrenches = pushed([[0.14, 0.0, 0.0], [0.14, 0.09, 0.0]], [[-2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    contact, which = parts_contact(wrenches, parts(), NOISE)
    assert int(which[0]) == 2 and float(contact.normal_s[0, 0]) == 1.0
    assert int(contact.status[1]) == int(WrenchStatus.MISS)


def test_no_force_is_no_touch_and_no_part_is_refused():
    contact, _ = parts_contact(torch.zeros(2, 6, dtype=torch.float64), parts(), NOISE)
    assert contact.status.tolist() == [int(WrenchStatus.NONE)] * 2
    with pytest.raises(ValueError, match="part"):
        parts_contact(torch.zeros(1, 6), [], NOISE)


def test_an_ellipsoids_planes_touch_it():
    tool = ellipsoid_tool(torch.tensor([0.01, 0.0, -0.02]), AXES, faces=500)
    normals, offsets = tool.planes[:, :3], tool.planes[:, 3]
    axes = torch.tensor(AXES, dtype=torch.float64)
    # the point of the surface with that normal
    point = normals * axes.square() / (normals * axes).norm(dim=-1, keepdim=True)
    point = point + torch.tensor([0.01, 0.0, -0.02], dtype=torch.float64)
    torch.testing.assert_close((normals * point).sum(-1), offsets)
    assert float((point @ normals.T - offsets).max()) < 1e-9


def test_a_rods_planes_touch_it_and_wrenches_find_the_touched_side():
    a, b, radius = (0.01, 0.0, 0.02), (0.01, 0.06, 0.1), 0.005
    tool = rod_tool(a, b, radius, sides=48)
    axis = torch.nn.functional.normalize(torch.tensor(b) - torch.tensor(a), dim=0).double()
    across = torch.linalg.cross(axis, torch.tensor([1.0, 0.0, 0.0]).double())
    point = 0.3 * torch.tensor(a).double() + 0.7 * torch.tensor(b).double() + radius * across
    contact, _ = parts_contact(pushed([point.tolist()], [(-2.0 * across).tolist()]), [tool], NOISE)
    assert contact.status.tolist() == [int(WrenchStatus.CONTACT)]
    torch.testing.assert_close(contact.point_s[0], point, atol=2e-5, rtol=0.0)
    assert float(contact.normal_s[0] @ across) > 0.99
    # it ends a radius beyond the ends of its axis
    end = torch.tensor(b).double() + radius * axis
    assert float((tool.planes[:, :3] @ end - tool.planes[:, 3]).max()) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match="two ends"):
        rod_tool(a, a, radius)
