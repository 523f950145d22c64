"""The sliding heuristic on shapes whose answer is known."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.workspace import Workspace
from rumi.planning.policy import Plan, PlanRequest, Scene
from rumi.planning.slide import CLOCKWISE, COUNTER_CLOCKWISE, SlidePolicy, SlideSettings, estimated_centre
from rumi.robot.tool import Tool
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Cylinder
from sdf.symmetry import Symmetries
from sensors.observation import Observation
from sensors.semantics import Semantics
from tests.fixtures.readings import make_reading

HEIGHT = 0.05
RADIUS = 0.06
CENTRE = torch.tensor([0.4, 0.05])
BOUNDS = torch.tensor([[0.0, -0.4], [0.8, 0.5]])


@pytest.fixture(scope="module")
def cylinder() -> ObjectModel:
    return object_model("cylinder", Cylinder(RADIUS, 0.1), Symmetries.none(), spacing=0.003, points=200)


@pytest.fixture
def scene(cylinder: ObjectModel) -> Scene:
    workspace = Workspace.from_bounds(
        torch.tensor([[0.0, -0.4, HEIGHT], [0.8, 0.4, HEIGHT]]), 0.04, planar_height=HEIGHT
    )
    return felt(Scene(cylinder, workspace, Tool(BOUNDS, height_m=HEIGHT), torch.tensor([0.2, 0.0, 0.0])))


def felt(scene: Scene, touched: Tensor | None = None, seen: Tensor | None = None) -> Scene:
    """The scene with what was touched, and what a camera saw besides, at the last of two instants."""
    parts = [part for part in (touched, seen) if part is not None]
    points = torch.cat(parts) if parts else torch.zeros(0, 3)
    now = scene.configuration
    reading = make_reading(
        Observation.of(points, Semantics.SURFACE),
        tool=scene.tool.pose(now.expand(2, len(now))),
        contact=torch.tensor([False, touched is not None]),
        configuration=now,
    )
    return replace(scene, reading=reading)


def belief(*centres: Tensor) -> PoseBelief:
    return PoseBelief.uniform(torch.stack([se3.from_planar(torch.cat((c, torch.zeros(1)))) for c in centres]))


def act(scene: Scene, settings: SlideSettings | None = None, previous: Plan | None = None, seed: int = 0) -> Plan:
    random = torch.Generator().manual_seed(seed)
    return SlidePolicy(settings).act(PlanRequest(belief(CENTRE), scene, previous, executed=1, generator=random))


def on_rim(angle: float) -> Tensor:
    """Points on the cylinder about a bearing."""
    turns = angle + torch.tensor([-0.02, 0.0, 0.02])
    return torch.stack(
        (CENTRE[0] + RADIUS * turns.cos(), CENTRE[1] + RADIUS * turns.sin(), torch.full((3,), HEIGHT)), -1
    )


def beside(scene: Scene, angle: float, away: float = RADIUS, yaw: float = 0.0) -> Scene:
    """The tool at a bearing of the cylinder."""
    place = CENTRE + away * torch.tensor([math.cos(angle), math.sin(angle)])
    return replace(scene, configuration=torch.tensor([*place.tolist(), yaw]))


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5, -2.0])
def test_goes_straight_to_the_centre_and_not_beyond(scene: Scene, angle: float) -> None:
    # surface samples have their middle a few millimetres off the axis
    middle = estimated_centre(belief(CENTRE), scene)[:2]
    assert float((middle - CENTRE).norm()) < 0.01
    now, distances, away = beside(scene, angle, away=0.3), [], 0.3 + 0.01
    while len(distances) < 8:
        plan = act(felt(now))
        assert plan.info["mode"] == "approach"
        way = plan.path[1, :2] - plan.path[0, :2]
        towards = middle - now.configuration[:2]
        assert float(way[0] * towards[1] - way[1] * towards[0]) == pytest.approx(0.0, abs=1e-6)
        assert float(plan.controls[0, 2]) == 0.0
        now = replace(now, configuration=plan.path[1])
        distances.append(float((middle - now.configuration[:2]).norm()))
        # a step takes 80 mm along the axis that it goes along most, until it is there
        assert distances[-1] <= max(0.0, away - 0.08) + 1e-6
        away = distances[-1]


def test_the_centre_is_the_mean_over_the_particles(scene: Scene) -> None:
    shifted = [CENTRE + torch.tensor(d) for d in ([0.0, 0.1], [0.0, -0.1])]
    three_to_one = belief(*shifted).reweighted(torch.tensor([0.75, 0.25]).log())
    start = beside(scene, math.pi, away=0.3)
    random = torch.Generator().manual_seed(0)
    plan = SlidePolicy().act(PlanRequest(three_to_one, felt(start), generator=random))
    way = plan.path[1, :2] - plan.path[0, :2]
    assert float(way[1] / way[0]) == pytest.approx(0.05 / 0.3, abs=0.03)


@pytest.mark.parametrize("angle", [0.0, 1.0, 2.5, -2.0])
@pytest.mark.parametrize("turn", [CLOCKWISE, COUNTER_CLOCKWISE])
def test_slides_along_the_tangent(scene: Scene, angle: float, turn: str) -> None:
    before = Plan(torch.zeros(1, 3), torch.zeros(2, 3), info={"turn": turn})
    plan = act(felt(beside(scene, angle), on_rim(angle)), previous=before)
    assert plan.info == {"turn": turn, "mode": "slide"}
    way = plan.path[1, :2] - plan.path[0, :2]
    outward = torch.tensor([math.cos(angle), math.sin(angle)])
    assert float(way.norm()) == pytest.approx(0.08, rel=1e-3)
    assert float(way @ outward) == pytest.approx(0.0, abs=2e-3)
    about = float(outward[0] * way[1] - outward[1] * way[0])
    assert about == pytest.approx(0.08 if turn == COUNTER_CLOCKWISE else -0.08, rel=1e-2)


def test_what_a_camera_sees_is_not_what_is_touched(scene: Scene) -> None:
    touching = beside(scene, 0.0)
    alone = act(felt(touching, on_rim(0.0)))
    watched = act(felt(touching, on_rim(0.0), seen=on_rim(2.0)))
    torch.testing.assert_close(watched.controls, alone.controls)


def test_draws_the_direction_once_a_run(scene: Scene) -> None:
    touching = felt(beside(scene, 0.0), on_rim(0.0))
    turns = [act(touching, seed=seed).info["turn"] for seed in range(30)]
    assert 8 <= turns.count(CLOCKWISE) <= 22
    # what comes later does not depend on later draws
    first = act(felt(scene), seed=1)
    assert {act(touching, previous=first, seed=seed).info["turn"] for seed in range(20)} == {first.info["turn"]}


@pytest.mark.parametrize("settings", [SlideSettings(stride=0.25), SlideSettings(stride=0.25, press=0.3, face=True)])
@pytest.mark.parametrize("seed", range(3))
def test_circles_a_fixed_cylinder(scene: Scene, settings: SlideSettings, seed: int) -> None:
    """A point-like tool that cannot get into a cylinder goes all the way round it, and always the same way."""
    now, plan, angles = beside(scene, math.pi, away=0.15), None, []
    touched: Tensor | None = None
    for _ in range(60):
        plan = act(felt(now, touched), settings, plan, seed)
        offset = plan.path[1, :2] - CENTRE
        angle, away = float(torch.atan2(offset[1], offset[0])), float(offset.norm())
        touched = on_rim(angle) if away <= RADIUS + 1e-3 else None
        now = beside(scene, angle, max(away, RADIUS), float(plan.path[1, 2]))
        angles.append(angle)
        if touched is None:
            # one step along a tangent leaves the rim by this much at most
            assert len(angles) < 6 or away < math.hypot(RADIUS, 0.0205) + 1e-3
    turned = torch.tensor(angles).diff()
    turned = torch.remainder(turned + math.pi, 2 * math.pi) - math.pi
    sign = -1.0 if plan.info["turn"] == CLOCKWISE else 1.0
    # on the straight way to the centre the bearing changes by what that is off the axis
    assert bool((sign * turned > -0.03).all())
    assert float(turned.sum().abs()) > 2 * math.pi


def test_faces_what_it_goes_for(scene: Scene) -> None:
    settings = SlideSettings(face=True)
    far = beside(scene, 3.0, away=0.3, yaw=2.9)
    assert float(act(felt(far), settings).controls[0, 2]) == -1.0  # 0.5 rad is the most
    near = beside(scene, 3.0, yaw=-0.3)
    turn = act(felt(near, on_rim(3.0)), settings).controls[0, 2]
    assert float(-0.3 + 0.5 * turn) == pytest.approx(3.0 - math.pi, abs=0.02)


def test_press_goes_into_the_surface(scene: Scene) -> None:
    plan = act(felt(beside(scene, 0.0), on_rim(0.0)), SlideSettings(press=1.0))
    way = plan.path[1, :2] - plan.path[0, :2]
    assert float(way[0]) == pytest.approx(-0.08 / math.sqrt(2), abs=1e-3)
    assert abs(float(way[1])) == pytest.approx(0.08 / math.sqrt(2), abs=1e-3)


def test_works_in_space_too(scene: Scene) -> None:
    tool = Tool(torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.5, 0.3]]))
    flying = replace(scene, tool=tool, configuration=torch.tensor([0.2, 0.05, 0.25, 0.1]))
    plan = act(felt(flying))
    assert plan.controls.shape == (1, 4)
    way = plan.path[1, :3] - plan.path[0, :3]
    # the middle of the object is at the height 0
    assert float(way[2] / way[0]) == pytest.approx(-1.25, abs=0.08)
    low = replace(flying, configuration=torch.tensor([0.34, 0.05, 0.05, 0.0]))
    plan = act(felt(low, on_rim(math.pi)))
    assert float(plan.controls[0, 2]) == 0.0
    assert abs(float(plan.controls[0, 1])) == pytest.approx(1.0, abs=1e-2)
    above = replace(flying, configuration=torch.tensor([0.4, 0.05, 0.11, 0.0]))
    plan = act(felt(above, torch.tensor([[0.4, 0.05, 0.1]])))
    assert bool(plan.controls.isfinite().all())
    assert float(plan.controls[0, :2].norm()) == pytest.approx(1.0, abs=1e-3)


def test_refuses_what_has_no_meaning(scene: Scene) -> None:
    with pytest.raises(ValueError, match=r"Expected scene\.reading"):
        act(replace(scene, reading=None))
