"""How things slide: against closed forms, symmetry, and a loop that spells one contact out."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from rumi.dynamics.along_path import Pusher, push_along_path
from rumi.dynamics.outline import GridOutline, RectangleOutline, support_of
from rumi.dynamics.sliding import Outline, Sliding, contact_twist, moved_by, push, rotated
from sdf import backend
from sdf.primitives import Box, Cylinder, Mug

FINGER = torch.zeros(1, 2, dtype=torch.float64)
BOX = RectangleOutline((0.03, 0.08))


def sliding(count: int = 1, *, friction: float = 0.3, lever: float = 0.05, centre: tuple[float, float] = (0.0, 0.0)):
    return Sliding(
        torch.tensor(centre, dtype=torch.float64).expand(count, 2),
        torch.full((count,), lever, dtype=torch.float64),
        torch.full((count,), friction, dtype=torch.float64),
    )


def straight_push(
    pose: tuple[float, float, float],
    start: tuple[float, float],
    way: tuple[float, float],
    own: Sliding,
    *,
    steps: int = 200,
    thickness: float = 0.015,
    outline: Outline = BOX,
    points: Tensor = FINGER,
    turn: float = 0.0,
) -> tuple[Tensor, bool]:
    """A finger that goes straight; the object's pose at the end, and whether it was touched."""
    now = torch.tensor([pose], dtype=torch.float64)
    first = torch.tensor([[*start, 0.0]], dtype=torch.float64)
    whole = torch.tensor([[*way, turn]], dtype=torch.float64)
    met = False
    for index in range(steps):
        now, touched = push(
            now,
            first + whole * (index / steps),
            first + whole * ((index + 1) / steps),
            points,
            outline,
            own,
            thickness=thickness,
        )
        met |= bool(touched)
    return now[0], met


unit = st.floats(-1.0, 1.0)


@given(unit, unit, st.floats(0.0, 6.28), st.floats(0.0, 1.5), unit)
def test_a_contact_keeps_its_bargain(x: float, y: float, way: float, friction: float, tangential: float) -> None:
    """The point moves by the depth along the normal; the force is in the cone, on its edge where the contact slides."""
    arm = 0.06 * torch.tensor([x, y], dtype=torch.float64)
    inward = torch.tensor([math.cos(way), math.sin(way)], dtype=torch.float64)
    across = torch.stack((-inward[1], inward[0]))
    wanted = 0.002 * inward + 0.004 * tangential * across
    lever = 0.05
    twist = contact_twist(
        arm, inward, wanted, torch.tensor(lever, dtype=torch.float64), torch.tensor(friction, dtype=torch.float64)
    )
    force = twist[:2]
    assert float(twist[2]) == pytest.approx(float(arm[0] * force[1] - arm[1] * force[0]) / lever**2, abs=1e-12)
    moved = twist[:2] + twist[2] * torch.stack((-arm[1], arm[0]))
    normal, sideways = float(force @ inward), float(force @ across)
    assert abs(sideways) <= friction * normal + 1e-12
    turned = float(arm[0] * inward[1] - arm[1] * inward[0])
    edge = inward + math.copysign(friction, sideways) * across
    stiffness = 1 + turned * float(arm[0] * edge[1] - arm[1] * edge[0]) / lever**2
    if abs(sideways) < friction * normal - 1e-12:  # sticks
        torch.testing.assert_close(moved, wanted, atol=1e-12, rtol=0)
    elif stiffness > 0.1 * (1 + turned**2 / lever**2):  # slides without wedging
        assert float(moved @ inward) == pytest.approx(0.002, abs=1e-12)
        assert abs(sideways) == pytest.approx(friction * normal, abs=1e-12)


def test_a_push_through_the_centre_does_not_turn() -> None:
    end, met = straight_push((0.0, 0.0, 0.0), (-0.1, 0.0), (0.12, 0.0), sliding())
    assert met
    # the finger of 15 mm ends at x = 20 mm: the box's near side at 35 mm
    torch.testing.assert_close(end, torch.tensor([0.065, 0.0, 0.0], dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("offset", [0.01, 0.03, 0.06])
def test_mirrored_pushes_mirror(offset: float) -> None:
    left, _ = straight_push((0.0, 0.0, 0.2), (-0.1, offset), (0.12, 0.01), sliding())
    right, _ = straight_push((0.0, 0.0, -0.2), (-0.1, -offset), (0.12, -0.01), sliding())
    torch.testing.assert_close(left, right * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64), atol=1e-12, rtol=0)
    assert abs(float(left[2]) - 0.2) > 0.02


@pytest.mark.parametrize("offset", [-0.06, -0.02, 0.02, 0.06])
@pytest.mark.parametrize("slant", [-0.5, 0.0, 0.5])
def test_turns_as_the_votes_go(offset: float, slant: float) -> None:
    """Mason: both edges of the friction cone and the motion vote; two of three decide the sense of the turn."""
    friction = 0.3
    way = (math.cos(slant), math.sin(slant))
    contact = (-0.03, offset)
    end, met = straight_push(
        (0.0, 0.0, 0.0),
        (contact[0] - 0.015 - 1e-4 * way[0], contact[1] - 1e-4 * way[1]),
        (0.002 * way[0], 0.002 * way[1]),
        sliding(friction=friction),
        steps=20,
    )
    assert met
    rays = [way, (1.0, friction), (1.0, -friction)]
    votes = sum(math.copysign(1.0, contact[0] * ray[1] - contact[1] * ray[0]) for ray in rays)
    assert math.copysign(1.0, float(end[2])) == math.copysign(1.0, votes)


def test_what_is_pulled_by_one_point_turns_as_the_equation_says() -> None:
    """A point that is carried along x turns its object by d(angle)/ds = -r sin(angle) / (c^2 + r^2)."""
    lever, r, angle, steps, step = 0.05, 0.07, 2.0, 4000, 5e-5
    own = torch.tensor(lever, dtype=torch.float64), torch.tensor(10.0, dtype=torch.float64)
    pose = torch.tensor([-r * math.cos(angle), -r * math.sin(angle), angle], dtype=torch.float64)
    wanted, centre = torch.tensor([step, 0.0], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    for _ in range(steps):
        arm = r * torch.stack((pose[2].cos(), pose[2].sin()))
        pose = moved_by(pose, contact_twist(arm, wanted / step, wanted, *own), centre)
    expected = 2 * math.atan(math.tan(angle / 2) * math.exp(-steps * step * r / (lever**2 + r**2)))
    assert float(pose[2]) == pytest.approx(expected, abs=5e-4)
    hand = pose[:2] + r * torch.stack((pose[2].cos(), pose[2].sin()))
    torch.testing.assert_close(hand, torch.tensor([steps * step, 0.0], dtype=torch.float64), atol=5e-5, rtol=0)


def test_friction_carries_sideways_only_if_there_is_some() -> None:
    smooth, _ = straight_push((0.0, 0.0, 0.0), (-0.05, 0.0), (0.02, 0.02), sliding(friction=0.0), steps=40)
    rough, _ = straight_push((0.0, 0.0, 0.0), (-0.05, 0.0), (0.02, 0.02), sliding(friction=1.0), steps=40)
    assert abs(float(smooth[1])) < 0.3 * float(rough[1])


@pytest.mark.parametrize("slant", [-0.3, 0.0, 0.4])
def test_nothing_is_left_inside(slant: float) -> None:
    """Two fingers push a corner: contacts are settled one after the other, and no depth is left."""
    fingers = torch.tensor([[0.0, 0.03], [0.0, -0.03]], dtype=torch.float64)
    now = torch.tensor([[0.0, 0.0, slant]], dtype=torch.float64)
    for index in range(160):
        before = torch.tensor([[-0.11 + 0.001 * index, 0.0, 0.0]], dtype=torch.float64)
        after = before + torch.tensor([0.001, 0.0, 0.0], dtype=torch.float64)
        now, _ = push(now, before, after, fingers, BOX, sliding(), thickness=0.01, passes=20)
    local = rotated(fingers + after[0, :2] - now[0, :2], -now[0, 2].expand(2))
    assert float(BOX(local).distance.min()) > 0.01 - 1e-6
    # against both fingers a side lies square
    assert abs(math.remainder(float(now[0, 2]), math.pi / 2)) < 5e-3


def test_finer_steps_change_little() -> None:
    coarse, _ = straight_push((0.0, 0.0, 0.3), (-0.12, 0.03), (0.16, 0.0), sliding(), steps=160)
    fine, _ = straight_push((0.0, 0.0, 0.3), (-0.12, 0.03), (0.16, 0.0), sliding(), steps=480)
    assert float((coarse - fine)[:2].norm()) < 1e-3
    assert abs(float(coarse[2] - fine[2])) < math.radians(1.0)


def test_an_offset_centre_is_where_it_turns_about() -> None:
    """Pushed through a centre of friction off the middle, nothing turns; through the middle, it does."""
    own = sliding(centre=(0.0, 0.03))
    through, _ = straight_push((0.0, 0.0, 0.0), (-0.05, 0.03), (0.03, 0.0), own, steps=30)
    beside, _ = straight_push((0.0, 0.0, 0.0), (-0.05, 0.0), (0.03, 0.0), own, steps=30)
    assert abs(float(through[2])) < 1e-12
    assert float(beside[2]) > 0.05


def test_rectangle_outline_is_the_box() -> None:
    grid = torch.linspace(-0.15, 0.15, 31, dtype=torch.float64) + 0.0007
    points = torch.stack(torch.meshgrid(grid, grid, indexing="ij"), -1).reshape(-1, 2)
    found = BOX(points)
    level = torch.cat((points, torch.zeros_like(points[:, :1])), -1)
    exact = Box((0.03, 0.08, 1.0)).double()(level)
    torch.testing.assert_close(found.distance, exact.distance)
    torch.testing.assert_close(found.gradient, exact.gradient[:, :2])


def test_a_cup_is_met_from_outside_only() -> None:
    mug = Mug().double()
    outline = GridOutline.of_slice(mug, 0.045)
    middle = outline(torch.zeros(1, 2, dtype=torch.float64))
    assert float(middle.distance) == pytest.approx(-mug.outer_radius, abs=1e-3)
    angle = torch.linspace(1.0, 5.2, 50, dtype=torch.float64)  # away from the handle
    for radius in (0.5, 0.9, 1.0, 1.2):
        ring = radius * mug.outer_radius * torch.stack((angle.cos(), angle.sin()), -1)
        found = outline(ring)
        expected = torch.full_like(angle, (radius - 1.0) * mug.outer_radius)
        torch.testing.assert_close(found.distance, expected, atol=5e-4, rtol=0)
        if radius >= 0.9:
            away = found.gradient / found.gradient.norm(dim=-1, keepdim=True)
            assert float((away * torch.stack((angle.cos(), angle.sin()), -1)).sum(-1).min()) > math.cos(0.1)


def test_an_outline_is_solid_where_the_slice_is(generator: torch.Generator) -> None:
    box = Box((0.03, 0.05, 0.04)).double()
    outline = GridOutline.of_slice(box, 0.0)
    points = 0.08 * (torch.rand(500, 2, generator=generator, dtype=torch.float64) - 0.5)
    exact = RectangleOutline((0.03, 0.05))(points)
    torch.testing.assert_close(outline(points).distance, exact.distance, atol=5e-4, rtol=0)
    assert outline.radius == pytest.approx(math.hypot(0.03, 0.05), abs=3e-3)
    far = outline(torch.tensor([[1.0, 0.0]], dtype=torch.float64)).distance
    assert 0.9 < float(far) <= 0.97 + 1e-9


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_beyond_its_table_no_distance_is_overstated(version: str, generator: torch.Generator) -> None:
    outline = GridOutline.of_slice(Box((0.03, 0.05, 0.04)).double(), 0.0)
    places = 0.6 * (torch.rand(500, 2, generator=generator, dtype=torch.float64) - 0.5)
    exact = RectangleOutline((0.03, 0.05))(places).distance
    places, exact = places[exact > 0.01], exact[exact > 0.01]
    stays = torch.cat((places, torch.zeros_like(places[:, :1])), -1)[:, None].expand(-1, 2, -1)
    with backend.force(version):
        found = push_along_path(torch.zeros(len(places), 3).double(), stays, Pusher(FINGER), outline, sliding())
    distance = found.distance[:, 0]
    torch.testing.assert_close(outline(places).distance, distance)
    assert float((distance - exact).max()) < 5e-4
    assert float((distance / exact).min()) > 0.5


def test_no_outline_where_there_is_no_object() -> None:
    with pytest.raises(ValueError, match="got nothing there"):
        GridOutline.of_slice(Box((0.03, 0.05, 0.04)), 0.2)


def test_support_of_a_disc_and_of_a_mug() -> None:
    centre, spread, _ = support_of(Cylinder(0.04, 0.05).double())
    torch.testing.assert_close(centre, torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    assert spread == pytest.approx(2 / 3 * 0.04, rel=0.01)
    centre, _, _ = support_of(Mug().double())
    assert 0.002 < float(centre[0]) < 0.01  # towards the handle
    assert abs(float(centre[1])) < 1e-6
