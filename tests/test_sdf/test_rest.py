"""Poses at rest: a box's six, and which of them counts as upright."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sdf import se3, so3
from sdf.mesh.rest import center_of_mass, resting_poses, turn_to_z, upright

pytest.importorskip("trimesh")
pytest.importorskip("networkx")
pytest.importorskip("scipy")

HALF = (0.03, 0.04, 0.05)


def tilted(mesh, *turn):
    return mesh.moved(se3.make(so3.exp(torch.tensor(turn, dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)))


def face_share(a, b, c):
    """Part of the sphere that a face 2a x 2b at distance c covers, seen from the middle."""
    return math.atan(a * b / (c * math.sqrt(a * a + b * b + c * c))) / math.pi


def test_a_box_rests_on_its_six_faces(shapes):
    poses = resting_poses(shapes.box(HALF), torch.zeros(3))
    assert len(poses) == 6
    a, b, c = HALF
    expected = sorted([face_share(a, b, c), face_share(b, c, a), face_share(c, a, b)] * 2, reverse=True)
    assert [pose.probability for pose in poses] == pytest.approx(expected, rel=1e-6)
    for pose in poses:
        torch.testing.assert_close(pose.rest_R_mesh @ pose.rest_R_mesh.mT, torch.eye(3, dtype=torch.float64))
        moved = shapes.box(HALF).vertices @ pose.rest_R_mesh.mT
        assert int((moved[:, 2] < float(moved[:, 2].min()) + 1e-9).sum()) == 4


def test_its_own_up_where_it_stands_so(shapes):
    """On its smallest face, though it would rather lie; and a bit off that, the smallest turn."""
    box = shapes.box(HALF)
    torch.testing.assert_close(upright(resting_poses(box, torch.zeros(3))).rest_R_mesh, torch.eye(3).double())
    pose = upright(resting_poses(tilted(box, 0.05, 0.0, 0.0), torch.zeros(3)))
    torch.testing.assert_close(so3.log(pose.rest_R_mesh), torch.tensor([-0.05, 0.0, 0.0]).double(), atol=1e-6, rtol=0)


def test_else_the_most_likely(shapes):
    leaning = tilted(shapes.box(HALF), 0.3, 0.3, 0.0)
    pose = upright(resting_poses(leaning, torch.zeros(3)))
    assert pose.probability == pytest.approx(face_share(0.04, 0.05, 0.03), rel=1e-6)
    high = (leaning.vertices @ pose.rest_R_mesh.mT)[:, 2]
    assert float(high.max() - high.min()) == pytest.approx(0.06, abs=1e-9)


def test_the_middle_decides(shapes):
    """A slim box stands on its foot; with its mass in one end it hardly lands on the other."""
    box = shapes.box((0.01, 0.01, 0.05))
    even, heavy = (
        {round(float(pose.rest_R_mesh[2, 2])): pose.probability for pose in resting_poses(box, middle)}
        for middle in (torch.zeros(3), torch.tensor([0.0, 0.0, -0.045]))
    )
    assert even[1] == pytest.approx(even[-1]) and heavy[1] > 10 * even[1] and heavy[-1] < even[-1]


def test_a_middle_outside_is_refused(shapes):
    box = shapes.box((0.01, 0.01, 0.05))
    assert center_of_mass(box).abs().max() < 1e-12
    with pytest.raises(ValueError, match="within the hull"):
        resting_poses(box, torch.tensor([0.012, 0.0, 0.04]))


def test_nothing_rests():
    with pytest.raises(ValueError, match="say how it stands"):
        upright([])


@given(st.floats(-1, 1), st.floats(-math.pi, math.pi))
def test_turn_to_z(height, angle):
    across = math.sqrt(1 - height**2)
    up = torch.tensor([across * math.cos(angle), across * math.sin(angle), height], dtype=torch.float64)
    turn = turn_to_z(up)
    torch.testing.assert_close(turn @ up, torch.tensor([0.0, 0.0, 1.0]).double(), atol=1e-9, rtol=0)
    assert float(so3.angle(turn)) == pytest.approx(math.acos(height), abs=1e-6)
