"""The shortest way to a touch that tells: round what stands in it, to where the truth alone is felt."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.workspace import Workspace
from rumi.planning.policy import PlanRequest, Scene
from rumi.robot.tool import Tool
from scripts import shortest_touch
from scripts.shortest_touch import ShortestTouchPolicy, _back, _Lattice, _shortest
from sdf import se3
from sdf.object_model import ObjectModel, object_model
from sdf.primitives import Mug
from sdf.symmetry import Symmetries
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

HEIGHT = 0.045
BOUNDS = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])


@pytest.fixture(scope="module")
def mug() -> ObjectModel:
    return object_model("mug", Mug(), Symmetries.none(), spacing=0.004, points=200)


def scene(mug: ObjectModel, here: tuple[float, float, float]) -> Scene:
    workspace = Workspace.from_bounds(BOUNDS, 0.02, planar_height=HEIGHT)
    return Scene(mug, workspace, Tool(BOUNDS[:, :2], height_m=HEIGHT), torch.tensor(here))


def at(*yaws: float) -> Tensor:
    return se3.from_planar(torch.tensor([(0.4, 0.0, yaw) for yaw in yaws]))


def test_ways_lead_round_a_wall_and_end_where_they_touch():
    shape, start, end = (7, 5), 1, 31  # columns along x, five places each; from (0, 1) to (6, 1)
    free, touches = np.ones(shape, dtype=bool), np.zeros(shape, dtype=bool)
    free[3, :4] = False  # a wall with a gap at its upper end
    free[6, 1], touches[6, 1] = False, True
    lattice = _Lattice(torch.zeros(35, 2), shape, free.ravel())
    lengths, before = _shortest(lattice, touches.ravel(), start)
    way = _back(before, start, end)
    assert way[0] == start and way[-1] == end and 3 * 5 + 4 in way
    assert lengths[end] == pytest.approx(6, abs=0.01)  # a step across is as long as one along an axis
    steps = np.abs(np.diff(np.stack(np.unravel_index(way, shape)), axis=1))
    assert steps.max() == 1
    assert not np.isfinite(lengths[3 * 5]) and all(lattice.free[way[:-1]])
    touches[3, 1] = True  # what is touched is reached, and not gone through
    lengths, before = _shortest(lattice, touches.ravel(), start)
    assert np.isfinite(lengths[3 * 5 + 1]) and 3 * 5 + 1 not in _back(before, start, end)


@pytest.mark.parametrize("yaw", [math.pi, 0.5 * math.pi, -0.5 * math.pi, 0.0])
def test_it_goes_free_of_the_object_to_a_touch_that_tells(mug, yaw):
    around = scene(mug, (0.2, 0.0, 0.0))
    yaws = (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi)
    plan = ShortestTouchPolicy(lambda: at(yaw)[0]).act(PlanRequest(PoseBelief.uniform(at(*yaws)), around))
    assert plan.info["nats"] >= math.log(4.0 / 3.0) - 0.01  # at least one of four poses would have it otherwise
    assert plan.controls.abs().max() <= 1.0 and len(plan.path) == len(plan.controls) + 1
    tool = around.tool
    way = torch.cat((plan.path[:1], tool.free_path(plan.path[0], plan.controls, 20)))
    outline = tool.shape.outline(0.01)

    def apart(points: Tensor, places: Tensor) -> Tensor:
        found: Tensor = shortest_touch._distances(tool, mug, points, places, at(yaw))[:, 0]
        return found

    assert apart(outline, way[:-20]).min() > -0.004  # between places of the lattice it may graze
    assert apart(tool.shape.pad_section(0.01), way).min() < 0.002


def test_it_lets_go_of_what_it_touches_and_goes_to_the_nearest_where_nothing_tells(mug):
    touching = (0.4 - 0.046 - 0.034, 0.0, 0.0)
    around = scene(mug, touching)
    plan = ShortestTouchPolicy(lambda: at(0.0)[0]).act(PlanRequest(PoseBelief.uniform(at(0.0)), around))
    assert plan.info["nats"] == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < float((plan.path[-1] - plan.path[0])[:2].abs().max()) <= 0.08  # an action's way


def test_it_goes_on_by_its_way_until_it_feels_something(mug):
    around = scene(mug, (0.2, 0.0, 0.0))
    asked: list[int] = []

    def truth() -> Tensor:
        asked.append(1)
        return at(0.0)[0]

    policy, believed = ShortestTouchPolicy(truth), PoseBelief.uniform(at(0.0, 1.0))
    first = policy.act(PlanRequest(believed, around))
    assert len(first.controls) > 1
    there = replace(around, configuration=first.path[1])
    rest = policy.act(PlanRequest(believed, there, first, executed=1))
    assert torch.equal(rest.controls, first.controls[1:]) and torch.equal(rest.path, first.path[1:])
    here = there.configuration
    nothing = Observation.of(torch.zeros(0, 3), Semantics.FREE)
    for touched in (False, True):
        felt = torch.tensor([touched])
        none = torch.zeros(0, dtype=torch.long)
        reading = Reading(nothing, none, there.tool.pose(here)[None], felt, None, here, torch.tensor(0.0))
        asked.clear()
        policy.act(PlanRequest(believed, replace(there, reading=reading), first, executed=1))
        assert bool(asked) is touched  # only then is the truth looked at anew
    done = policy.act(PlanRequest(believed, there, first, executed=len(first.controls)))
    assert len(done.controls) > 0 and not torch.equal(done.path[0], first.path[0])


def test_it_goes_to_the_nearest_even_where_touches_would_mislead(mug, monkeypatch):
    around, way = scene(mug, (0.2, 0.0, 0.0)), torch.tensor([[0.2, 0.0, 0.0], [0.21, 0.0, 0.0]])
    free = _Lattice(torch.tensor([[0.2, 0.0], [0.21, 0.0]]), (2, 1), np.ones(2, dtype=bool))
    near, far = (shortest_touch._Touch(nats, n, way[: n + 1], free, 0.08) for nats, n in ((-0.5, 1), (-0.1, 2)))
    monkeypatch.setattr(shortest_touch, "_touches", lambda *arguments: [far, near])
    plan = ShortestTouchPolicy(lambda: at(0.0)[0]).act(PlanRequest(PoseBelief.uniform(at(0.0)), around))
    assert plan.info["nats"] == -0.5 and plan.path[-1].tolist() == pytest.approx(way[-1].tolist())


def test_it_stays_where_it_cannot_go(mug):
    around = scene(mug, (0.0, 0.0, 0.0))
    held = Tool(torch.tensor([[0.0, 0.0], [0.0, 0.0]]), height_m=HEIGHT)
    request = PlanRequest(PoseBelief.uniform(at(0.0, 1.0)), Scene(mug, around.workspace, held, around.configuration))
    plan = ShortestTouchPolicy(lambda: at(0.0)[0]).act(request)
    assert plan.controls.tolist() == [[0.0, 0.0, 0.0]]
