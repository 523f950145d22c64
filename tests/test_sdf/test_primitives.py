import math

import pytest
import torch

from sdf import se3
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Placed, Sphere, TorusArc, Union


def tensor(value: object) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


KNOWN = {
    "sphere": (Sphere(0.5), [((0, 0, 0), -0.5), ((0, 0, 2), 1.5), ((0.3, 0.4, 0), 0.0)]),
    "box": (
        Box((0.1, 0.2, 0.3)),
        [((0, 0, 0), -0.1), ((0.4, 0, 0), 0.3), ((0.1, 0.2, 0.3), 0.0), ((0.4, 0.6, 0), 0.5), ((0, 0.19, 0), -0.01)],
    ),
    "cylinder": (
        Cylinder(0.5, 1.0),
        [((0, 0, 0), -0.5), ((0, 0, 0.9), -0.1), ((0, 0, 3), 2.0), ((3.5, 0, 5), 5.0), ((0, 0.5, 0.2), 0.0)],
    ),
    "capsule": (
        Capsule((0, 0, 0), (0, 0, 1), 0.25),
        [((0, 0, 0.5), -0.25), ((1, 0, 0.3), 0.75), ((0, 0, -1), 0.75), ((0.3, 0.4, 1), 0.25)],
    ),
    "point capsule": (Capsule((1, 0, 0), (1, 0, 0), 0.25), [((1, 0, 0), -0.25), ((4, 4, 0), 4.75)]),
    "torus arc": (
        TorusArc((0, 0, 0), 1.0, 0.25, math.pi / 2),
        [((1, 0, 0), -0.25), ((0, 0, 0), 0.75), ((0, 0, 1), -0.25), ((-1, 0, 1), 0.75), ((0, 1, 0), 2**0.5 - 0.25)],
    ),
    "whole torus": (TorusArc((0, 0, 0), 1.0, 0.25, math.pi), [((-1, 0, 0), -0.25), ((-3, 0, 0), 1.75)]),
    "cup": (
        Cup(1.0, 2.0, 0.2, 0.4),
        [
            ((0, 0, 0.2), -0.2),  # in the base
            ((0.9, 0, 1.5), -0.1),  # in the wall
            ((0, 0, 1.4), 0.8),  # in the cavity, nearest to the wall
            ((0, 0, 0.5), 0.1),  # in the cavity, above the base
            ((0, 0, 3), math.hypot(0.8, 1.0)),  # above the mouth: the rim's inner edge
            ((0, 0, -1), 1.0),
            ((0.85, 0, 0.35), -math.hypot(0.05, 0.05)),  # nearest to the cavity's corner, where wall and base meet
            ((0.8, 0, 0.4), 0.0),
        ],
    ),
    "union": (
        Union((Sphere(0.5), Placed(Sphere(0.5), se3.make(torch.eye(3), torch.tensor((2.0, 0, 0)))))),
        [((1, 0, 0), 0.5), ((2, 0, 0), -0.5), ((0, 0, 0), -0.5), ((-1, 0, 0), 0.5)],
    ),
}


@pytest.mark.parametrize("name", KNOWN)
def test_known_distances(name):
    sdf, known = KNOWN[name]
    points, distances = (tensor(column) for column in zip(*known, strict=True))
    assert torch.allclose(sdf.distance(points), distances, atol=1e-9)


def test_mug_parts_and_handle():
    mug = Mug()
    height = 0.0475
    known = [
        ((0.0, 0, 0.002), -0.002),  # middle of the base
        ((0.039, 0, 0.09), -0.002),  # middle of the wall
        ((0.0, 0, 0.05), 0.037),  # the cavity is empty
        ((0.071, 0, height), -0.006),  # middle of the handle's tube, farthest out
        ((0.041, 0, height), 0.0),  # outer face of the wall, in the handle's hole
        ((0.053, 0, height), 0.012),  # in the hole, half way
        ((0.087, 0, height), 0.010),
        ((-0.061, 0, height), 0.020),  # no handle on the other side
        ((0, -0.061, height), 0.020),
        ((0, 0, -0.03), 0.03),
    ]
    points, distances = (tensor(column) for column in zip(*known, strict=True))
    assert torch.allclose(mug.distance(points), distances, atol=1e-12)
    assert torch.allclose(mug.bounds, torch.tensor([[-0.041, -0.041, 0.0], [0.077, 0.041, 0.095]]))
    assert mug.diagonal == pytest.approx(0.1723, abs=1e-4)


@pytest.mark.parametrize("sizes", [{}, {"tube_radius": 0.008, "ring_radius": 0.035}, {"tube_radius": 0.003}])
def test_handle_is_joined_to_the_wall_and_leaves_the_cavity_alone(sizes, generator):
    mug = Mug(**sizes)
    cup, handle = mug.members
    inner = mug.outer_radius - mug.wall
    # points of the cavity: the handle is never nearer than the wall
    angle, radius, lift = torch.rand(3, 20000, dtype=torch.float64, generator=generator)
    angle, radius = 2 * math.pi * angle, inner * radius.sqrt()
    z = mug.base + (mug.height - mug.base) * lift
    cavity = torch.stack((radius * angle.cos(), radius * angle.sin(), z), dim=-1)
    assert (mug.distance(cavity) >= 0).all()
    assert torch.equal(mug.distance(cavity), cup.distance(cavity))
    # along the tube's middle line everything is inside, from end to end, and both ends are in the wall
    along = torch.linspace(-mug.half_angle, mug.half_angle, 200, dtype=torch.float64)
    centre = tensor((mug.outer_radius, 0, 0.5 * mug.height))
    line = centre + mug.ring_radius * torch.stack((along.cos(), 0 * along, along.sin()), dim=-1)
    assert torch.allclose(handle.distance(line), tensor(-mug.tube_radius).expand(200))
    tip = line[[0, -1]] - tensor((mug.tube_radius, 0, 0))
    assert (cup.distance(tip) < 0).all()


@pytest.mark.parametrize("sdf", [KNOWN[name][0] for name in KNOWN] + [Mug()])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_nan_gradient_at_kinks(sdf, dtype):
    """Centres, axes, edges, corners and faces: where a norm or an absolute value has no derivative."""
    levels = [sorted({0.0, *pair, sum(pair) / 2}) for pair in sdf.bounds.T.double().tolist()]
    points = torch.cartesian_prod(*(torch.tensor(level, dtype=dtype) for level in levels)).requires_grad_()
    query = sdf(points)
    assert torch.isfinite(query.distance).all()
    assert torch.isfinite(query.gradient).all()
    assert query.gradient.norm(dim=-1).max() <= 1 + 1e-5
    (second,) = torch.autograd.grad(query.gradient.sum(), points)
    assert torch.isfinite(second).all()


def test_placed_member_moves_and_turns(generator):
    box = Box((0.1, 0.2, 0.3))
    pose = se3.exp(torch.randn(6, dtype=torch.float64, generator=generator))
    placed = Placed(box, pose)
    points = torch.randn(100, 3, dtype=torch.float64, generator=generator)
    assert torch.allclose(placed.distance(se3.apply(pose, points)), box.distance(points), atol=1e-12)
    surface = se3.apply(pose, torch.cartesian_prod(*box.bounds.double().T)).float()
    assert torch.allclose(placed.bounds, torch.stack((surface.amin(0), surface.amax(0))))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(0.0), "Expected radius to be a positive number of metres, got 0.0"),
        (lambda: Box((0.1, 0.2)), "Expected half_extents to have 3 entries, got 2"),
        (lambda: Box((0.1, -0.2, 0.1)), "Expected half_extents to be a positive number of metres, got -0.2"),
        (lambda: Cup(0.04, 0.1, 0.05, 0.004), "Expected 0 < wall < outer_radius"),
        (lambda: TorusArc((0, 0, 0), 0.1, 0.2, 1.0), "Expected 0 < tube_radius < ring_radius"),
        (lambda: TorusArc((0, 0, 0), 0.2, 0.1, 4.0), "Expected half_angle in"),
        (lambda: Mug(ring_radius=0.045), "Expected the handle to fit beside the cup"),
        (lambda: Union(()), "Expected at least one member"),
    ],
)
def test_impossible_sizes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sphere(math.inf),
        lambda: Box((0.1, math.nan, 0.1)),
        lambda: Capsule((1e30, 0.0, 0.0), (0.0, 0.0, 0.1), 0.1),
        lambda: Cup(math.inf, 1.0, 0.1, 0.1),
        lambda: TorusArc((0.0, 0.0, 0.0), math.inf, 0.1, 1.0),
    ],
)
def test_shapes_of_no_size_are_refused(make):
    with pytest.raises(ValueError, match="Expected"):
        make()
