"""First contacts of a tool's ways: against hand-worked ones, and the compiled version against the plain one."""

import math

import pytest
import torch
from torch import Tensor

from rumi.planning.first_contact import TouchingSurface, first_contacts
from rumi.robot.gripper import GripperShape
from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Box
from sdf.symmetry import Symmetries

HALF = (0.03, 0.05, 0.04)


@pytest.fixture(scope="module")
def box() -> ObjectModel:
    return object_model("box", Box(list(HALF)), Symmetries.none(), spacing=0.004, points=200)


@pytest.fixture(scope="module")
def surface() -> TouchingSurface:
    return TouchingSurface.of(GripperShape(), pad_spacing_m=0.01, palm_spacing_m=0.02, patch_m=0.015)


def placed(x: float, y: float = 0.0, z: float = 0.04, yaw: float = 0.0) -> Tensor:
    pose = se3.from_planar(torch.tensor([x, y, yaw]))
    pose[2, 3] = z
    return pose


def straight(start: tuple[float, ...], end: tuple[float, ...], steps: int) -> Tensor:
    share = torch.arange(1, steps + 1)[:, None] / steps
    return torch.tensor(start) + share * (torch.tensor(end) - torch.tensor(start))


def test_a_straight_way_touches_where_its_foremost_point_meets_the_face(
    box: ObjectModel, surface: TouchingSurface
) -> None:
    poses = torch.stack([placed(x) for x in (0.3, 0.32, 0.4)])
    way = straight((0.0, 0.0, 0.04, 0.0), (0.3, 0.0, 0.04, 0.0), 300)
    found = first_contacts(box.sdf, poses, way[None], torch.tensor([300]), surface)
    reach = float(surface.points[surface.patch >= 0, 0].max())
    wanted = [round(1e3 * (x - HALF[0] - reach)) for x in (0.3, 0.32)]
    # a millimetre early, by which contact counts, and a step
    assert found.step[0, :2].tolist() == pytest.approx(wanted, abs=3)
    assert found.step[0, 2] == 300
    assert float(surface.points[found.point[0, 0], 0]) > 0.02
    assert bool((surface.patch[found.point[0, :2]] >= 0).all())


def test_steps_beyond_a_ways_own_are_not_looked_at(box: ObjectModel, surface: TouchingSurface) -> None:
    way = straight((0.0, 0.0, 0.04, 0.0), (0.3, 0.0, 0.04, 0.0), 30).expand(2, -1, -1)
    found = first_contacts(box.sdf, placed(0.3)[None], way, torch.tensor([30, 10]), surface)
    assert found.step[0, 0] < 30
    assert found.step[1, 0] == 10


@pytest.mark.parametrize("version", ["torch", "numba"])
def test_what_it_touches_already_is_let_go_of_or_pressed_on(
    box: ObjectModel, surface: TouchingSurface, version: str
) -> None:
    if version == "numba":
        pytest.importorskip("numba")
    with backend.force(version):
        _let_go_or_pressed(box, surface)


def _let_go_or_pressed(box: ObjectModel, surface: TouchingSurface) -> None:
    here = 0.3 - HALF[0] - 0.035 + 0.002  # two millimetres in it
    start = torch.tensor([[here, 0.0, 0.04, 0.0]])
    back = torch.cat((start, straight((here, 0.0, 0.04, 0.0), (here - 0.05, 0.0, 0.04, 0.0), 19)))
    on = torch.cat((start, straight((here, 0.0, 0.04, 0.0), (here + 0.05, 0.0, 0.04, 0.0), 19)))
    again = torch.cat((back, back.flip(0)))
    steps = torch.tensor([20, 20])
    found = first_contacts(box.sdf, placed(0.3)[None], torch.stack((back, on)), steps, surface)
    assert found.step[:, 0].tolist() == [20, 0]
    found = first_contacts(box.sdf, placed(0.3)[None], again[None], torch.tensor([40]), surface)
    assert 20 < found.step[0, 0] < 40


def test_the_palm_feels_nothing_and_the_pads_have_parts(surface: TouchingSurface) -> None:
    palm = surface.patch < 0
    shape = GripperShape()
    assert bool(shape.in_palm(surface.points[palm]).all())
    assert int(surface.patch.max()) >= 7
    left = surface.patch[surface.points[:, 1] > 0.0]
    right = surface.patch[surface.points[:, 1] < 0.0]
    assert not set(left[left >= 0].tolist()) & set(right[right >= 0].tolist())


@pytest.mark.parametrize("seed", range(6))
def test_the_compiled_version_is_the_plain_one(box: ObjectModel, surface: TouchingSurface, seed: int) -> None:
    pytest.importorskip("numba")
    assert isinstance(box.sdf, GridSDF)
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(shape, generator=random) - 1.0

    poses = torch.stack(
        [placed(0.3 + 0.05 * float(u[0]), 0.05 * float(u[1]), 0.05, math.pi * float(u[2])) for u in uniform(12, 3)]
    )
    begin = torch.tensor([0.25, 0.0, 0.06, 0.0]) + uniform(8, 4) * torch.tensor([0.2, 0.2, 0.05, 1.0])
    end = torch.tensor([0.3, 0.0, 0.06, 0.0]) + uniform(8, 4) * torch.tensor([0.15, 0.15, 0.04, 1.0])
    share = torch.arange(1, 41)[:, None] / 40
    ways = begin[:, None] + share * (end - begin)[:, None]
    steps = torch.tensor([40, 40, 40, 20, 30, 40, 1, 40])
    with backend.force("numba"):
        compiled = first_contacts(box.sdf, poses, ways, steps, surface)
    with backend.force("torch"):
        plain = first_contacts(box.sdf, poses, ways, steps, surface)
    # a distance at the threshold to a rounding may be met a step sooner or later
    apart = compiled.step != plain.step
    assert float(apart.float().mean()) < 0.02
    assert bool(((compiled.step - plain.step)[apart].abs() <= 1).all())
    same = ~apart & (plain.step < steps[:, None])
    assert bool(same.any())
    assert float((compiled.point == plain.point)[same].float().mean()) > 0.95
    assert compiled.checked < 1.0
