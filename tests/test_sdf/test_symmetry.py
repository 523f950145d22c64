"""Symmetries: declared in words, found on shapes whose group is known, and how poses are compared by them."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rumi.metrics.pose_error import pose_error
from sdf import se3, so3
from sdf.grid_sdf import GridSDF
from sdf.mesh.find_symmetry import find_symmetries, mesh_symmetries
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Placed, Sphere, Union
from sdf.surface import sample_surface
from sdf.symmetry import Symmetries, about, closure

F64 = torch.float64
TILT = se3.make(so3.exp(torch.tensor([0.3, -0.5, 0.8])), torch.tensor([0.02, -0.01, 0.05]))
BUMP = Placed(Sphere(0.008), se3.make(torch.eye(3), torch.tensor([0.04, 0.0, 0.02])))


def prism(sides, radius, half_height):
    """An upright prism as an intersection of slabs, exact enough near its faces."""

    class Prism(Cylinder):
        def distance(self, points_o):
            angles = 2 * math.pi * torch.arange(sides) / sides
            normals = torch.stack((angles.cos(), angles.sin()), -1).to(points_o)
            across = (points_o[..., :2] @ normals.mT).amax(-1) - radius
            return torch.maximum(across, points_o[..., 2].abs() - half_height)

    return Prism(radius / math.cos(math.pi / sides), half_height)


# shape, rotations (of those that differ by a free turn one), free axis, any rotation
CASES = {
    "sphere": (Sphere(0.05), 1, None, True),
    "cylinder": (Cylinder(0.04, 0.05), 2, (0, 0, 1), False),
    "cylinder of equal moments": (Cylinder(0.04, 0.04 * math.sqrt(3) / 2), 2, (0, 0, 1), False),
    "cup": (Cup(0.041, 0.095, 0.004, 0.004), 1, (0, 0, 1), False),
    "capsule": (Capsule((0, 0, -0.03), (0, 0, 0.05), 0.02), 2, (0, 0, 1), False),
    "box": (Box((0.03, 0.079, 0.105)), 4, None, False),
    "square prism": (Box((0.04, 0.04, 0.07)), 8, None, False),
    "cube": (Box((0.04, 0.04, 0.04)), 24, None, False),
    "triangular prism": (prism(3, 0.03, 0.05), 6, None, False),
    "seven-sided prism": (prism(7, 0.06, 0.02), 14, None, False),
    "mug": (Mug(tube_radius=0.008, ring_radius=0.035), 1, None, False),
    "cylinder with a bump": (Union((Cylinder(0.04, 0.05), BUMP)), 1, None, False),
}


def points_of(shape):
    return sample_surface(shape, 700, generator=torch.Generator().manual_seed(0))[0]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("tilted", [False, True])
def test_found(name, tilted):
    shape, count, axis, ball = CASES[name]
    at = TILT if tilted else torch.eye(4)
    shape = Placed(shape, at) if tilted else shape
    found = find_symmetries(shape, points_of(shape))
    own = found.symmetries
    assert (len(own), own.ball) == (count, ball)
    assert (own.axis is not None) == (axis is not None)
    if axis is not None:
        assert abs(float(own.axis @ at[:3, :3].double() @ torch.tensor(axis, dtype=F64))) > math.cos(math.radians(0.2))
    torch.testing.assert_close(torch.linalg.det(own.rotations), torch.ones(count, dtype=F64))
    # all that is claimed holds, on points that were not looked at
    points = sample_surface(shape, 200, generator=torch.Generator().manual_seed(9))[0]
    placed = se3.apply(about(own.rotations, own.center), points)
    assert float(shape.distance(placed.float()).abs().max()) < 0.002
    assert found.worst_m < 0.002


@pytest.mark.parametrize(("name", "mirrors"), [("mug", 1), ("box", 3), ("cube", 9), ("cylinder", 2), ("cup", 1)])
def test_mirrors_are_reported_and_are_no_rotations(name, mirrors):
    found = find_symmetries(CASES[name][0], points_of(CASES[name][0]))
    assert len(found.mirrors) == mirrors
    assert "mirror plane" in found.words()


def test_found_in_a_table():
    """What estimation uses is tabulated: rounded corners are within the tolerance."""
    box = Placed(Box((0.03, 0.079, 0.105)), TILT)
    found = find_symmetries(GridSDF.from_sdf(box, 0.002), points_of(box))
    assert len(found.symmetries) == 4 and 1e-4 < found.worst_m < 0.002


def test_of_a_mesh(shapes):
    """A box, and a ball of facets that are flatter than the tolerance."""
    pytest.importorskip("scipy")
    assert mesh_symmetries(MeshSDF(shapes.box()), points=500).symmetries.words().startswith("half a turn about")
    assert mesh_symmetries(MeshSDF(shapes.sphere(rings=12)), points=500).symmetries.ball


def test_the_tolerance_decides():
    """A box 2 mm off a square one."""
    box = Box((0.040, 0.041, 0.07))
    assert len(find_symmetries(box, points_of(box), tolerance_m=0.0005).symmetries) == 4
    assert len(find_symmetries(box, points_of(box), tolerance_m=0.003).symmetries) == 8
    with pytest.raises(ValueError, match="tolerance above 0"):
        find_symmetries(box, points_of(box), tolerance_m=0.0)


@pytest.mark.parametrize(
    ("text", "count", "free", "ball"),
    [
        ("none", 1, False, False),
        ("ball", 1, False, True),
        ("z", 1, True, False),
        ("z,x2", 2, True, False),
        ("x,y", 1, False, True),
        ("z4", 4, False, False),
        ("x2, y2", 4, False, False),
        ("z4,x2", 8, False, False),
        ("z4,x4", 24, False, False),
        ("z7,y2", 14, False, False),
    ],
)
def test_words(text, count, free, ball):
    own = Symmetries.parse(text)
    assert (len(own), own.axis is not None, own.ball) == (count, free, ball)
    if count > 1 and not free:
        products = (own.rotations[:, None] @ own.rotations).reshape(-1, 3, 3)
        apart = (products[:, None] - own.rotations).abs().amax((-1, -2)).amin(-1)
        assert float(apart.max()) < 1e-5  # a group


@pytest.mark.parametrize("text", ["", "w", "z1", "z0", "zz", "z4,", "z5,x4"])
def test_bad_words(text):
    with pytest.raises(ValueError, match="Expected"):
        Symmetries.parse(text)


def test_said_for_people():
    assert Symmetries.none().words() == "none"
    assert (
        Symmetries.parse("z,x2").words() == "any turn about (0.00, 0.00, 1.00) and half a turn about any line across it"
    )
    assert Symmetries.parse("z4").words() == "a quarter of a turn about (0.00, 0.00, 1.00)"
    assert Symmetries.parse("z4,x2").words().count("or") == 3


def test_closure_knows_when_to_stop():
    fifth = so3.exp(torch.tensor([[0.0, 0.0, 2 * math.pi / 5], [math.pi / 2, 0.0, 0.0]], dtype=F64))
    assert closure(fifth) is None
    assert len(closure(fifth[:1])) == 5


def test_bad_rotations(no_shape_check):
    with pytest.raises(ValueError, match="identity"):
        Symmetries(torch.diag(torch.tensor([-1.0, -1.0, 1.0]))[None])
    with pytest.raises(ValueError, match=r"\(K, 3, 3\)"):
        Symmetries(torch.eye(3))


angles = st.floats(-3.1, 3.1)


@given(angles, angles, angles, st.sampled_from(["z", "z,x2", "ball", "z4,x2", "x2,y2", "y"]))
def test_the_same_object_has_no_error(a, b, c, text):
    """Any pose against itself turned by a symmetry about a point off the origin."""
    own = Symmetries.parse(text, torch.tensor([0.03, -0.02, 0.05], dtype=F64))
    truth = se3.exp(torch.tensor([0.1, 0.2, 0.3, a, b, c], dtype=F64))
    turns = own.rotations.double()
    if own.axis is not None:
        turns = turns @ so3.exp(c * own.axis)
    if own.ball:
        turns = so3.exp(torch.tensor([[a, c, b]], dtype=F64))
    alike = truth @ about(turns, own.center)
    metres, radians = pose_error(alike, truth.expand(alike.shape), own)
    assert float(metres.max()) < 1e-6
    assert float(radians.max()) < 1e-6


def test_what_a_free_axis_leaves():
    """A tilt of the axis counts, a turn about it does not, however the two are mixed."""
    own = Symmetries.parse("z", torch.tensor([0.0, 0.0, 0.05]))
    truth = se3.make(so3.exp(torch.tensor([0.4, 0.1, -0.7], dtype=F64)), torch.tensor([0.3, 0.1, 0.0], dtype=F64))
    tilt = so3.exp(torch.tensor([0.06, 0.08, 0.0], dtype=F64))
    turn = so3.exp(torch.tensor([0.0, 0.0, 2.0], dtype=F64))
    estimate = truth @ about(turn @ tilt, own.center.double())
    metres, radians = pose_error(estimate, truth, own)
    assert float(radians) == pytest.approx(0.1, abs=1e-6)
    assert float(metres) == pytest.approx(2 * math.sin(0.05) * 0.05, abs=1e-6)  # of the origin, 50 mm below the middle
    _, all_of_it = pose_error(estimate, truth, Symmetries.none())
    assert float(all_of_it) > 1.9


def test_a_ball_has_a_place_only():
    own = Symmetries(torch.eye(3)[None], torch.tensor([0.0, 0.0, 0.05]), ball=True)
    truth = se3.identity(dtype=F64)
    estimate = about(so3.exp(torch.tensor([1.0, 2.0, 0.5], dtype=F64)), own.center.double())
    estimate[0, 3] += 0.004
    metres, radians = pose_error(estimate, truth, own)
    assert (float(metres), float(radians)) == (pytest.approx(0.004), pytest.approx(0.0, abs=1e-7))
